// Parameters and bindings of the adjoints of the warps.
override SUPPORT: i32 = 2;
// Channels that the operator works on at a time: 3, or only the first.
override CHANNELS: u32 = 3u;

struct Params {
    size: vec2i,       // of the latent grid
    in_size: vec2i,    // of one plane of the input
    in_origin: vec2i,  // frame pixel of input pixel (0, 0)
    pad: vec2i,        // latent pixel of frame pixel (0, 0)
    centre: vec2f,     // of the frame, pixels
    rows: vec2i,       // of the latent grid: the first one to compute, and the one after the last
    out_first: i32,    // row of the latent grid that comes first in the binding
    plane: u32,        // pixels from one base's plane of the input to the next; 0: all bases read the same
    first_base: u32,   // of the binding
    bases: u32,
    reach: i32,        // of warp_adjoint.wgsl: how far from round(H_b p) the targets of p lie
    factor: f32,       // of everything that is added
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<uniform> bases: array<Base, 512>;
@group(0) @binding(3) var<storage, read_write> latent_r: array<f32>;
@group(0) @binding(4) var<storage, read_write> latent_g: array<f32>;
@group(0) @binding(5) var<storage, read_write> latent_b: array<f32>;

fn add(i: u32, value: vec3f) {
    latent_r[i] += value.x;
    if CHANNELS > 1u {
        latent_g[i] += value.y;
        latent_b[i] += value.z;
    }
}
