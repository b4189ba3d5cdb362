// Weighted residual W (B - K E) of one channel of one frame, and the data term 1/2 sum W (B - K E)^2 of eq. (8) as one
// partial sum per workgroup. B enters as the weighted observation W B.
struct Params {
    count: u32,
    partial: u32,   // first partial sum
    row: u32,       // invocations per row of workgroups
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> predicted: array<f32>;
@group(0) @binding(2) var<storage, read> weight: array<f32>;
@group(0) @binding(3) var<storage, read> observation: array<f32>;
@group(0) @binding(4) var<storage, read_write> residual: array<f32>;
@group(0) @binding(5) var<storage, read_write> partials: array<f32>;

var<workgroup> shared_sum: array<f32, 128>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) group: vec3u) {
    let g = group.y * params.row + group.x;
    var term = 0.0;
    for (var j = 0u; j < EACH; j += 1u) {
        let i = (g * EACH + j) * 128u + local;
        if i < params.count {
            let r = observation[i] - weight[i] * predicted[i];
            residual[i] = r;
            if weight[i] > 0.0 {
                term += 0.5 * r * r / weight[i];
            }
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
