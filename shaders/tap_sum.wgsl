// The taps of K: the planes of all base warps, shifted, into the frame.
@compute @workgroup_size(32, 4)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let size = params.out_size;
    let first = params.out_first;
    let row = params.in_stride;
    let plane = params.in_plane;
    let group = params.first_group;
    let span = params.span;
    let p = vec2i(i32(id.x), i32(id.y) * TALL);
    if any(p >= size) {
        return;
    }
    let sum = taps(row, plane, p, group, span);
    keep(size.x, (p.y + first) * size.x + p.x, size.y - p.y, sum);
}
