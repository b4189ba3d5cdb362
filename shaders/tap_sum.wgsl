// The translations of the blur, eq. (4): out(p) = sum over taps of weight * in(p - shift), all channels at once. A fractional
// translation is its interpolation kernel splatted on integer shifts, so any number of poses costs as many taps as the camera's path is
// pixels long. Forward: `in` holds the planes of the base warps and one invocation sums them all. Adjoint: mirrored shifts, `in` is the
// frame, one group (invocation z) per base.
//
// An invocation makes eight pixels of a row, and taps come as runs of consecutive shifts in x: a run of n loads 7 + n values of each
// channel for 8 n products (software rasterisers are bound by the number of loads, real GPUs by L1). `in` has a margin that every shift
// stays within, so there is no check of the border, which would cost as much as the loads.
//
// `table` starts with the group index, four entries to a vec4i: entry g is where group g begins, entry g + 1 where it ends.
// A group is its runs one after another; a run is vec4i(place, count, w[0], w[1]) and w[2..count], four to a vec4i, weights as bits.
// `place` is the index of the run's first load for output pixel (0, 0); the k-th shift reads k values further.
// Whether to add to what the output holds: no parameter, because software rasterisers run both sides of a branch.
override ACCUMULATE: bool = false;
// Channels that the operator works on at a time: 3, or only the first. What is not written is not read either.
override CHANNELS: u32 = 3u;

struct Params {
    out_size: vec2i,
    in_stride: i32,    // values per row of the input
    in_plane: i32,     // values from one group's plane of the input to the next
    first_group: u32,  // group of invocations with z = 0
    span: u32,         // groups that one invocation sums
    out_first: i32,    // row of the binding at which the output begins
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<uniform> table: array<vec4i, 4096>;
@group(0) @binding(2) var<storage, read> in_r: array<f32>;
@group(0) @binding(3) var<storage, read> in_g: array<f32>;
@group(0) @binding(4) var<storage, read> in_b: array<f32>;
@group(0) @binding(5) var<storage, read_write> out_r: array<f32>;
@group(0) @binding(6) var<storage, read_write> out_g: array<f32>;
@group(0) @binding(7) var<storage, read_write> out_b: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(i32(id.x) * 8, i32(id.y));
    if any(p >= params.out_size) {
        return;
    }
    var start = p.y * params.in_stride + p.x;
    var red_a = vec4f(0.0);
    var red_b = vec4f(0.0);
    var green_a = vec4f(0.0);
    var green_b = vec4f(0.0);
    var blue_a = vec4f(0.0);
    var blue_b = vec4f(0.0);
    let first = params.first_group + id.z;
    for (var g = first; g < first + params.span; g += 1u) {
        var k = table[g / 4u][g % 4u];
        let h = g + 1u;
        let end = table[h / 4u][h % 4u];
        while k < end {
            let run = table[k];
            k += 1;
            var i = start + run.x;
            var ra = vec4f(in_r[i], in_r[i + 1], in_r[i + 2], in_r[i + 3]);
            var rb = vec4f(in_r[i + 4], in_r[i + 5], in_r[i + 6], in_r[i + 7]);
            var ga = vec4f(in_g[i], in_g[i + 1], in_g[i + 2], in_g[i + 3]);
            var gb = vec4f(in_g[i + 4], in_g[i + 5], in_g[i + 6], in_g[i + 7]);
            var ba = vec4f(in_b[i], in_b[i + 1], in_b[i + 2], in_b[i + 3]);
            var bb = vec4f(in_b[i + 4], in_b[i + 5], in_b[i + 6], in_b[i + 7]);
            i += 8;
            let w = bitcast<f32>(run.z);
            red_a += w * ra;
            red_b += w * rb;
            green_a += w * ga;
            green_b += w * gb;
            blue_a += w * ba;
            blue_b += w * bb;
            var more = vec4f(bitcast<f32>(run.w), 0.0, 0.0, 0.0);
            for (var n = 1; n < run.y; n += 1) {
                if n % 4 == 2 {
                    more = bitcast<vec4f>(table[k]);
                    k += 1;
                }
                // The window moves on by one pixel.
                ra = vec4f(ra.yzw, rb.x);
                rb = vec4f(rb.yzw, in_r[i]);
                ga = vec4f(ga.yzw, gb.x);
                gb = vec4f(gb.yzw, in_g[i]);
                ba = vec4f(ba.yzw, bb.x);
                bb = vec4f(bb.yzw, in_b[i]);
                i += 1;
                red_a += more.x * ra;
                red_b += more.x * rb;
                green_a += more.x * ga;
                green_b += more.x * gb;
                blue_a += more.x * ba;
                blue_b += more.x * bb;
                more = more.yzwx;
            }
        }
        start += params.in_plane;
    }
    let o = (i32(id.z) * params.out_size.y + p.y + params.out_first) * params.out_size.x + p.x;
    let red = array<vec4f, 2>(red_a, red_b);
    let green = array<vec4f, 2>(green_a, green_b);
    let blue = array<vec4f, 2>(blue_a, blue_b);
    for (var c = 0; c < 8; c += 1) {
        // Each pixel has its own guard: an overrun would write into the next row.
        if p.x + c < params.out_size.x {
            if ACCUMULATE {
                out_r[o + c] += red[c / 4][c % 4];
                if CHANNELS > 1u {
                    out_g[o + c] += green[c / 4][c % 4];
                    out_b[o + c] += blue[c / 4][c % 4];
                }
            } else {
                out_r[o + c] = red[c / 4][c % 4];
                if CHANNELS > 1u {
                    out_g[o + c] = green[c / 4][c % 4];
                    out_b[o + c] = blue[c / 4][c % 4];
                }
            }
        }
    }
}
