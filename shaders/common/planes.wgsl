// Where the blur's kernels write pixels of scratch, at binding 3. No entry points. planes_storage.wgsl is the same for software rasterisers.
@group(0) @binding(3) var<storage, read_write> planes: array<vec4f>;

fn put(i: u32, value: vec3f) {
    planes[i] = vec4f(value, 0.0);
}
