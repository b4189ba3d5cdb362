// K of a tile of the frame: per group of shifts, the base warp where they read it, E(H_b^-1 q), then their sum. E is 0 beyond the latent
// grid.
override SUPPORT: i32 = 2;

// Interpolation weights of positions of which `valid` exist.
fn weights(x: vec4f, valid: vec4<bool>) -> vec4f {
    return select(vec4f(0.0), interpolation4(x), valid);
}

fn row2(row: i32, x: vec2i, w: vec2f) -> vec3f {
    return w.x * pixel(row + x.x) + w.y * pixel(row + x.y);
}

fn row4(row: i32, x: vec4i, w: vec4f) -> vec3f {
    return row2(row, x.xy, w.xy) + row2(row, x.zw, w.zw);
}

fn row6(row: i32, x: vec4i, w: vec4f, x2: vec2i, w2: vec2f) -> vec3f {
    return row4(row, x, w) + row2(row, x2, w2);
}

// E(H^-1 q).
fn source(abc: vec4f, def: vec4f, q: vec2i) -> vec3f {
    let size = params.in_size;
    let bound = params.in_rows;
    let d = clamp(displacement(abc, def, vec2f(q) - params.centre), vec2f(-1e6), vec2f(1e6));
    let whole = floor(d);
    let f = d - whole;
    let first = q + params.pad + vec2i(whole) - (SUPPORT - 1);
    let start = params.in_first * size.x;
    if SUPPORT == 1 {
        let x = vec2i(first.x, first.x + 1);
        let y = vec2i(first.y, first.y + 1);
        let xs = clamp(x, vec2i(0), vec2i(size.x - 1));
        let ys = clamp(y, vec2i(bound.x), vec2i(bound.y - 1));
        let wx = select(vec2f(0.0), vec2f(1.0 - f.x, f.x), x == xs);
        let wy = select(vec2f(0.0), vec2f(1.0 - f.y, f.y), y == ys);
        return wy.x * row2(ys.x * size.x - start, xs, wx) + wy.y * row2(ys.y * size.x - start, xs, wx);
    }
    let count = vec4i(0, 1, 2, 3);
    let near = vec4f(count) - f32(SUPPORT - 1);
    let x = first.x + count;
    let y = first.y + count;
    let xs = clamp(x, vec4i(0), vec4i(size.x - 1));
    let ys = clamp(y, vec4i(bound.x), vec4i(bound.y - 1));
    let wx = weights(near - f.x, x == xs);
    let wy = weights(near - f.y, y == ys);
    let row = ys * size.x - start;
    if SUPPORT == 2 {
        return wy.x * row4(row.x, xs, wx) + wy.y * row4(row.y, xs, wx) + wy.z * row4(row.z, xs, wx) + wy.w * row4(row.w, xs, wx);
    }
    let x2 = x + 4;
    let y2 = y + 4;
    let xs2 = clamp(x2, vec4i(0), vec4i(size.x - 1));
    let ys2 = clamp(y2, vec4i(bound.x), vec4i(bound.y - 1));
    let vx = weights(near + 4.0 - f.x, x2 == xs2).xy;
    let vy = weights(near + 4.0 - f.y, y2 == ys2).xy;
    let row2 = ys2 * size.x - start;
    let upper = wy.x * row6(row.x, xs, wx, xs2.xy, vx) + wy.y * row6(row.y, xs, wx, xs2.xy, vx) + wy.z * row6(row.z, xs, wx, xs2.xy, vx);
    let lower = wy.w * row6(row.w, xs, wx, xs2.xy, vx) + vy.x * row6(row2.x, xs, wx, xs2.xy, vx) + vy.y * row6(row2.y, xs, wx, xs2.xy, vx);
    return upper + lower;
}

@compute @workgroup_size(32, 8)
fn main(@builtin(local_invocation_id) id: vec3u, @builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3u) {
    let corner = vec2i(group.xy) * params.side + vec2i(0, params.rows.x); // frame pixel of the tile's first
    let mine = vec2i(i32(id.x), i32(id.y) * TALL);
    var sum = mat4x3f();
    for (var g = 0; g < params.groups; g += 1) {
        let box = table[2 * g];
        let run = table[2 * g + 1];
        let abc = bases[run.z].abc;
        let def = bases[run.z].def;
        let origin = corner + box.xy;
        let reciprocal = 1.0 / f32(box.z);
        workgroupBarrier();
        for (var i = i32(lane); i < box.z * box.w; i += LANES) {
            hold(i, source(abc, def, origin + place(i, box.z, reciprocal)));
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
