// Squared residual over variance, mean of the three channels, and how many pixels it stands for, of one frame: the first
// step of the residual-driven weights.
struct Params {
    size: vec2i,             // of the frame
    predicted_offset: vec2i, // of frame pixel (0, 0) in the prediction
    predicted_stride: i32,
    exposure_time: f32,      // s
    black_clipped: u32,
    _pad: u32,
    noise: array<vec4f, 192>,  // as in weights.wgsl, for red, green, blue
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> predicted_r: array<f32>;
@group(0) @binding(2) var<storage, read> predicted_g: array<f32>;
@group(0) @binding(3) var<storage, read> predicted_b: array<f32>;
@group(0) @binding(4) var<storage, read> exposure_r: array<f32>;
@group(0) @binding(5) var<storage, read> exposure_g: array<f32>;
@group(0) @binding(6) var<storage, read> exposure_b: array<f32>;
@group(0) @binding(7) var<storage, read> mask: array<f32>;
@group(0) @binding(8) var<storage, read_write> misfit: array<vec2f>;

fn noise_of(channel: u32, exposure: f32) -> f32 {
    let s = sqrt(clamp(exposure, 0.0, 1.0)) * 255.0;
    let i = min(u32(s), 254u);
    let k = channel * 256u + i;
    let a = params.noise[k / 4u][k % 4u];
    let b = params.noise[(k + 1u) / 4u][(k + 1u) % 4u];
    return mix(a, b, s - f32(i));
}

fn chi_squared(channel: u32, predicted: f32, exposure: f32) -> f32 {
    let expected = max(predicted, 0.0) * params.exposure_time;
    let s = noise_of(channel, expected);
    var m = Moments(expected, 1.0, s * s);
    if params.black_clipped == 1u {
        m = clipped_at_black(expected, s);
    }
    let r = exposure - m.mean;
    return r * r / m.variance;
}

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy);
    if any(p >= params.size) {
        return;
    }
    let i = at(p, params.size.x);
    let k = at(p + params.predicted_offset, params.predicted_stride);
    let chi = chi_squared(0u, predicted_r[k], exposure_r[i]) + chi_squared(1u, predicted_g[k], exposure_g[i])
        + chi_squared(2u, predicted_b[k], exposure_b[i]);
    misfit[i] = select(vec2f(0.0), vec2f(chi / 3.0, 1.0), mask[i] > 0.0);
}
