// Software rasterisers load from textures several times as fast as from buffers: there scratch lies in one, read without a sampler. An array
// of pixels, wrapped at rows of 4096: see Gpu::texels. No bindings, no entry points.
fn texel(i: u32) -> vec2u {
    return vec2u(i & 4095u, i >> 12u);
}
