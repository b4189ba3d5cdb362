// The taps of K: the planes of all base warps, shifted, into the frame.
// Whether to add to what the output holds: no parameter, because software rasterisers run both sides of a branch.
override ACCUMULATE: bool = false;
// Channels that the operator works on at a time: 3, or only the first.
override CHANNELS: u32 = 3u;

@group(0) @binding(3) var<storage, read_write> out_r: array<f32>;
@group(0) @binding(4) var<storage, read_write> out_g: array<f32>;
@group(0) @binding(5) var<storage, read_write> out_b: array<f32>;

fn store(i: i32, value: vec3f) {
    if ACCUMULATE {
        out_r[i] += value.x;
        if CHANNELS > 1u {
            out_g[i] += value.y;
            out_b[i] += value.z;
        }
    } else {
        out_r[i] = value.x;
        if CHANNELS > 1u {
            out_g[i] = value.y;
            out_b[i] = value.z;
        }
    }
}

@compute @workgroup_size(32, 4)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(i32(id.x), i32(id.y) * TALL);
    if any(p >= params.out_size) {
        return;
    }
    let sum = taps(p, params.first_group, params.span);
    keep((p.y + params.out_first) * params.out_size.x + p.x, params.out_size.y - p.y, sum);
}
