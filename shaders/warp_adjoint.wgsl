// warp_adjoint_near.wgsl for any homography: the targets of p lie within `reach` of round(H_b p).
@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(i32(id.x), i32(id.y) + params.rows.x);
    if p.x >= params.size.x || p.y >= params.rows.y {
        return;
    }
    let source = p - params.pad; // in frame pixels
    let centred = vec2f(source) - params.centre;
    var sum = vec3f(0.0);
    for (var b = 0u; b < params.bases; b += 1u) {
        let base = bases[params.first_base + b];
        let to = clamp(displacement(base.abc_inverse, base.def_inverse, centred), vec2f(-1e6), vec2f(1e6));
        let near = source + vec2i(round(to));
        for (var y = -params.reach; y <= params.reach; y += 1) {
            for (var x = -params.reach; x <= params.reach; x += 1) {
                let q = near + vec2i(x, y);
                let d = displacement(base.abc, base.def, vec2f(q) - params.centre);
                // Distance of p from the source position of q.
                let u = vec2f(source - q) - d;
                let j = q - params.in_origin;
                if abs(u.x) < f32(SUPPORT) && abs(u.y) < f32(SUPPORT) && inside(j, params.in_size) {
                    let w = base.weight.x * interpolation(u.x) * interpolation(u.y);
                    sum += w * pixel(b * params.plane + at(j, params.in_size.x));
                }
            }
        }
    }
    let o = at(p - vec2i(0, params.out_first), params.size.x);
    add(o, params.factor * sum);
}
