// K of a tile of the frame: per group of shifts, the base warp where they read it, E(H_b^-1 q), then their sum. E is 0 beyond the latent
// grid.
override SUPPORT: i32 = 2;

struct Params {
    in_size: vec2i,    // of the latent grid
    in_rows: vec2i,    // of it: the first that is bound, and the one after the last
    offset: vec2i,     // latent pixel of frame pixel (0, 0)
    out_size: vec2i,   // of the frame
    rows: vec2i,       // of the frame: the first to compute, and the one after the last
    centre: vec2f,     // of the frame, pixels
    in_first: i32,     // row of the latent grid that comes first in the binding
    out_first: i32,    // row of the frame, likewise
    groups: i32,
    _pad: i32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(3) var<storage, read_write> out_r: array<f32>;
@group(0) @binding(4) var<storage, read_write> out_g: array<f32>;
@group(0) @binding(5) var<storage, read_write> out_b: array<f32>;
@group(0) @binding(6) var<storage, read> in_r: array<f32>;
@group(0) @binding(7) var<storage, read> in_g: array<f32>;
@group(0) @binding(8) var<storage, read> in_b: array<f32>;

fn pixel(i: i32) -> vec3f {
    if CHANNELS > 1u {
        return vec3f(in_r[i], in_g[i], in_b[i]);
    }
    return vec3f(in_r[i], 0.0, 0.0);
}

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
    let first = q + params.offset + vec2i(whole) - (SUPPORT - 1);
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

// Whether to add to what the output holds.
override ACCUMULATE: bool = false;

fn store(o: i32, value: vec3f) {
    var sum = value;
    if ACCUMULATE {
        sum.x += out_r[o];
        if CHANNELS > 1u {
            sum.y += out_g[o];
            sum.z += out_b[o];
        }
    }
    out_r[o] = sum.x;
    if CHANNELS > 1u {
        out_g[o] = sum.y;
        out_b[o] = sum.z;
    }
}

@compute @workgroup_size(32, 8)
fn main(@builtin(local_invocation_id) id: vec3u, @builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3u) {
    let corner = vec2i(group.xy) * SIDE + vec2i(0, params.rows.x); // frame pixel of the tile's first
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
        keep_four(params.out_size.x, o, params.rows.y - p.y, sum);
    }
}
