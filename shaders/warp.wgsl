// Base warps of the forward blur K, eq. (4): scratch_b(q) = E(H_b^-1 q) for every base b (invocation z), three channels at
// once because they share the interpolation weights. E is zero outside its grid.
override SUPPORT: i32 = 2;

struct Params {
    size: vec2i,           // of the latent grid
    scratch_size: vec2i,
    scratch_origin: vec2i, // frame pixel of scratch pixel (0, 0)
    pad: vec2i,            // latent pixel of frame pixel (0, 0)
    centre: vec2f,         // of the frame, pixels
    first_base: u32,
    bases: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> bases: array<Base>;
@group(0) @binding(2) var<storage, read> latent_r: array<f32>;
@group(0) @binding(3) var<storage, read> latent_g: array<f32>;
@group(0) @binding(4) var<storage, read> latent_b: array<f32>;
@group(0) @binding(5) var<storage, read_write> scratch_r: array<f32>;
@group(0) @binding(6) var<storage, read_write> scratch_g: array<f32>;
@group(0) @binding(7) var<storage, read_write> scratch_b: array<f32>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let j = vec2i(id.xy);
    if any(j >= params.scratch_size) {
        return;
    }
    let base = bases[params.first_base + id.z];
    let q = j + params.scratch_origin;
    let d = displacement(base.abc, base.def, vec2f(q) - params.centre);
    let whole = floor(d);
    let f = d - whole;
    let first = q + params.pad + vec2i(whole) - (SUPPORT - 1);
    var sum = vec3f(0.0);
    let far = first + 2 * SUPPORT;
    if SUPPORT == 2 && all(first >= vec2i(0)) && all(far <= params.size) {
        // The weights of a row are computed once; this path makes nearly all pixels.
        let wx = vec4f(interpolation(-1.0 - f.x), interpolation(-f.x), interpolation(1.0 - f.x), interpolation(2.0 - f.x));
        let wy = vec4f(interpolation(-1.0 - f.y), interpolation(-f.y), interpolation(1.0 - f.y), interpolation(2.0 - f.y));
        var i = at(first, params.size.x);
        for (var y = 0; y < 4; y += 1) {
            let r = dot(wx, vec4f(latent_r[i], latent_r[i + 1u], latent_r[i + 2u], latent_r[i + 3u]));
            let g = dot(wx, vec4f(latent_g[i], latent_g[i + 1u], latent_g[i + 2u], latent_g[i + 3u]));
            let b = dot(wx, vec4f(latent_b[i], latent_b[i + 1u], latent_b[i + 2u], latent_b[i + 3u]));
            sum += wy[y] * vec3f(r, g, b);
            i += u32(params.size.x);
        }
    } else {
        for (var y = 0; y < 2 * SUPPORT; y += 1) {
            let wy = interpolation(f32(y - SUPPORT + 1) - f.y);
            for (var x = 0; x < 2 * SUPPORT; x += 1) {
                let p = first + vec2i(x, y);
                let w = wy * interpolation(f32(x - SUPPORT + 1) - f.x);
                if inside(p, params.size) && w != 0.0 {
                    let i = at(p, params.size.x);
                    sum += w * vec3f(latent_r[i], latent_g[i], latent_b[i]);
                }
            }
        }
    }
    let o = id.z * u32(params.scratch_size.x * params.scratch_size.y) + at(j, params.scratch_size.x);
    scratch_r[o] = sum.x;
    scratch_g[o] = sum.y;
    scratch_b[o] = sum.z;
}
