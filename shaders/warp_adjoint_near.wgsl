// Exact adjoint of the warps, E(p) += factor * sum over bases b and targets q of weight_b in_b(q) k(u) k(v), where (u, v) is the
// source position of q less p, computed by the same expression as forward. A gather, so no atomics and one result always. For warps
// that turn and stretch little: the targets of four by two neighbouring pixels then lie in one window of 4 + 2 SUPPORT by 2 + 2 SUPPORT
// pixels, and every value of the window is loaded, and its position computed, once for all eight. See Spread::near for "little".
@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let size = params.size;
    let rows = params.rows;
    let in_size = params.in_size;
    let in_origin = params.in_origin;
    let centre = params.centre;
    let plane = params.plane;
    let out_first = params.out_first;
    let factor = params.factor;
    let end = params.first_base + params.bases;
    let p = vec2i(i32(id.x) * 4, i32(id.y) * 2 + rows.x);
    let source = p - params.pad; // in frame pixels
    var b = params.first_base;
    if p.x >= size.x || p.y >= rows.y {
        return;
    }
    let middle = vec2f(source) + vec2f(1.5, 0.5) - centre;
    let corner = in_size - vec2i(4 + 2 * SUPPORT, 1);
    // Sums of red, green and blue, of the upper and the lower row.
    var upper = mat3x4f();
    var lower = mat3x4f();
    var first_pixel = 0u; // of the base's plane
    loop {
        let base = bases[b];
        let to = clamp(displacement(base.abc_inverse, base.def_inverse, middle), vec2f(-1e6), vec2f(1e6));
        let first = source + vec2i(round(to)) - SUPPORT;
        // Columns beyond the input are zero and so is its margin; rows beyond it belong to other bands and count as zero.
        let column = u32(clamp(first.x - in_origin.x, 0, corner.x));
        let shift = vec2f(source - first);
        var y = 0;
        loop {
            let row = first.y + y - in_origin.y;
            let counts = select(0.0, base.weight.x, row >= 0 && row < in_size.y);
            let i = first_pixel + u32(clamp(row, 0, corner.y)) * u32(in_size.x) + column;
            var x = 0;
            loop {
                let d = displacement(base.abc, base.def, vec2f(first + vec2i(x, y)) - centre);
                let u = shift - vec2f(f32(x), f32(y)) - d;
                let w = interpolation4(u.x + vec4f(0.0, 1.0, 2.0, 3.0));
                let value = counts * pixel(i + u32(x));
                let above = interpolation(u.y) * value;
                let below = interpolation(u.y + 1.0) * value;
                upper += mat3x4f(above.x * w, above.y * w, above.z * w);
                lower += mat3x4f(below.x * w, below.y * w, below.z * w);
                x += 1;
                if x >= 4 + 2 * SUPPORT {
                    break;
                }
            }
            y += 1;
            if y >= 2 + 2 * SUPPORT {
                break;
            }
        }
        first_pixel += plane;
        b += 1u;
        if b >= end {
            break;
        }
    }
    let o = at(p - vec2i(0, out_first), size.x);
    for (var k = 0; k < 4; k += 1) {
        // Each pixel has its own guard: an overrun would write into the next row.
        if p.x + k < size.x {
            add(o + u32(k), factor * vec3f(upper[0][k], upper[1][k], upper[2][k]));
            if p.y + 1 < rows.y {
                add(o + u32(k + size.x), factor * vec3f(lower[0][k], lower[1][k], lower[2][k]));
            }
        }
    }
}
