// Warps of the latent irradiance by homographies, eq. (2), and the interpolation kernel. No bindings, no entry points.

// A base warp as the displacement d(q) = H^-1 q - q in centred pixels. Only displacements are stored (cosines less one),
// because an absolute f32 position loses 5e-4 px at 6000 px width where the displacement loses 6e-6 px.
struct Base {
    // d = (a x + b y + c - x (g x + h y), d x + e y + f - y (g x + h y)) / (g x + h y + 1)
    abc: vec4f,   // a, b, c, g
    def: vec4f,   // d, e, f, h
    // The forward map H p = p + displacement, in the same form: where to look for the targets of a source pixel.
    abc_inverse: vec4f,
    def_inverse: vec4f,
    weight: vec4f,        // of what the warp adds, three times nothing
}

// Whether g and h are 0 for all bases.
override PLANAR: bool = false;

fn displacement(abc: vec4f, def: vec4f, p: vec2f) -> vec2f {
    if PLANAR {
        return vec2f(abc.x * p.x + abc.y * p.y + abc.z, def.x * p.x + def.y * p.y + def.z);
    }
    let s = abc.w * p.x + def.w * p.y;
    let n = vec2f(abc.x * p.x + abc.y * p.y + abc.z - p.x * s, def.x * p.x + def.y * p.y + def.z - p.y * s);
    return n / (s + 1.0);
}

// Interpolation weight at distance x. SUPPORT 1: linear; 2: cubic convolution (Keys 1981, a = -1/2); 3: Keys' six-point
// cubic convolution of fourth order. SUPPORT is an `override` of the including kernel.
//
// The pieces of the cubics as sums: below 1 both terms (or all three) count, beyond only those whose base is not 0. A choice between the
// pieces would compute all of them in full.
fn interpolation(x: f32) -> f32 {
    let t = abs(x);
    let w = max(1.0 - t, 0.0);
    if SUPPORT == 1 {
        return w;
    }
    let v = max(2.0 - t, 0.0);
    if SUPPORT == 2 {
        return v * v * (0.5 * v - 0.5) + w * w * (1.0 - 2.0 * w);
    }
    let u = max(3.0 - t, 0.0);
    return u * u * (1.0 / 12.0 - u / 12.0) + v * v * (2.0 / 3.0 * v - 1.0 / 3.0) + w * w * (5.0 / 12.0 - 23.0 / 12.0 * w);
}

// `interpolation` of four distances.
fn interpolation4(x: vec4f) -> vec4f {
    let t = abs(x);
    let w = max(1.0 - t, vec4f(0.0));
    if SUPPORT == 1 {
        return w;
    }
    let v = max(2.0 - t, vec4f(0.0));
    if SUPPORT == 2 {
        return v * v * (0.5 * v - 0.5) + w * w * (1.0 - 2.0 * w);
    }
    let u = max(3.0 - t, vec4f(0.0));
    return u * u * (1.0 / 12.0 - u / 12.0) + v * v * (2.0 / 3.0 * v - 1.0 / 3.0) + w * w * (5.0 / 12.0 - 23.0 / 12.0 * w);
}
