// In place: values *= factors.
struct Params {
    count: u32,
    row: u32,
    _pad: vec2u,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> factors: array<f32>;
@group(0) @binding(2) var<storage, read_write> values: array<f32>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let g = group.y * params.row + group.x;
    for (var j = 0u; j < EACH; j += 1u) {
        let i = (g * EACH + j) * 128u + local;
        if i < params.count {
            values[i] *= factors[i];
        }
    }
}
