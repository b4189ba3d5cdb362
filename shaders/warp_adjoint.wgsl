// Exact adjoint of the base warps: E(p) += sum over bases b and targets q of scratch_b(q) k(u) k(v), where (u, v) is the
// source position of q less p, computed by the same expression as forward. A gather: the targets of p lie within `reach`
// of round(H_b p), so no atomics are needed and the result is deterministic. Plain inverse warping is not the adjoint.
override SUPPORT: i32 = 2;

struct Params {
    size: vec2i,           // of the latent grid
    scratch_size: vec2i,
    scratch_origin: vec2i, // frame pixel of scratch pixel (0, 0)
    pad: vec2i,            // latent pixel of frame pixel (0, 0)
    centre: vec2f,         // of the frame, pixels
    first_base: u32,
    bases: u32,
    reach: i32,
    factor: f32,           // of everything that is added
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> bases: array<Base>;
@group(0) @binding(2) var<storage, read> scratch_r: array<f32>;
@group(0) @binding(3) var<storage, read> scratch_g: array<f32>;
@group(0) @binding(4) var<storage, read> scratch_b: array<f32>;
@group(0) @binding(5) var<storage, read_write> latent_r: array<f32>;
@group(0) @binding(6) var<storage, read_write> latent_g: array<f32>;
@group(0) @binding(7) var<storage, read_write> latent_b: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let p = vec2i(id.xy);
    if any(p >= params.size) {
        return;
    }
    let plane = u32(params.scratch_size.x * params.scratch_size.y);
    let source = p - params.pad; // in frame pixels
    let centred = vec2f(source) - params.centre;
    var sum = vec3f(0.0);
    for (var b = 0u; b < params.bases; b += 1u) {
        let base = bases[params.first_base + b];
        let near = source + vec2i(round(displacement(base.abc_inverse, base.def_inverse, centred)));
        for (var y = -params.reach; y <= params.reach; y += 1) {
            for (var x = -params.reach; x <= params.reach; x += 1) {
                let q = near + vec2i(x, y);
                let d = displacement(base.abc, base.def, vec2f(q) - params.centre);
                let whole = floor(d);
                // Same fraction and whole steps as forward: distance of p from the source position of q.
                let u = vec2f(source - q - vec2i(whole)) - (d - whole);
                let j = q - params.scratch_origin;
                if abs(u.x) < f32(SUPPORT) && abs(u.y) < f32(SUPPORT) && inside(j, params.scratch_size) {
                    let w = interpolation(u.x) * interpolation(u.y);
                    let i = b * plane + at(j, params.scratch_size.x);
                    sum += w * vec3f(scratch_r[i], scratch_g[i], scratch_b[i]);
                }
            }
        }
    }
    let o = at(p, params.size.x);
    latent_r[o] += params.factor * sum.x;
    latent_g[o] += params.factor * sum.y;
    latent_b[o] += params.factor * sum.z;
}
