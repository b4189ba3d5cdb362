// A picture on the screen: exposure, tone curve, overlays.
//
// One fragment is one pixel of the screen. Where it lies in the frame follows from pan and zoom; what lies there is sampled from the
// picture (picture.wgsl) and its smaller copies. The curve c and the colours are those of `tonemap::Operator::apply`, value for value:
// luminance Y shows as c(gain Y), colours keep their ratios to Y and pale where the screen cannot hold them.

struct Overlay {
    size: vec2u,     // pixels of the overlay, without pad
    stride: u32,     // values per row of the plane
    first: u32,      // index of the overlay's first value
}

// What a view does not need is left out of its pipeline: software rasterisers carry out both sides of every branch.
override curve = 1u;        // 0 Reinhard, 1 filmic, 2 none: the picture is toned
override overlay_kind = 0u; // 0 none, 1 mask, 2 residual, 3 clipped
override saturated = true;  // whether colours keep
override extremes = false;  // show what the curve makes white or black
override encoded = true;    // the target takes sRGB codes; else it encodes by itself
override between = false;   // sample between texels; else one

struct Params {
    pan: vec2f,      // point of the frame at the view's corner, pixels of the full frame
    frame: vec2f,    // full frame, pixels
    scale: vec2f,    // texels per pixel of the full frame
    per_pixel: f32,  // pixels of the frame per pixel of the screen
    gain: f32,
    white: f32,
    saturation: f32,
    level: u32,      // of the picture's smaller copies
    reach: f32,      // from the fragment's centre to where it is sampled, texels
    overlay: Overlay,
    linear: u32,     // 1: weigh by distance; 0: the mean
    background: f32, // sRGB code beyond the frame
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var picture: texture_2d<f32>;
@group(0) @binding(2) var<storage, read> overlay: array<f32>;

// Light at `q` (pixels of the frame, the first centre at 0.5).
fn light(q: vec2f) -> vec3f {
    let p = q * params.scale;
    let last = vec2i(textureDimensions(picture, params.level)) - 1;
    if !between {
        return textureLoad(picture, min(vec2i(p), last), params.level).rgb;
    }
    let part = select(vec2f(0.5), fract(p - 0.5), params.linear == 1u);
    let a = clamp(vec2i(floor(p - params.reach)), vec2i(0), last);
    let b = clamp(vec2i(floor(p + params.reach)), vec2i(0), last);
    let upper = mix(textureLoad(picture, a, params.level), textureLoad(picture, vec2i(b.x, a.y), params.level), part.x);
    let lower = mix(textureLoad(picture, vec2i(a.x, b.y), params.level), textureLoad(picture, b, params.level), part.x);
    return mix(upper, lower, part.y).rgb;
}

fn hable(x: f32) -> f32 {
    return (x * (0.22 * x + 0.03) + 0.002) / (x * (0.22 * x + 0.3) + 0.06) - 0.002 / 0.06;
}

fn shown(luminance: f32) -> f32 {
    if curve == 2u {
        return luminance;
    }
    let v = min(luminance * params.gain, 1e12);
    if curve == 1u {
        return hable(2.0 * min(v, params.white)) / hable(2.0 * params.white);
    }
    return v * (1.0 + v / (params.white * params.white)) / (1.0 + v);
}

fn encode(v: vec3f) -> vec3f {
    let x = clamp(v, vec3f(0.0), vec3f(1.0));
    return select(1.055 * pow(x, vec3f(1.0 / 2.4)) - 0.055, 12.92 * x, x <= vec3f(0.0031308));
}

fn decode(v: vec3f) -> vec3f {
    return select(pow((v + 0.055) / 1.055, vec3f(2.4)), v / 12.92, v <= vec3f(0.04045));
}

// Linear Rec. 709 for the screen, 1 is white; w is 1 where the curve ends at white, -1 where it ends at black.
fn tone(linear: vec3f) -> vec4f {
    let own = max(linear, vec3f(0.0));
    let y = dot(own, vec3f(0.2126, 0.7152, 0.0722));
    let s = shown(y);
    if !(y > 0.0 && s > 0.0) {
        return vec4f(0.0, 0.0, 0.0, -1.0);
    }
    var ratio = own / y;
    if !saturated {
        ratio = pow(ratio, vec3f(params.saturation));
    }
    var rgb = min(s, 4.0) * ratio;
    let brightest = max(rgb.r, max(rgb.g, rgb.b));
    if brightest > 1.0 {
        let grey = min(s, 1.0);
        var keep = 0.0;
        if brightest > grey {
            keep = (1.0 - grey) / (brightest - grey);
        }
        rgb = grey + (rgb - grey) * keep;
    }
    var end = 0.0;
    if s >= 0.999 {
        end = 1.0;
    } else if s < 0.0003 {
        end = -1.0;
    }
    return vec4f(rgb, end);
}

// Black, violet, orange, yellow: order in lightness survives a print in grey.
fn heat(t: f32) -> vec3f {
    let u = clamp(t, 0.0, 1.0);
    return vec3f(clamp(1.7 * u, 0.0, 1.0), clamp(1.9 * u - 0.8, 0.0, 1.0), clamp(0.9 * sin(3.1 * u), 0.0, 0.6));
}

@fragment
fn main(@builtin(position) position: vec4f) -> @location(0) vec4f {
    let at = position.xy;
    let q = params.pan + at * params.per_pixel;
    var code = vec3f(params.background);
    if all(q >= vec2f(0.0)) && all(q < params.frame) {
        let toned = tone(light(q));
        code = encode(toned.xyz);
        if extremes && toned.w > 0.5 {
            code = vec3f(0.9, 0.1, 0.1);
        }
        if extremes && toned.w < -0.5 {
            code = vec3f(0.15, 0.3, 0.95);
        }
        if overlay_kind > 0u {
            let o = params.overlay;
            let p = vec2u(clamp(floor(q * vec2f(o.size) / params.frame), vec2f(0.0), vec2f(o.size) - 1.0));
            let v = overlay[o.first + p.y * o.stride + p.x];
            if overlay_kind == 1u {
                // What does not count is red.
                code = mix(code, vec3f(0.85, 0.1, 0.15), 0.75 * (1.0 - v));
            } else if overlay_kind == 2u {
                // chi squared: 1 is what noise explains, 16 is bright.
                code = mix(code * 0.25, heat(0.25 * log2(max(v, 1.0))), step(1.0, v));
            } else if v > 0.5 {
                // Stripes, as cameras show it.
                let stripe = step(0.5, fract((at.x + at.y) / 12.0));
                code = mix(code, vec3f(0.95, 0.75, 0.1), 0.35 + 0.5 * stripe);
            }
        }
    }
    if encoded {
        return vec4f(code, 1.0);
    }
    return vec4f(decode(code), 1.0);
}
