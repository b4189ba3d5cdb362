// Trial step of log irradiance and E = exp(u), for one channel. s = 0 restores. The data term is quadratic in E, not in u:
// upwards E grows by the factor 1 + s x, where exp(s x) would overshoot; downwards by exp(s x), which stays positive.
// Both are s x to first order. A pixel at most quadruples, and falls to no less than 1 / e. The bounds come after s: for
// small s the step is then s x itself, which lowers the objective; a bounded x need not.
struct Params {
    count: u32,
    row: u32,
    step: f32,
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> old: array<f32>;
@group(0) @binding(2) var<storage, read> solution: array<f32>;
@group(0) @binding(3) var<storage, read_write> log_irradiance: array<f32>;
@group(0) @binding(4) var<storage, read_write> irradiance: array<f32>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let i = (group.y * params.row + group.x) * 128u + local;
    if i < params.count {
        let x = params.step * solution[i];
        let u = old[i] + select(max(x, -1.0), log(1.0 + clamp(x, 0.0, 3.0)), x > 0.0);
        log_irradiance[i] = u;
        irradiance[i] = exp(u);
    }
}
