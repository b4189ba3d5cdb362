// Exact adjoint of K for a tile of the latent grid: per base warp, the shifted sums of the frame where the warp's targets of the tile lie,
// 32 by 32 pixels, then latent(p) += factor * sum over targets q of sums(q) k(u) k(v), where (u, v) is the source position of q less p,
// computed as forward does. A gather, so no atomics and one result always. For warps that turn and stretch little: the targets of four
// pixels of a column then lie in windows of 2 SUPPORT + 1 pixels, each a row below the one before; see Spread::near for "little".
override SUPPORT: i32 = 2;

// The frame, 0 beyond it.
fn seen(q: vec2i) -> vec3f {
    let near = clamp(q, vec2i(0, params.in_rows.x), vec2i(params.in_size.x, params.in_rows.y) - 1);
    let value = pixel((near.y - params.in_first) * params.in_size.x + near.x);
    return select(vec3f(0.0), value, all(near == q));
}

fn towards(base: Base, p: vec2f) -> vec2f {
    return clamp(displacement(base.abc_inverse, base.def_inverse, p), vec2f(-1e6), vec2f(1e6));
}

// Pixels of a row of the window, each with its horizontal weight; w is how far below its source position the topmost pixel lies.
struct Row {
    a: vec4f,
    b: vec4f,
    c: vec4f,
    d: vec4f,
    e: vec4f,
    f: vec4f,
    g: vec4f,
}

// The held pixel i, whose source position is u from the topmost pixel.
fn weighted(u: vec2f, i: i32) -> vec4f {
    return vec4f(interpolation(u.x) * held(i), u.y);
}

// The row that begins with held pixel i, frame pixel `at` (centred), as `wide` as a window or a column less; u is without the
// displacement there.
fn weighted_row(base: Base, at: vec2f, u: vec2f, i: i32, wide: bool) -> Row {
    let d = displacement(base.abc, base.def, at);
    var row = Row();
    if PLANAR {
        // The displacement changes by as much from pixel to pixel everywhere.
        let x = vec2f(1.0 + base.abc.x, base.def.x);
        row.a = weighted(u - d, i);
        row.b = weighted(u - d - x, i + 1);
        if SUPPORT > 1 {
            row.c = weighted(u - d - 2.0 * x, i + 2);
            row.d = weighted(u - d - 3.0 * x, i + 3);
        }
        if SUPPORT > 2 {
            row.e = weighted(u - d - 4.0 * x, i + 4);
            row.f = weighted(u - d - 5.0 * x, i + 5);
        }
        if wide {
            row.g = weighted(u - d - f32(2 * SUPPORT) * x, i + 2 * SUPPORT);
        }
        return row;
    }
    let x = vec2f(1.0, 0.0);
    row.a = weighted(u - d, i);
    row.b = weighted(u - x - displacement(base.abc, base.def, at + x), i + 1);
    if SUPPORT > 1 {
        row.c = weighted(u - 2.0 * x - displacement(base.abc, base.def, at + 2.0 * x), i + 2);
        row.d = weighted(u - 3.0 * x - displacement(base.abc, base.def, at + 3.0 * x), i + 3);
    }
    if SUPPORT > 2 {
        row.e = weighted(u - 4.0 * x - displacement(base.abc, base.def, at + 4.0 * x), i + 4);
        row.f = weighted(u - 5.0 * x - displacement(base.abc, base.def, at + 5.0 * x), i + 5);
    }
    if wide {
        let last = f32(2 * SUPPORT) * x;
        row.g = weighted(u - last - displacement(base.abc, base.def, at + last), i + 2 * SUPPORT);
    }
    return row;
}

// What a row gives to the pixel `below` the topmost.
fn share(row: Row, below: f32, wide: bool) -> vec3f {
    var sum = interpolation(row.a.w + below) * row.a.xyz + interpolation(row.b.w + below) * row.b.xyz;
    if SUPPORT > 1 {
        sum += interpolation(row.c.w + below) * row.c.xyz + interpolation(row.d.w + below) * row.d.xyz;
    }
    if SUPPORT > 2 {
        sum += interpolation(row.e.w + below) * row.e.xyz + interpolation(row.f.w + below) * row.f.xyz;
    }
    if wide {
        sum += interpolation(row.g.w + below) * row.g.xyz;
    }
    return sum;
}

// Adds row y of the windows to the sums for the four pixels; i, at and u are those of row 0.
fn add_row(base: Base, before: mat4x3f, at: vec2f, u: vec2f, i: i32, y: i32, wide: bool) -> mat4x3f {
    let down = vec2f(0.0, f32(y));
    let row = weighted_row(base, at + down, u - down, i + y * SIDE, wide);
    var sum = before;
    if y <= 2 * SUPPORT {
        sum[0] += share(row, 0.0, wide);
    }
    if y >= 1 && y <= 2 * SUPPORT + 1 {
        sum[1] += share(row, 1.0, wide);
    }
    if y >= 2 && y <= 2 * SUPPORT + 2 {
        sum[2] += share(row, 2.0, wide);
    }
    if y >= 3 {
        sum[3] += share(row, 3.0, wide);
    }
    return sum;
}

// The windows that begin with frame pixel q. Written out: some drivers do not unroll the loop over rows.
fn gather_windows(base: Base, p: vec2i, q: vec2i, region: vec2i, wide: bool, before: mat4x3f) -> mat4x3f {
    let first = q - region;
    let i = first.y * SIDE + first.x;
    let at = vec2f(q) - params.centre;
    let u = vec2f(p - q);
    var sum = add_row(base, before, at, u, i, 0, wide);
    sum = add_row(base, sum, at, u, i, 1, wide);
    sum = add_row(base, sum, at, u, i, 2, wide);
    sum = add_row(base, sum, at, u, i, 3, wide);
    sum = add_row(base, sum, at, u, i, 4, wide);
    sum = add_row(base, sum, at, u, i, 5, wide);
    if SUPPORT > 1 {
        sum = add_row(base, sum, at, u, i, 6, wide);
        sum = add_row(base, sum, at, u, i, 7, wide);
    }
    if SUPPORT > 2 {
        sum = add_row(base, sum, at, u, i, 8, wide);
        sum = add_row(base, sum, at, u, i, 9, wide);
    }
    return sum;
}

// Adds to the sums for frame pixel p and the three below it; `region` is the frame pixel of held pixel 0. Each pixel has a window of its
// own, as wide as high. What of it lies beyond the region is no target of the tile: it weighs nothing, whatever is read for it.
//
// Nearly everywhere all targets in the first column of the windows, or all in the last, are too far to weigh anything. Without that
// column the bilinear adjoint takes less time; the others take more.
fn gather(base: Base, p: vec2i, region: vec2i, before: mat4x3f) -> mat4x3f {
    let to = towards(base, vec2f(p) + vec2f(0.0, 1.5) - params.centre);
    let q = p + vec2i(round(to)) - SUPPORT;
    if SUPPORT == 1 {
        // Displacements in x at the corners of all windows; between them they change evenly, but for less than a hundredth of a pixel.
        let at = vec2f(q) - params.centre;
        let down = vec2f(0.0, 5.0);
        let last = vec2f(2.0, 0.0);
        let d0 = max(displacement(base.abc, base.def, at).x, displacement(base.abc, base.def, at + down).x);
        let d2 = min(displacement(base.abc, base.def, at + last).x, displacement(base.abc, base.def, at + last + down).x);
        let u = f32(p.x - q.x);
        if u - d0 >= 1.01 {
            return gather_windows(base, p, q + vec2i(1, 0), region, false, before);
        }
        if u - 2.0 - d2 <= -1.01 {
            return gather_windows(base, p, q, region, false, before);
        }
    }
    return gather_windows(base, p, q, region, true, before);
}

@compute @workgroup_size(32, 8)
fn main(@builtin(local_invocation_id) id: vec3u, @builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3u) {
    let side = params.side;
    let corner = vec2i(group.xy) * side + vec2i(0, params.rows.x); // latent pixel of the tile's first
    let mine = vec2i(i32(id.x), i32(id.y) * TALL);
    let middle = vec2f(f32(side - 1) / 2.0);
    let source = corner - params.pad; // in frame pixels
    var sum = mat4x3f();
    var gathered = mat4x3f();
    for (var g = 0; g < params.groups; g += 1) {
        let box = table[2 * g];
        let run = table[2 * g + 1];
        let base = bases[run.z];
        let to = towards(base, vec2f(source) + middle - params.centre);
        let region = source + vec2i(round(to + middle - 15.5));
        let origin = region + box.xy;
        let reciprocal = 1.0 / f32(box.z);
        workgroupBarrier();
        for (var i = i32(lane); i < box.z * box.w; i += LANES) {
            hold(i, seen(origin + place(i, box.z, reciprocal)));
        }
        workgroupBarrier();
        sum = shifts(sum, mine.y * box.z + mine.x, box.z, run.x, run.y);
        if run.w != 0 {
            workgroupBarrier();
            let i = mine.y * SIDE + mine.x;
            hold(i, sum[0]);
            hold(i + SIDE, sum[1]);
            hold(i + 2 * SIDE, sum[2]);
            hold(i + 3 * SIDE, sum[3]);
            sum = mat4x3f();
            workgroupBarrier();
            if mine.x < side && mine.y < side {
                gathered = gather(base, source + mine, region, gathered);
            }
        }
    }
    let p = corner + mine;
    let left = min(side - mine.y, params.rows.y - p.y);
    if mine.x < side && p.x < params.out_size.x {
        let o = (p.y - params.out_first) * params.out_size.x + p.x;
        keep_four(params.out_size.x, o, left, params.factor * gathered);
    }
}
