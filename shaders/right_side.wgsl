// Negative gradient of eq. (9) in log irradiance u = ln E, b = E K^T W (B - K E) - D^T w D u (eq. 10), and the Jacobi
// preconditioner diag(E^2 sum_i diag(K_i^T W_i K_i)) + diag(D^T w D), for one channel; `back` holds K^T W (B - K E).
struct Params {
    size: vec2i,
    rows: vec2i,    // the first to compute, and the one after the last
    first: i32,     // row that comes first in the bindings
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> irradiance: array<f32>;
@group(0) @binding(2) var<storage, read> back: array<f32>;
@group(0) @binding(3) var<storage, read> edge: array<f32>;
@group(0) @binding(4) var<storage, read> data_diagonal: array<f32>;
@group(0) @binding(5) var<storage, read_write> right_side: array<f32>;
@group(0) @binding(6) var<storage, read_write> diagonal: array<f32>;

fn value(i: u32) -> f32 {
    return log(irradiance[i]);
}

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy) + vec2i(0, params.rows.x);
    if p.x >= params.size.x || p.y >= params.rows.y {
        return;
    }
    let i = at(p - vec2i(0, params.first), params.size.x);
    let e = irradiance[i];
    right_side[i] = e * back[i] - smoothness(p, i, params.size);
    // The interpolation has negative lobes: beside masked pixels the approximate diagonal K^T W can fall below zero. The true one cannot, and a lamp
    // there that the frame sees by its lobes alone has much of it, its irradiance squared: its size is nearer the truth than none.
    diagonal[i] = e * e * abs(data_diagonal[i]) + smoothness_diagonal(p, i, params.size) + 1e-20;
}
