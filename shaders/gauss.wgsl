// One direction of a Gaussian sum over a plane of pairs; pixels beyond the border count as (0, 0).
override RADIUS: i32 = 6;

struct Params {
    size: vec2i,
    step: vec2i,     // (1, 0) along rows, (0, 1) along columns
    sigma: f32,      // pixels
    _pad: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> input: array<vec2f>;
@group(0) @binding(2) var<storage, read_write> output: array<vec2f>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy);
    if any(p >= params.size) {
        return;
    }
    var sum = vec2f(0.0);
    for (var k = -RADIUS; k <= RADIUS; k += 1) {
        let q = p + k * params.step;
        if inside(q, params.size) {
            let t = f32(k) / params.sigma;
            sum += exp(-0.5 * t * t) * input[at(q, params.size.x)];
        }
    }
    output[at(p, params.size.x)] = sum;
}
