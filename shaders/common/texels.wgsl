// Scratch lies in textures, read without a sampler: real GPUs cache them as well as buffers, and software rasterisers load from them
// several times as fast. An array of pixels, wrapped at rows of 4096: see Gpu::texels. No bindings, no entry points.
fn texel(i: u32) -> vec2u {
    return vec2u(i & 4095u, i >> 12u);
}
