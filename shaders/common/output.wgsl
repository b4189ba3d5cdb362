// What K writes, and its adjoint by tiles: one or three planes, at bindings 3 to 5. No entry points.
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
