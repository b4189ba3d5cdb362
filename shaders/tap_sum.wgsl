// The taps of K: the planes of all base warps, shifted, into the frame.
@compute @workgroup_size(32, 4)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(i32(id.x), i32(id.y) * TALL);
    if any(p >= params.out_size) {
        return;
    }
    let sum = taps(p, params.first_group, params.span);
    keep((p.y + params.out_first) * params.out_size.x + p.x, params.out_size.y - p.y, sum);
}
