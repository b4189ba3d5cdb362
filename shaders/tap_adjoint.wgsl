// The adjoint of the taps, their shifts mirrored: the frame into one plane per base warp (workgroup z).
fn store(i: i32, value: vec3f) {
    put(u32(i), value);
}

@compute @workgroup_size(32, 4)
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(workgroup_id) group: vec3u) {
    let size = params.out_size;
    let row = params.in_stride;
    let first = params.first_group;
    let p = vec2i(i32(id.x), i32(id.y) * TALL);
    if any(p >= size) {
        return;
    }
    let sum = taps(row, 0, p, first + group.z, 1u);
    keep(size.x, (i32(group.z) * size.y + p.y) * size.x + p.x, size.y - p.y, sum);
}
