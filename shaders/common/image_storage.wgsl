// image.wgsl for software rasterisers: lavapipe reads a storage texture in a third of the instructions that a sampled one takes, whose
// level of detail it works out for every pixel.
@group(0) @binding(2) var image: texture_storage_2d<rgba32float, read>;

fn pixel(i: u32) -> vec3f {
    return textureLoad(image, texel(i)).xyz;
}
