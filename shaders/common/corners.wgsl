@vertex
fn corners(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
    // One triangle that covers the view.
    return vec4f(f32(i32(i & 1u) * 4 - 1), f32(i32(i >> 1u) * 4 - 1), 0.0, 1.0);
}
