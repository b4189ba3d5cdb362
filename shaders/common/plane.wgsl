// Index arithmetic shared by all kernels. No bindings, no entry points.

// Row-major index of pixel p in a plane of the given row length.
fn at(p: vec2i, stride: i32) -> u32 {
    return u32(p.y * stride + p.x);
}

fn inside(p: vec2i, size: vec2i) -> bool {
    return all(p >= vec2i(0)) && all(p < size);
}
