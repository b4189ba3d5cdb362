// What the blur's kernels read, at binding 2, and write: pixels of scratch. No entry points. image_storage.wgsl is the same for software
// rasterisers. GPUs read four values from a buffer several times as fast as from a texture.
@group(0) @binding(2) var<storage, read> image: array<vec4f>;

fn pixel(i: u32) -> vec3f {
    return vec4f(image[i]).xyz;
}
