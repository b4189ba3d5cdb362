// Sums partial sums into one scalar of the conjugate gradients, on the device, so that no number crosses to the host
// inside the loop. scalars = (<r, z>, <p, q>, <r, z> of the step before, objective's data term, smoothness term).
struct Params {
    first: u32,      // first partial sum
    count: u32,
    slot: u32,       // scalar that receives the sum
    shift: u32,      // 1: scalars[2] receives the old scalars[0] first
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> partials: array<f32>;
@group(0) @binding(2) var<storage, read_write> scalars: array<f32>;

var<workgroup> shared_sum: array<f32, 128>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32) {
    var sum = 0.0;
    for (var i = local; i < params.count; i += 128u) {
        sum += partials[params.first + i];
    }
    shared_sum[local] = sum;
    for (var s = 64u; s > 0u; s >>= 1u) {
        workgroupBarrier();
        if local < s {
            shared_sum[local] += shared_sum[local + s];
        }
    }
    if local == 0u {
        if params.shift == 1u {
            scalars[2] = scalars[0];
        }
        scalars[params.slot] = shared_sum[0];
    }
}
