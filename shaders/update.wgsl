// Trial step x of log irradiance for one channel, made of irradiance E itself. s = 0 restores. The data term is quadratic in E, not in ln E:
// upwards E grows by the factor 1 + s x, where exp(s x) would overshoot; downwards by exp(s x), which stays positive.
// Both are s x to first order. A pixel at most quadruples, and falls to no less than 1 / e. The bounds come after s: for
// small s the step is then s x itself, which lowers the objective; a bounded x need not.
struct Params {
    count: u32,
    row: u32,
    step: f32,
    darkest: f32,   // least irradiance, above 0
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> old: array<f32>;
@group(0) @binding(2) var<storage, read> solution: array<f32>;
@group(0) @binding(3) var<storage, read_write> irradiance: array<f32>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let g = group.y * params.row + group.x;
    for (var j = 0u; j < EACH; j += 1u) {
        let i = (g * EACH + j) * 128u + local;
        if i < params.count {
            let x = params.step * solution[i];
            irradiance[i] = max(old[i] * select(exp(max(x, -1.0)), 1.0 + clamp(x, 0.0, 3.0), x > 0.0), params.darkest);
        }
    }
}
