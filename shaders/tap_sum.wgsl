// The taps of K: the planes of all base warps, shifted, into the frame.
@compute @workgroup_size(32, 4)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let size = params.out_size;
    let first = params.out_first;
    let p = vec2i(i32(id.x), i32(id.y) * TALL);
    let sum = taps(params.in_stride, params.in_plane, p, params.first_group, params.span);
    if p.x < size.x {
        keep(size.x, (p.y + first) * size.x + p.x, size.y - p.y, sum);
    }
}
