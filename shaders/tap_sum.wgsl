// The translations of the blur, eq. (4): out(p) = sum over taps of weight * in_plane(p - shift), zero outside `in`, three
// channels at once. A fractional translation is its interpolation kernel splatted on integer shifts, so any number of poses
// costs as many taps as the camera's path is pixels long. Forward: `in` holds the base warps and one invocation sums them
// all. Adjoint: mirrored shifts, `in` is the frame, one group (invocation z) per base.
//
// Taps come as runs of consecutive shifts in x, and an invocation makes eight pixels of a row: a block of four loads per
// channel then serves 32 products (software rasterisers are bound by the number of loads, real GPUs by L1). The taps are
// uniform, which makes their loads free even there.
//
// `table` starts with the group index, four entries to a vec4i: entry g is where group g begins, entry g + 1 where it ends.
// A group is its runs one after another; a run is vec4i(plane, blocks, y, x) and its `blocks` vec4f of weights as bits.
// (x, y) is the input pixel of the run's first load less the output pixel; load m of the run has weight t[m - k] in output
// k = 0..7, where t is the run's weights in order, zero outside.
struct Params {
    in_size: vec2i,
    out_size: vec2i,
    origin: vec2i,     // input pixel of output pixel (0, 0) at shift 0
    accumulate: u32,   // 1: add to what the output holds
    first_group: u32,  // group of invocations with z = 0
    span: u32,         // groups that one invocation sums
    first_plane: u32,  // input plane that comes first in `in`
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<uniform> table: array<vec4i, 4096>;
@group(0) @binding(2) var<storage, read> in_r: array<f32>;
@group(0) @binding(3) var<storage, read> in_g: array<f32>;
@group(0) @binding(4) var<storage, read> in_b: array<f32>;
@group(0) @binding(5) var<storage, read_write> out_r: array<f32>;
@group(0) @binding(6) var<storage, read_write> out_g: array<f32>;
@group(0) @binding(7) var<storage, read_write> out_b: array<f32>;

fn products(v: vec4f, last: vec4f, now: vec4f) -> vec4f {
    return vec4f(
        dot(v, now),
        dot(v, vec4f(last.w, now.xyz)),
        dot(v, vec4f(last.zw, now.xy)),
        dot(v, vec4f(last.yzw, now.x)),
    );
}

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(i32(id.x) * 8, i32(id.y));
    if any(p >= params.out_size) {
        return;
    }
    let in_plane = params.in_size.x * params.in_size.y;
    let g = params.first_group + id.z;
    let h = g + params.span;
    var k = table[g / 4u][g % 4u];
    let end = table[h / 4u][h % 4u];
    var red = array<vec4f, 2>(vec4f(0.0), vec4f(0.0));
    var green = array<vec4f, 2>(vec4f(0.0), vec4f(0.0));
    var blue = array<vec4f, 2>(vec4f(0.0), vec4f(0.0));
    while k < end {
        let run = table[k];
        k += 1;
        let blocks = run.y;
        let y = p.y + params.origin.y + run.z;
        let x0 = p.x + params.origin.x + run.w;
        if y >= 0 && y < params.in_size.y {
            let row = (run.x - i32(params.first_plane)) * in_plane + y * params.in_size.x;
            var last = vec4f(0.0);
            var before = vec4f(0.0);
            if x0 >= 0 && x0 + 4 * blocks <= params.in_size.x {
                var i = row + x0;
                for (var n = 0; n < blocks; n += 1) {
                    let now = bitcast<vec4f>(table[k + n]);
                    let r = vec4f(in_r[i], in_r[i + 1], in_r[i + 2], in_r[i + 3]);
                    let g = vec4f(in_g[i], in_g[i + 1], in_g[i + 2], in_g[i + 3]);
                    let b = vec4f(in_b[i], in_b[i + 1], in_b[i + 2], in_b[i + 3]);
                    red[0] += products(r, last, now);
                    red[1] += products(r, before, last);
                    green[0] += products(g, last, now);
                    green[1] += products(g, before, last);
                    blue[0] += products(b, last, now);
                    blue[1] += products(b, before, last);
                    before = last;
                    last = now;
                    i += 4;
                }
            } else {
                for (var b = 0; b < blocks; b += 1) {
                    let now = bitcast<vec4f>(table[k + b]);
                    var v = array<vec4f, 3>(vec4f(0.0), vec4f(0.0), vec4f(0.0));
                    for (var c = 0; c < 4; c += 1) {
                        let x = x0 + 4 * b + c;
                        if x >= 0 && x < params.in_size.x {
                            v[0][c] = in_r[row + x];
                            v[1][c] = in_g[row + x];
                            v[2][c] = in_b[row + x];
                        }
                    }
                    red[0] += products(v[0], last, now);
                    red[1] += products(v[0], before, last);
                    green[0] += products(v[1], last, now);
                    green[1] += products(v[1], before, last);
                    blue[0] += products(v[2], last, now);
                    blue[1] += products(v[2], before, last);
                    before = last;
                    last = now;
                }
            }
        }
        k += blocks;
    }
    let o = i32(id.z) * params.out_size.x * params.out_size.y + p.y * params.out_size.x + p.x;
    for (var c = 0; c < 8; c += 1) {
        // Each pixel has its own guard: an overrun would write into the next row.
        if p.x + c < params.out_size.x {
            if params.accumulate == 1u {
                out_r[o + c] += red[c / 4][c % 4];
                out_g[o + c] += green[c / 4][c % 4];
                out_b[o + c] += blue[c / 4][c % 4];
            } else {
                out_r[o + c] = red[c / 4][c % 4];
                out_g[o + c] = green[c / 4][c % 4];
                out_b[o + c] = blue[c / 4][c % 4];
            }
        }
    }
}
