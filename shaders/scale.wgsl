// First step of the product A x for one channel: scaled = E x, and the part of the frames whose TSF is the identity,
// back = W0 E x.
struct Params {
    count: u32,
    row: u32,
    _pad: vec2u,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> irradiance: array<f32>;
@group(0) @binding(2) var<storage, read> direction: array<f32>;
@group(0) @binding(3) var<storage, read> weight: array<f32>;
@group(0) @binding(4) var<storage, read_write> scaled: array<f32>;
@group(0) @binding(5) var<storage, read_write> back: array<f32>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let g = group.y * params.row + group.x;
    for (var j = 0u; j < EACH; j += 1u) {
        let i = (g * EACH + j) * 128u + local;
        if i < params.count {
            let t = irradiance[i] * direction[i];
            scaled[i] = t;
            back[i] = weight[i] * t;
        }
    }
}
