// Exact adjoint of K for a tile of the latent grid: per base warp, the shifted sums of the frame where the warp's targets of the tile lie,
// 32 by 32 pixels, then latent(p) += factor * sum over targets q of sums(q) k(u) k(v), where (u, v) is the source position of q less p,
// computed by the same expression as forward. A gather, so no atomics and one result always. For warps that turn and stretch little: the
// targets of a pixel then lie in a window of 2 SUPPORT + 1 pixels; see Blur::near for "little".
override SUPPORT: i32 = 2;

struct Params {
    in_size: vec2i,    // of the frame
    in_rows: vec2i,    // of it: the first that is bound, and the one after the last
    out_size: vec2i,   // of the latent grid
    rows: vec2i,       // of the latent grid: the first to compute, and the one after the last
    pad: vec2i,        // latent pixel of frame pixel (0, 0)
    centre: vec2f,     // of the frame, pixels
    in_first: i32,     // row of the frame that comes first in the binding
    out_first: i32,    // row of the latent grid, likewise
    groups: i32,
    side: i32,         // of a tile
    factor: f32,       // of everything that is added
    _pad0: f32,
    _pad1: vec2f,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(3) var<storage, read_write> latent_r: array<f32>;
@group(0) @binding(4) var<storage, read_write> latent_g: array<f32>;
@group(0) @binding(5) var<storage, read_write> latent_b: array<f32>;
@group(0) @binding(6) var<storage, read> in_r: array<f32>;
@group(0) @binding(7) var<storage, read> in_g: array<f32>;
@group(0) @binding(8) var<storage, read> in_b: array<f32>;

// The frame, 0 beyond it.
fn pixel(q: vec2i) -> vec3f {
    var value = vec3f(0.0);
    if q.x >= 0 && q.x < params.in_size.x && q.y >= params.in_rows.x && q.y < params.in_rows.y {
        let i = (q.y - params.in_first) * params.in_size.x + q.x;
        value.x = in_r[i];
        if CHANNELS > 1u {
            value.y = in_g[i];
            value.z = in_b[i];
        }
    }
    return value;
}

fn towards(base: Base, p: vec2f) -> vec2f {
    return clamp(displacement(base.abc_inverse, base.def_inverse, p), vec2f(-1e6), vec2f(1e6));
}

// What the held pixel i, whose source position is u from the upper of two pixels of a column, gives to either.
fn share(u: vec2f, i: i32) -> mat2x3f {
    let value = interpolation(u.x) * held(i);
    return mat2x3f(interpolation(u.y) * value, interpolation(u.y + 1.0) * value);
}

// The sums for frame pixel p and the one below it; `region` is the frame pixel of held pixel 0.
fn gather(base: Base, p: vec2i, region: vec2i) -> mat2x3f {
    let to = towards(base, vec2f(p) + vec2f(0.0, 0.5) - params.centre);
    let window = vec2i(2 * SUPPORT + 1, 2 * SUPPORT + 2);
    // Targets of a pixel of the tile lie in the region: where the window reaches beyond, it may as well begin later.
    let first = clamp(p + vec2i(round(to)) - SUPPORT - region, vec2i(0), SIDE - window);
    let q = region + first;
    var sum = mat2x3f();
    var i = first.y * SIDE + first.x;
    var at = vec2f(q) - params.centre;
    var u = vec2f(p - q);
    if PLANAR {
        // The displacement changes by as much from pixel to pixel everywhere.
        let x = vec2f(1.0 + base.abc.x, base.def.x);
        let y = vec2f(base.abc.y, 1.0 + base.def.y);
        u -= displacement(base.abc, base.def, at);
        for (var row = 0; row < window.y; row += 1) {
            sum += share(u, i) + share(u - x, i + 1) + share(u - 2.0 * x, i + 2);
            if SUPPORT > 1 {
                sum += share(u - 3.0 * x, i + 3) + share(u - 4.0 * x, i + 4);
            }
            if SUPPORT > 2 {
                sum += share(u - 5.0 * x, i + 5) + share(u - 6.0 * x, i + 6);
            }
            u -= y;
            i += SIDE;
        }
        return sum;
    }
    for (var row = 0; row < window.y; row += 1) {
        for (var x = 0; x < window.x; x += 1) {
            let step = vec2f(f32(x), 0.0);
            sum += share(u - step - displacement(base.abc, base.def, at + step), i + x);
        }
        u.y -= 1.0;
        at.y += 1.0;
        i += SIDE;
    }
    return sum;
}

// Adds what lies in the tile, `left` rows of it, and in the latent grid.
fn add(p: vec2i, left: i32, pair: mat2x3f) {
    if p.x < params.out_size.x {
        let o = (p.y - params.out_first) * params.out_size.x + p.x;
        if left > 0 && p.y < params.rows.y {
            add_one(o, pair[0]);
        }
        if left > 1 && p.y + 1 < params.rows.y {
            add_one(o + params.out_size.x, pair[1]);
        }
    }
}

fn add_one(o: i32, value: vec3f) {
    latent_r[o] += params.factor * value.x;
    if CHANNELS > 1u {
        latent_g[o] += params.factor * value.y;
        latent_b[o] += params.factor * value.z;
    }
}

// Written out, as an index that varies would keep the sums in memory.
fn hold_four(i: i32, pixels: mat4x3f) {
    hold(i, pixels[0]);
    hold(i + SIDE, pixels[1]);
    hold(i + 2 * SIDE, pixels[2]);
    hold(i + 3 * SIDE, pixels[3]);
}

@compute @workgroup_size(32, 4)
fn main(@builtin(local_invocation_id) id: vec3u, @builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3u) {
    let side = params.side;
    let corner = vec2i(group.xy) * side + vec2i(0, params.rows.x); // latent pixel of the tile's first
    let mine = vec2i(i32(id.x), i32(id.y) * TALL);
    let middle = vec2f(f32(side - 1) / 2.0);
    let source = corner - params.pad; // in frame pixels
    var sum = Column();
    // Of pairs of pixels.
    var a = mat2x3f();
    var b = mat2x3f();
    var c = mat2x3f();
    var d = mat2x3f();
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
            hold(i, pixel(origin + place(i, box.z, reciprocal)));
        }
        workgroupBarrier();
        sum = shifts(sum, mine.y * box.z + mine.x, box.z, run.x, run.y);
        if run.w != 0 {
            workgroupBarrier();
            let i = mine.y * SIDE + mine.x;
            hold_four(i, sum.a);
            hold_four(i + 4 * SIDE, sum.b);
            sum = Column();
            workgroupBarrier();
            if mine.x < side {
                if mine.y < side {
                    a += gather(base, source + mine, region);
                }
                if mine.y + 2 < side {
                    b += gather(base, source + mine + vec2i(0, 2), region);
                }
                if mine.y + 4 < side {
                    c += gather(base, source + mine + vec2i(0, 4), region);
                }
                if mine.y + 6 < side {
                    d += gather(base, source + mine + vec2i(0, 6), region);
                }
            }
        }
    }
    if mine.x < side {
        let p = corner + mine;
        add(p, side - mine.y, a);
        add(p + vec2i(0, 2), side - mine.y - 2, b);
        add(p + vec2i(0, 4), side - mine.y - 4, c);
        add(p + vec2i(0, 6), side - mine.y - 6, d);
    }
}
