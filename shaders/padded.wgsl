// A part of an image with a margin of zeros: what lies outside the image reads as 0, so that the kernels that read the copy need no
// check of the border. (Software rasterisers run both sides of every branch.)
// Channels that the operator works on at a time: 3, or only the first.
override CHANNELS: u32 = 3u;
struct Params {
    in_size: vec2i,    // of the image
    out_size: vec2i,
    origin: vec2i,     // image pixel of output pixel (0, 0)
    in_first: i32,     // row of the image that comes first in the binding
    _pad: i32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> in_r: array<f32>;
@group(0) @binding(2) var<storage, read> in_g: array<f32>;
@group(0) @binding(4) var<storage, read> in_b: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let o = vec2i(id.xy);
    if any(o >= params.out_size) {
        return;
    }
    let p = o + params.origin;
    var v = vec3f(0.0);
    if inside(p, params.in_size) {
        let i = at(p - vec2i(0, params.in_first), params.in_size.x);
        v.x = in_r[i];
        if CHANNELS > 1u {
            v.y = in_g[i];
            v.z = in_b[i];
        }
    }
    put(at(o, params.out_size.x), v);
}
