// Sums partial sums into scalars of the conjugate gradients, on the device, so that no number crosses to the host inside the loop; one
// workgroup for each channel. scalars = four for each channel (<r, z>, <p, q>, <r, z> of the step before, objective's data term), then its
// smoothness term.
struct Params {
    first: u32,      // first partial sum of the first channel
    count: u32,      // partial sums of each channel, one channel after another
    slot: u32,       // scalar of the first channel that receives the sum
    shift: u32,      // 1: the scalar two further on receives the old one first
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> partials: array<f32>;
@group(0) @binding(2) var<storage, read_write> scalars: array<f32>;

var<workgroup> shared_sum: array<f32, 128>;

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) local: u32, @builtin(workgroup_id) channel: vec3u) {
    let first = params.first + channel.x * params.count;
    let slot = params.slot + 4u * channel.x;
    var sum = 0.0;
    for (var i = local; i < params.count; i += 128u) {
        sum += partials[first + i];
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
            scalars[slot + 2u] = scalars[slot];
        }
        scalars[slot] = shared_sum[0];
    }
}
