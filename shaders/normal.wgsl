// Last step of the normal equations' product q = A x, A = diag(E) K^T W K diag(E) + D^T w D (the Gauss-Newton matrix of
// eq. (9) in log irradiance), for one channel; `back` holds K^T W K diag(E) x. Also <x, q> as one partial sum per workgroup.
struct Params {
    size: vec2i,
    rows: vec2i,    // the first to compute, and the one after the last
    first: i32,     // row that comes first in the bindings
    partial: u32,   // first partial sum
    row: u32,       // workgroups per row
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> irradiance: array<f32>;
@group(0) @binding(2) var<storage, read> back: array<f32>;
@group(0) @binding(3) var<storage, read> edge: array<f32>;
@group(0) @binding(4) var<storage, read> direction: array<f32>;
@group(0) @binding(5) var<storage, read_write> product: array<f32>;
@group(0) @binding(6) var<storage, read_write> partials: array<f32>;

var<workgroup> shared_sum: array<f32, 128>;

fn value(i: u32) -> f32 {
    return direction[i];
}

@compute @workgroup_size(16, 8)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let corner = vec2i(vec2u(group.x * 16u + local % 16u, group.y * EACH * 8u + local / 16u)) + vec2i(0, params.rows.x);
    var term = 0.0;
    for (var j = 0u; j < EACH; j += 1u) {
        let p = corner + vec2i(0, i32(j) * 8);
        if p.x < params.size.x && p.y < params.rows.y {
            let i = at(p - vec2i(0, params.first), params.size.x);
            let q = irradiance[i] * back[i] + smoothness(p, i, params.size);
            product[i] = q;
            term += direction[i] * q;
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
