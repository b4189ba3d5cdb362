// What the blur's kernels read, at binding 2: pixels of scratch. No entry points. image_storage.wgsl is the same for software rasterisers.
@group(0) @binding(2) var image: texture_2d<f32>;

fn pixel(i: u32) -> vec3f {
    return textureLoad(image, texel(i), 0).xyz;
}
