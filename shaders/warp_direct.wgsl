// Direct: the poses' warps straight into the frame, out(q) = sum over bases b of weight_b E(H_b^-1 q).
@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let size = params.out_size;
    let origin = params.out_origin;
    let grid = Grid(params.centre, params.offset, params.in_size);
    let first = params.out_first;
    var b = params.first_base;
    let end = b + params.span;
    let p = vec2i(id.xy);
    if any(p >= size) {
        return;
    }
    var sum = vec3f(0.0);
    // The loop ends at its end: some drivers run what follows a break once more, for nobody.
    loop {
        sum += bases[b].weight.x * source(grid, bases[b].abc, bases[b].def, p + origin);
        b += 1u;
        if b >= end {
            break;
        }
    }
    store(i32(at(p + vec2i(0, first), size.x)), sum);
}
