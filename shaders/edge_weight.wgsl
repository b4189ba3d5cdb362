// Half-quadratic weights of total variation on log irradiance u = ln E, shared by the channels so that edges keep their colour:
// w = lambda / sqrt(sum_c |D u_c|^2 + epsilon^2), with forward differences D that are zero across the border; and the
// smoothness term lambda sum (sqrt(...) - epsilon) of eq. (9) as one partial sum per workgroup.
struct Params {
    size: vec2i,
    rows: vec2i,     // the first to compute, and the one after the last
    first: i32,      // row that comes first in the bindings
    partial: u32,    // first partial sum
    row: u32,        // workgroups per row
    lambda: f32,
    epsilon: f32,
    _pad: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> irradiance_r: array<f32>;
@group(0) @binding(2) var<storage, read> irradiance_g: array<f32>;
@group(0) @binding(3) var<storage, read> irradiance_b: array<f32>;
@group(0) @binding(4) var<storage, read_write> edge: array<f32>;
@group(0) @binding(5) var<storage, read_write> partials: array<f32>;

var<workgroup> shared_sum: array<f32, 128>;

fn squared_difference(i: u32, k: u32) -> f32 {
    let d = log(vec3f(irradiance_r[k] / irradiance_r[i], irradiance_g[k] / irradiance_g[i], irradiance_b[k] / irradiance_b[i]));
    return dot(d, d);
}

@compute @workgroup_size(16, 8)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let corner = vec2i(vec2u(group.x * 16u + local % 16u, group.y * EACH * 8u + local / 16u)) + vec2i(0, params.rows.x);
    var term = 0.0;
    for (var j = 0u; j < EACH; j += 1u) {
        let p = corner + vec2i(0, i32(j) * 8);
        if p.x < params.size.x && p.y < params.rows.y {
            let i = at(p - vec2i(0, params.first), params.size.x);
            var squared = params.epsilon * params.epsilon;
            if p.x + 1 < params.size.x {
                squared += squared_difference(i, i + 1u);
            }
            if p.y + 1 < params.size.y {
                squared += squared_difference(i, i + u32(params.size.x));
            }
            let length = sqrt(squared);
            edge[i] = params.lambda / length;
            term += params.lambda * (length - params.epsilon);
        }
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
