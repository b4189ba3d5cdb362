// One step of the preconditioned conjugate gradients for one channel: x += alpha p, r -= alpha q with alpha = <r, z> / <p, q>,
// and the new <r, z> as one partial sum per workgroup.
struct Params {
    count: u32,
    partial: u32,
    row: u32,
    scalars: u32,   // first scalar of the channel
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> scalars: array<f32>;   // as in cg_scalars.wgsl
@group(0) @binding(2) var<storage, read> direction: array<f32>;
@group(0) @binding(3) var<storage, read> product: array<f32>;
@group(0) @binding(4) var<storage, read> diagonal: array<f32>;
@group(0) @binding(5) var<storage, read_write> solution: array<f32>;
@group(0) @binding(6) var<storage, read_write> residual: array<f32>;
@group(0) @binding(7) var<storage, read_write> partials: array<f32>;

var<workgroup> shared_sum: array<f32, 128>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let g = group.y * params.row + group.x;
    // A search direction without curvature has nothing left to find: alpha 0 ends the iteration in place.
    let energy = scalars[params.scalars];
    let curvature = scalars[params.scalars + 1u];
    let alpha = select(0.0, energy / curvature, curvature > 0.0);
    var term = 0.0;
    for (var j = 0u; j < EACH; j += 1u) {
        let i = (g * EACH + j) * 128u + local;
        if i < params.count {
            solution[i] += alpha * direction[i];
            let r = residual[i] - alpha * product[i];
            residual[i] = r;
            term += r * r / diagonal[i];
        }
    }
    shared_sum[local] = term;
    for (var s = 64u; s > 0u; s >>= 1u) {
        workgroupBarrier();
        if local < s {
            shared_sum[local] += shared_sum[local + s];
        }
    }
    if local == 0u {
        partials[params.partial + g] = shared_sum[0];
    }
}
