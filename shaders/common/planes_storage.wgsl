// planes.wgsl for software rasterisers, which read scratch as a texture.
@group(0) @binding(3) var planes: texture_storage_2d<rgba32float, write>;

fn put(i: u32, value: vec3f) {
    textureStore(planes, texel(i), vec4f(value, 0.0));
}
