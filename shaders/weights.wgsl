// Data weights W and weighted observations W B of one channel of one frame, at the exposure that the present estimate
// predicts. Eq. (8)'s mask, inverse variance of the irradiance (shot, read and quantisation noise), bias of noise clipped
// at black, and the share that the frame loses where its residuals exceed what noise explains.
struct Params {
    size: vec2i,             // of the frame
    rows: vec2i,             // of the frame: the first to compute, and the one after the last
    predicted_offset: vec2i, // of frame pixel (0, 0) in the prediction
    out_offset: vec2i,       // of frame pixel (0, 0) in the outputs
    predicted_stride: i32,
    predicted_first: i32,    // row of the prediction that comes first in its binding
    out_stride: i32,
    out_first: i32,          // row of the outputs that comes first in their bindings
    first: i32,              // row of the frame that comes first in the other bindings
    exposure_time: f32,      // s
    robust: f32,             // strength of the residual-driven weights; 0: none
    black_clipped: u32,
    accumulate: u32,
    _pad0: u32,
    _pad1: vec2u,
    // Standard deviation of the exposure (1 = white) at equal steps of sqrt(exposure) from 0 to 1.
    noise: array<vec4f, 64>,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> predicted: array<f32>;  // K E, irradiance
@group(0) @binding(2) var<storage, read> exposure: array<f32>;   // f^-1(Z), 1 = white, or unseen
@group(0) @binding(3) var<storage, read> mask: array<f32>;
@group(0) @binding(4) var<storage, read> misfit: array<f32>;     // local sum of chi^2
@group(0) @binding(5) var<storage, read> counted: array<f32>;    // and of pixels
@group(0) @binding(6) var<storage, read_write> weight: array<f32>;
@group(0) @binding(7) var<storage, read_write> observation: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy) + vec2i(0, params.rows.x);
    if p.x >= params.size.x || p.y >= params.rows.y {
        return;
    }
    let i = at(p - vec2i(0, params.first), params.size.x);
    let irradiance = max(predicted[at(p + params.predicted_offset - vec2i(0, params.predicted_first), params.predicted_stride)], 0.0);
    let expected = irradiance * params.exposure_time;
    let s = noise_of(expected);
    var m = Moments(expected, 1.0, s * s);
    if params.black_clipped == 1u {
        m = clipped_at_black(expected, s);
    }
    let excess = max(misfit[i] / max(counted[i], 1e-6) - 1.0, 0.0);
    let gain = params.exposure_time * m.slope;
    let counts = select(mask[i], 0.0, unseen(exposure[i]));
    let w = counts * counts * gain * gain / (m.variance * (1.0 + params.robust * excess));
    let b = w * (irradiance + (exposure[i] - m.mean) / gain);
    let o = at(p + params.out_offset - vec2i(0, params.out_first), params.out_stride);
    let keep = params.accumulate == 1u;
    weight[o] = select(0.0, weight[o], keep) + w;
    observation[o] = select(0.0, observation[o], keep) + b;
}
