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
fn interpolation(x: f32) -> f32 {
    let t = abs(x);
    if SUPPORT == 1 {
        return max(1.0 - t, 0.0);
    }
    if SUPPORT == 2 {
        let inner = (1.5 * t - 2.5) * t * t + 1.0;
        let outer = ((-0.5 * t + 2.5) * t - 4.0) * t + 2.0;
        return select(select(outer, 0.0, t >= 2.0), inner, t < 1.0);
    }
    let inner = (4.0 / 3.0 * t - 7.0 / 3.0) * t * t + 1.0;
    let middle = ((-7.0 / 12.0 * t + 3.0) * t - 59.0 / 12.0) * t + 2.5;
    let outer = ((1.0 / 12.0 * t - 2.0 / 3.0) * t + 1.75) * t - 1.5;
    return select(select(select(outer, 0.0, t >= 3.0), middle, t < 2.0), inner, t < 1.0);
}

// `interpolation` of four distances.
fn interpolation4(x: vec4f) -> vec4f {
    let t = abs(x);
    if SUPPORT == 1 {
        return max(1.0 - t, vec4f(0.0));
    }
    if SUPPORT == 2 {
        let inner = (1.5 * t - 2.5) * t * t + 1.0;
        let outer = ((-0.5 * t + 2.5) * t - 4.0) * t + 2.0;
        return select(select(outer, vec4f(0.0), t >= vec4f(2.0)), inner, t < vec4f(1.0));
    }
    return vec4f(interpolation(x.x), interpolation(x.y), interpolation(x.z), interpolation(x.w));
}
