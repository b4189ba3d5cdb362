// K of a tile of the frame: per group of shifts, the base warp where they read it, E(H_b^-1 q), then their sum. E is 0 beyond the latent
// grid.
override SUPPORT: i32 = 2;

// Where the columns of a window stand, moved into the latent grid, and which of them lie there: the first four, and the other two of six.
struct Columns {
    x: vec4i,
    x2: vec2i,
    inside: vec4<bool>,
    inside2: vec2<bool>,
}

fn columns(first: i32) -> Columns {
    var c = Columns();
    let x = first + vec4i(0, 1, 2, 3);
    c.x = clamp(x, vec4i(0), vec4i(params.in_size.x - 1));
    c.inside = x == c.x;
    if SUPPORT > 2 {
        let x2 = first + vec2i(4, 5);
        c.x2 = clamp(x2, vec2i(0), vec2i(params.in_size.x - 1));
        c.inside2 = x2 == c.x2;
    }
    return c;
}

// Interpolation weights of the columns of a window, 0 beyond the latent grid.
struct Across {
    w: vec4f,
    w2: vec2f,
}

// Of a position `f` right of the window's column SUPPORT - 1.
fn across(c: Columns, f: f32) -> Across {
    let near = vec4f(0.0, 1.0, 2.0, 3.0) - f32(SUPPORT - 1) - f;
    var a = Across();
    if SUPPORT == 1 {
        a.w = select(vec4f(0.0), vec4f(1.0 - f, f, 0.0, 0.0), c.inside);
        return a;
    }
    a.w = select(vec4f(0.0), interpolation4(near), c.inside);
    if SUPPORT > 2 {
        a.w2 = select(vec2f(0.0), interpolation4(near + 4.0).xy, c.inside2);
    }
    return a;
}

// A row of a window, and whether it lies in the latent grid.
struct Row {
    a: vec3f,
    b: vec3f,
    c: vec3f,
    d: vec3f,
    e: vec3f,
    f: vec3f,
    inside: bool,
}

fn row(c: Columns, y: i32) -> Row {
    let ys = clamp(y, params.in_rows.x, params.in_rows.y - 1);
    let start = (ys - params.in_first) * params.in_size.x;
    var r = Row();
    r.inside = y == ys;
    r.a = pixel(start + c.x.x);
    r.b = pixel(start + c.x.y);
    if SUPPORT > 1 {
        r.c = pixel(start + c.x.z);
        r.d = pixel(start + c.x.w);
    }
    if SUPPORT > 2 {
        r.e = pixel(start + c.x2.x);
        r.f = pixel(start + c.x2.y);
    }
    return r;
}

// What a row gives to the pixel of weights `a` that lies `below` the row.
fn share(r: Row, a: Across, below: f32) -> vec3f {
    var sum = a.w.x * r.a + a.w.y * r.b;
    if SUPPORT > 1 {
        sum += a.w.z * r.c + a.w.w * r.d;
    }
    if SUPPORT > 2 {
        sum += a.w2.x * r.e + a.w2.y * r.f;
    }
    return select(0.0, interpolation(below), r.inside) * sum;
}

// H^-1 q - q.
fn displaced(base: Base, q: vec2i) -> vec2f {
    return clamp(displacement(base.abc, base.def, vec2f(q) - params.centre), vec2f(-1e6), vec2f(1e6));
}

// E(q + d).
fn source(d: vec2f, q: vec2i) -> vec3f {
    let whole = floor(d);
    let f = d - whole;
    let first = q + params.pad + vec2i(whole) - (SUPPORT - 1);
    let c = columns(first.x);
    let a = across(c, f.x);
    var sum = vec3f();
    for (var y = 0; y < 2 * SUPPORT; y += 1) {
        sum += share(row(c, first.y + y), a, f.y + f32(SUPPORT - 1 - y));
    }
    return sum;
}

// Adds what row y gives to two pixels `below` it.
fn share_two(before: mat2x3f, c: Columns, y: i32, upper: Across, lower: Across, below: vec2f) -> mat2x3f {
    let r = row(c, y);
    return mat2x3f(before[0] + share(r, upper, below.x), before[1] + share(r, lower, below.y));
}

// E(H^-1 q) and that of the pixel below q. Where both displacements have the same whole pixels, as nearly everywhere, a row of the latent
// grid is loaded once for both. Written out: some drivers do not unroll the loop over rows.
fn two_sources(base: Base, q: vec2i) -> mat2x3f {
    let next = q + vec2i(0, 1);
    let d = displaced(base, q);
    let e = displaced(base, next);
    let whole = floor(d);
    if any(floor(e) != whole) {
        return mat2x3f(source(d, q), source(e, next));
    }
    let first = q + params.pad + vec2i(whole) - (SUPPORT - 1);
    let c = columns(first.x);
    let a = across(c, d.x - whole.x);
    let b = across(c, e.x - whole.x);
    let below = vec2f(d.y, e.y + 1.0) - whole.y + f32(SUPPORT - 1);
    var sum = mat2x3f(share(row(c, first.y), a, below.x), vec3f());
    sum = share_two(sum, c, first.y + 1, a, b, below - 1.0);
    if SUPPORT > 1 {
        sum = share_two(sum, c, first.y + 2, a, b, below - 2.0);
        sum = share_two(sum, c, first.y + 3, a, b, below - 3.0);
    }
    if SUPPORT > 2 {
        sum = share_two(sum, c, first.y + 4, a, b, below - 4.0);
        sum = share_two(sum, c, first.y + 5, a, b, below - 5.0);
    }
    sum[1] += share(row(c, first.y + 2 * SUPPORT), b, below.y - f32(2 * SUPPORT));
    return sum;
}

@compute @workgroup_size(32, 8)
fn main(@builtin(local_invocation_id) id: vec3u, @builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3u) {
    let corner = vec2i(group.xy) * params.side + vec2i(0, params.rows.x); // frame pixel of the tile's first
    let mine = vec2i(i32(id.x), i32(id.y) * TALL);
    var sum = mat4x3f();
    for (var g = 0; g < params.groups; g += 1) {
        let box = table[2 * g];
        let run = table[2 * g + 1];
        let base = bases[run.z];
        let origin = corner + box.xy;
        let reciprocal = 1.0 / f32(box.z);
        workgroupBarrier();
        for (var i = i32(lane); i < box.z * ((box.w + 1) / 2); i += LANES) {
            let at = place(i, box.z, reciprocal) * vec2i(1, 2);
            let pixels = two_sources(base, origin + at);
            let first = at.y * box.z + at.x;
            hold(first, pixels[0]);
            if at.y + 1 < box.w {
                hold(first + box.z, pixels[1]);
            }
        }
        workgroupBarrier();
        sum = shifts(sum, mine.y * box.z + mine.x, box.z, run.x, run.y);
    }
    let p = corner + mine;
    if p.x < params.out_size.x {
        let o = (p.y - params.out_first) * params.out_size.x + p.x;
        keep_four(params.out_size.x, o, params.rows.y - p.y, params.factor * sum);
    }
}
