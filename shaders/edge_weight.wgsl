// Half-quadratic weights of total variation on log irradiance u, shared by the channels so that edges keep their colour:
// w = lambda / sqrt(sum_c |D u_c|^2 + epsilon^2), with forward differences D that are zero across the border; and the
// smoothness term lambda sum (sqrt(...) - epsilon) of eq. (9) as one partial sum per workgroup.
struct Params {
    size: vec2i,
    lambda: f32,
    epsilon: f32,
    partial: u32,
    row: u32,        // workgroups per row
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> log_r: array<f32>;
@group(0) @binding(2) var<storage, read> log_g: array<f32>;
@group(0) @binding(3) var<storage, read> log_b: array<f32>;
@group(0) @binding(4) var<storage, read_write> edge: array<f32>;
@group(0) @binding(5) var<storage, read_write> partials: array<f32>;

var<workgroup> shared_sum: array<f32, 128>;

fn squared_difference(i: u32, k: u32) -> f32 {
    let d = vec3f(log_r[k] - log_r[i], log_g[k] - log_g[i], log_b[k] - log_b[i]);
    return dot(d, d);
}

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let p = vec2i(id.xy);
    var term = 0.0;
    if all(p < params.size) {
        let i = at(p, params.size.x);
        var squared = params.epsilon * params.epsilon;
        if p.x + 1 < params.size.x {
            squared += squared_difference(i, i + 1u);
        }
        if p.y + 1 < params.size.y {
            squared += squared_difference(i, i + u32(params.size.x));
        }
        let length = sqrt(squared);
        edge[i] = params.lambda / length;
        term = params.lambda * (length - params.epsilon);
    }
    shared_sum[local] = term;
    for (var s = 64u; s > 0u; s >>= 1u) {
        workgroupBarrier();
        if local < s {
            shared_sum[local] += shared_sum[local + s];
        }
    }
    if local == 0u {
        partials[params.partial + group.y * params.row + group.x] = shared_sum[0];
    }
}
