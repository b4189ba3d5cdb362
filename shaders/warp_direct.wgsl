// Direct: the poses' warps straight into the frame, out(q) = sum over bases b of weight_b E(H_b^-1 q).
@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy);
    if any(p >= params.out_size) {
        return;
    }
    var sum = vec3f(0.0);
    for (var b = params.first_base; b < params.first_base + params.span; b += 1u) {
        sum += bases[b].weight.x * source(bases[b].abc, bases[b].def, p + params.out_origin);
    }
    store(i32(at(p + vec2i(0, params.out_first), params.out_size.x)), sum);
}
