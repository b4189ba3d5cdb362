// A third of the squared residual over variance of each channel that a pixel shows, and how many thirds of a pixel that is,
// of one frame: the first step of the residual-driven weights. One channel at a time adds its own.
struct Params {
    size: vec2i,             // of the frame
    rows: vec2i,             // of the frame: the first to compute, and the one after the last
    predicted_offset: vec2i, // of frame pixel (0, 0) in the prediction
    predicted_stride: i32,
    predicted_first: i32,    // row of the prediction that comes first in its binding
    first: i32,              // row of the frame that comes first in the other bindings
    exposure_time: f32,      // s
    black_clipped: u32,
    accumulate: u32,         // 0: the first channel
    noise: array<vec4f, 64>, // as in weights.wgsl
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> predicted: array<f32>;  // K E, irradiance
@group(0) @binding(2) var<storage, read> exposure: array<f32>;   // f^-1(Z), 1 = white, or unseen
@group(0) @binding(3) var<storage, read> mask: array<f32>;
@group(0) @binding(4) var<storage, read_write> misfit: array<f32>;
@group(0) @binding(5) var<storage, read_write> counted: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy) + vec2i(0, params.rows.x);
    if p.x >= params.size.x || p.y >= params.rows.y {
        return;
    }
    let i = at(p - vec2i(0, params.first), params.size.x);
    let k = at(p + params.predicted_offset - vec2i(0, params.predicted_first), params.predicted_stride);
    let expected = max(predicted[k], 0.0) * params.exposure_time;
    let s = noise_of(expected);
    var m = Moments(expected, 1.0, s * s);
    if params.black_clipped == 1u {
        m = clipped_at_black(expected, s);
    }
    let r = exposure[i] - m.mean;
    let keep = params.accumulate == 1u;
    let counts = mask[i] > 0.0 && !unseen(exposure[i]);
    misfit[i] = select(0.0, misfit[i], keep) + select(0.0, r * r / m.variance / 3.0, counts);
    counted[i] = select(0.0, counted[i], keep) + select(0.0, 1.0 / 3.0, counts);
}
