// Start of the preconditioned conjugate gradients for one channel: x = 0, p = z = r / diagonal, and <r, z> as one partial
// sum per workgroup.
struct Params {
    count: u32,
    partial: u32,
    row: u32,
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> residual: array<f32>;
@group(0) @binding(2) var<storage, read> diagonal: array<f32>;
@group(0) @binding(3) var<storage, read_write> solution: array<f32>;
@group(0) @binding(4) var<storage, read_write> direction: array<f32>;
@group(0) @binding(5) var<storage, read_write> partials: array<f32>;

var<workgroup> shared_sum: array<f32, 128>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let g = group.y * params.row + group.x;
    var term = 0.0;
    for (var j = 0u; j < EACH; j += 1u) {
        let i = (g * EACH + j) * 128u + local;
        if i < params.count {
            let z = residual[i] / diagonal[i];
            solution[i] = 0.0;
            direction[i] = z;
            term += residual[i] * z;
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
