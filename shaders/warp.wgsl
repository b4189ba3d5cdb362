// Warps of eq. (4): out(q) = sum over bases b of weight_b E(H_b^-1 q). Channels together because they share the interpolation
// weights; four pixels of a row per invocation. Rotate-then-shift: one base per plane of the output (invocation z), weight 1. Direct:
// all poses into the frame. E is a copy with a margin of zeros (padded.wgsl): positions beyond are clamped into the margin.
override SUPPORT: i32 = 2;
// Whether to add to what the output holds: no parameter, because software rasterisers run both sides of a branch.
override ACCUMULATE: bool = false;
// Channels that the operator works on at a time: 3, or only the first. What is not written is not read either.
override CHANNELS: u32 = 3u;

struct Params {
    in_size: vec2i,        // of the copy
    offset: vec2i,         // copy pixel of frame pixel (0, 0)
    out_size: vec2i,       // of one plane of the output
    out_origin: vec2i,     // frame pixel of output pixel (0, 0)
    centre: vec2f,         // of the frame, pixels
    out_first: i32,        // row of the binding at which the output begins
    first_base: u32,       // base of invocations with z = 0
    span: u32,             // bases that one invocation sums
    _pad0: u32,
    _pad1: vec2u,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> bases: array<Base>;
@group(0) @binding(2) var<storage, read> in_r: array<f32>;
@group(0) @binding(3) var<storage, read> in_g: array<f32>;
@group(0) @binding(4) var<storage, read> in_b: array<f32>;
@group(0) @binding(5) var<storage, read_write> out_r: array<f32>;
@group(0) @binding(6) var<storage, read_write> out_g: array<f32>;
@group(0) @binding(7) var<storage, read_write> out_b: array<f32>;

// E(H^-1 q).
fn source(abc: vec4f, def: vec4f, q: vec2i) -> vec3f {
    let d = clamp(displacement(abc, def, vec2f(q) - params.centre), vec2f(-1e6), vec2f(1e6));
    let whole = floor(d);
    let f = d - whole;
    let first = clamp(q + params.offset + vec2i(whole) - (SUPPORT - 1), vec2i(0), params.in_size - 2 * SUPPORT);
    let row = u32(params.in_size.x);
    var i = at(first, params.in_size.x);
    if SUPPORT == 1 {
        let j = i + row;
        let top = mix(vec3f(in_r[i], in_g[i], in_b[i]), vec3f(in_r[i + 1u], in_g[i + 1u], in_b[i + 1u]), f.x);
        let bottom = mix(vec3f(in_r[j], in_g[j], in_b[j]), vec3f(in_r[j + 1u], in_g[j + 1u], in_b[j + 1u]), f.x);
        return mix(top, bottom, f.y);
    }
    var sum = vec3f(0.0);
    if SUPPORT == 2 {
        let wx = interpolation4(vec4f(-1.0, 0.0, 1.0, 2.0) - f.x);
        let wy = interpolation4(vec4f(-1.0, 0.0, 1.0, 2.0) - f.y);
        for (var y = 0; y < 4; y += 1) {
            let r = dot(wx, vec4f(in_r[i], in_r[i + 1u], in_r[i + 2u], in_r[i + 3u]));
            let g = dot(wx, vec4f(in_g[i], in_g[i + 1u], in_g[i + 2u], in_g[i + 3u]));
            let b = dot(wx, vec4f(in_b[i], in_b[i + 1u], in_b[i + 2u], in_b[i + 3u]));
            sum += wy[y] * vec3f(r, g, b);
            i += row;
        }
        return sum;
    }
    for (var y = 0; y < 2 * SUPPORT; y += 1) {
        let wy = interpolation(f32(y - SUPPORT + 1) - f.y);
        for (var x = 0; x < 2 * SUPPORT; x += 1) {
            let w = wy * interpolation(f32(x - SUPPORT + 1) - f.x);
            let j = i + u32(x);
            sum += w * vec3f(in_r[j], in_g[j], in_b[j]);
        }
        i += row;
    }
    return sum;
}

fn store(i: u32, value: vec3f) {
    if ACCUMULATE {
        out_r[i] += value.x;
        if CHANNELS > 1u {
            out_g[i] += value.y;
            out_b[i] += value.z;
        }
    } else {
        out_r[i] = value.x;
        if CHANNELS > 1u {
            out_g[i] = value.y;
            out_b[i] = value.z;
        }
    }
}

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u) {
    let j = vec2i(i32(id.x) * 4, i32(id.y));
    if any(j >= params.out_size) {
        return;
    }
    let q = j + params.out_origin;
    var sum = array<vec3f, 4>(vec3f(0.0), vec3f(0.0), vec3f(0.0), vec3f(0.0));
    let first = params.first_base + id.z * params.span;
    for (var b = first; b < first + params.span; b += 1u) {
        let abc = bases[b].abc;
        let def = bases[b].def;
        let weight = bases[b].weight.x;
        sum[0] += weight * source(abc, def, q);
        sum[1] += weight * source(abc, def, q + vec2i(1, 0));
        sum[2] += weight * source(abc, def, q + vec2i(2, 0));
        sum[3] += weight * source(abc, def, q + vec2i(3, 0));
    }
    let plane = u32(params.out_size.x * params.out_size.y);
    let o = id.z * plane + at(j + vec2i(0, params.out_first), params.out_size.x);
    for (var k = 0; k < 4; k += 1) {
        // Each pixel has its own guard: an overrun would write into the next row.
        if j.x + k < params.out_size.x {
            store(o + u32(k), sum[k]);
        }
    }
}
