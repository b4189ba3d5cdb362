// Direct: the poses' warps straight into the frame, out(q) = sum over bases b of weight_b E(H_b^-1 q).
// Whether to add to what the output holds: no parameter, because software rasterisers run both sides of a branch.
override ACCUMULATE: bool = false;
// Channels that the operator works on at a time: 3, or only the first.
override CHANNELS: u32 = 3u;

@group(0) @binding(3) var<storage, read_write> out_r: array<f32>;
@group(0) @binding(4) var<storage, read_write> out_g: array<f32>;
@group(0) @binding(5) var<storage, read_write> out_b: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy);
    if any(p >= params.out_size) {
        return;
    }
    var sum = vec3f(0.0);
    for (var b = params.first_base; b < params.first_base + params.span; b += 1u) {
        sum += bases[b].weight.x * source(bases[b].abc, bases[b].def, p + params.out_origin);
    }
    let o = at(p + vec2i(0, params.out_first), params.out_size.x);
    if ACCUMULATE {
        out_r[o] += sum.x;
        if CHANNELS > 1u {
            out_g[o] += sum.y;
            out_b[o] += sum.z;
        }
    } else {
        out_r[o] = sum.x;
        if CHANNELS > 1u {
            out_g[o] = sum.y;
            out_b[o] = sum.z;
        }
    }
}
