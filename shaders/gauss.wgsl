// One direction of a Gaussian sum over two planes; pixels beyond the border count as 0.
override RADIUS: i32 = 6;

struct Params {
    size: vec2i,
    rows: vec2i,     // the first to compute, and the one after the last
    step: vec2i,     // (1, 0) along rows, (0, 1) along columns
    first: i32,      // row that comes first in the bindings
    sigma: f32,      // pixels
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> in_a: array<f32>;
@group(0) @binding(2) var<storage, read> in_b: array<f32>;
@group(0) @binding(3) var<storage, read_write> out_a: array<f32>;
@group(0) @binding(4) var<storage, read_write> out_b: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy) + vec2i(0, params.rows.x);
    if p.x >= params.size.x || p.y >= params.rows.y {
        return;
    }
    let bound = vec2i(0, params.first);
    var sum = vec2f(0.0);
    for (var k = -RADIUS; k <= RADIUS; k += 1) {
        let q = p + k * params.step;
        if inside(q, params.size) {
            let t = f32(k) / params.sigma;
            let i = at(q - bound, params.size.x);
            sum += exp(-0.5 * t * t) * vec2f(in_a[i], in_b[i]);
        }
    }
    let o = at(p - bound, params.size.x);
    out_a[o] = sum.x;
    out_b[o] = sum.y;
}
