// Exact adjoint of the warps, E(p) += factor * sum over bases b and targets q of weight_b in_b(q) k(u) k(v), where (u, v) is the
// source position of q less p, computed by the same expression as forward. A gather, so no atomics and one result always. For warps
// that turn and stretch little: the targets of four neighbouring pixels then lie in one window of 4 + 2 SUPPORT by 1 + 2 SUPPORT
// pixels, and every value of the window is loaded, and its position computed, once for all four. See Blur::near for "little".
@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(i32(id.x) * 4, i32(id.y) + params.rows.x);
    if p.x >= params.size.x || p.y >= params.rows.y {
        return;
    }
    let source = p - params.pad; // in frame pixels
    let middle = vec2f(source) + vec2f(1.5, 0.0) - params.centre;
    let corner = params.in_size - vec2i(4 + 2 * SUPPORT, 1);
    var red = vec4f(0.0);
    var green = vec4f(0.0);
    var blue = vec4f(0.0);
    for (var b = 0u; b < params.bases; b += 1u) {
        let base = bases[params.first_base + b];
        let to = clamp(displacement(base.abc_inverse, base.def_inverse, middle), vec2f(-1e6), vec2f(1e6));
        let first = source + vec2i(round(to)) - SUPPORT;
        // Columns beyond the input are zero and so is its margin; rows beyond it belong to other bands and count as zero.
        let column = u32(clamp(first.x - params.in_origin.x, 0, corner.x));
        let shift = vec2f(source - first);
        for (var y = 0; y <= 2 * SUPPORT; y += 1) {
            let row = first.y + y - params.in_origin.y;
            let counts = select(0.0, base.weight.x, row >= 0 && row < params.in_size.y);
            let i = b * params.plane + u32(clamp(row, 0, corner.y)) * u32(params.in_size.x) + column;
            for (var x = 0; x < 4 + 2 * SUPPORT; x += 1) {
                let d = displacement(base.abc, base.def, vec2f(first + vec2i(x, y)) - params.centre);
                let u = shift - vec2f(f32(x), f32(y)) - d;
                let w = counts * interpolation(u.y) * interpolation4(u.x + vec4f(0.0, 1.0, 2.0, 3.0));
                let value = pixel(i + u32(x));
                red += w * value.x;
                green += w * value.y;
                blue += w * value.z;
            }
        }
    }
    let o = at(p - vec2i(0, params.out_first), params.size.x);
    for (var k = 0; k < 4; k += 1) {
        // Each pixel has its own guard: an overrun would write into the next row.
        if p.x + k < params.size.x {
            latent_r[o + u32(k)] += params.factor * red[k];
            if CHANNELS > 1u {
                latent_g[o + u32(k)] += params.factor * green[k];
                latent_b[o + u32(k)] += params.factor * blue[k];
            }
        }
    }
}
