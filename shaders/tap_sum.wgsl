// The translations of the blur, eq. (4): out(p) = sum over taps of weight * in_plane(p - shift), zero outside `input`. A
// fractional translation is its interpolation kernel splatted on integer shifts, so any number of poses costs as many taps
// as the camera's path is pixels long. Forward: `input` holds the base warps, one group sums them all. Adjoint: mirrored
// shifts, `input` is the frame, one group (invocation z) per base.
// Taps come as runs of consecutive shifts in x and an invocation makes four pixels of a row: a run of n taps then costs
// n + 3 loads for 4 n products (software rasterisers are bound by the number of loads).
struct Params {
    in_size: vec2i,
    out_size: vec2i,
    origin: vec2i,     // input pixel of output pixel (0, 0) at shift 0
    accumulate: u32,   // 1: add to what the output holds
    first_group: u32,  // group of invocations with z = 0
    span: u32,         // groups that one invocation sums
    first_plane: u32,  // input plane that comes first in `input`
}

struct Run {
    plane: u32,        // input plane
    length: u32,
    weight: u32,       // first weight; runs are padded by three zero weights on either side
    y: i32,            // input row less output row (origin included by the kernel)
    x: i32,            // input column, less output column, of the last tap: the smallest
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> groups: array<u32>;  // first run of each group, and the end of the last
@group(0) @binding(2) var<storage, read> runs: array<Run>;
@group(0) @binding(3) var<storage, read> weights: array<f32>;
@group(0) @binding(4) var<storage, read> input: array<f32>;
@group(0) @binding(5) var<storage, read_write> output: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(i32(id.x) * 4, i32(id.y));
    if any(p >= params.out_size) {
        return;
    }
    let in_plane = params.in_size.x * params.in_size.y;
    var sum = vec4f(0.0);
    for (var k = groups[params.first_group + id.z]; k < groups[params.first_group + id.z + params.span]; k += 1u) {
        let run = runs[k];
        let y = p.y + params.origin.y + run.y;
        if y < 0 || y >= params.in_size.y {
            continue;
        }
        let row = i32(run.plane - params.first_plane) * in_plane + y * params.in_size.x;
        let x0 = p.x + params.origin.x + run.x;
        let n = i32(run.length);
        // w holds the weights that the pixel loaded now has in the four outputs.
        var w = vec4f(0.0);
        if x0 >= 0 && x0 + n + 3 <= params.in_size.x {
            for (var m = 0; m < n + 3; m += 1) {
                w = vec4f(weights[i32(run.weight) + n + 2 - m], w.xyz);
                sum += input[row + x0 + m] * w;
            }
        } else {
            for (var m = 0; m < n + 3; m += 1) {
                w = vec4f(weights[i32(run.weight) + n + 2 - m], w.xyz);
                let x = x0 + m;
                if x >= 0 && x < params.in_size.x {
                    sum += input[row + x] * w;
                }
            }
        }
    }
    let o = i32(id.z) * params.out_size.x * params.out_size.y + p.y * params.out_size.x + p.x;
    for (var c = 0; c < 4; c += 1) {
        // Each pixel has its own guard: an overrun would write into the next row.
        if p.x + c < params.out_size.x {
            output[o + c] = select(0.0, output[o + c], params.accumulate == 1u) + sum[c];
        }
    }
}
