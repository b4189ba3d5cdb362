// New search direction p = r / diagonal + beta p with beta = <r, z> / <r, z> of the step before, for one channel.
struct Params {
    count: u32,
    row: u32,
    scalars: u32,   // first scalar of the channel
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> scalars: array<f32>;   // as in cg_scalars.wgsl
@group(0) @binding(2) var<storage, read> residual: array<f32>;
@group(0) @binding(3) var<storage, read> diagonal: array<f32>;
@group(0) @binding(4) var<storage, read_write> direction: array<f32>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let g = group.y * params.row + group.x;
    let before = scalars[params.scalars + 2u];
    let beta = select(0.0, scalars[params.scalars] / before, before > 0.0);
    for (var j = 0u; j < EACH; j += 1u) {
        let i = (g * EACH + j) * 128u + local;
        if i < params.count {
            direction[i] = residual[i] / diagonal[i] + beta * direction[i];
        }
    }
}
