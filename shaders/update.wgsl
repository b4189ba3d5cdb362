// Trial step of log irradiance, u = u_old + clamp(s x, -1, 1), and E = exp(u), for one channel. s = 0 restores.
// The clamp comes after s: for small s the step is then s x itself, which lowers the objective; a clamped x need not.
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
        let u = old[i] + clamp(params.step * solution[i], -1.0, 1.0);
        log_irradiance[i] = u;
        irradiance[i] = exp(u);
    }
}
