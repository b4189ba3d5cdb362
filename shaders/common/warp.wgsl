// Parameters, inputs and the value of the warps of eq. (4): E(H_b^-1 q). E is a copy with a margin of zeros (padded.wgsl): positions
// beyond are clamped into the margin.
override SUPPORT: i32 = 2;

struct Params {
    in_size: vec2i,        // of the copy
    offset: vec2i,         // copy pixel of frame pixel (0, 0)
    out_size: vec2i,       // of one plane of the output
    out_origin: vec2i,     // frame pixel of output pixel (0, 0)
    centre: vec2f,         // of the frame, pixels
    out_first: i32,        // row of the binding at which the output begins
    first_base: u32,       // of the binding: that of workgroups with z = 0
    span: u32,             // bases that one invocation sums
    _pad0: u32,
    _pad1: vec2u,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<uniform> bases: array<Base, 512>;

// Interpolation within a row of 4 or 6 pixels. Written out, as is the sum over rows, since some drivers do not unroll loops.
fn row4(i: u32, w: vec4f) -> vec3f {
    return w.x * pixel(i) + w.y * pixel(i + 1u) + w.z * pixel(i + 2u) + w.w * pixel(i + 3u);
}

fn row6(i: u32, w: vec4f, v: vec4f) -> vec3f {
    return row4(i, w) + v.x * pixel(i + 4u) + v.y * pixel(i + 5u);
}

// Params that `source` needs: some drivers load uniforms fast only where no branch or loop is open.
struct Grid {
    centre: vec2f,
    offset: vec2i,
    in_size: vec2i,
}

// E(H^-1 q).
fn source(grid: Grid, abc: vec4f, def: vec4f, q: vec2i) -> vec3f {
    let d = clamp(displacement(abc, def, vec2f(q) - grid.centre), vec2f(-1e6), vec2f(1e6));
    let whole = floor(d);
    let f = d - whole;
    let first = clamp(q + grid.offset + vec2i(whole) - (SUPPORT - 1), vec2i(0), grid.in_size - 2 * SUPPORT);
    let row = u32(grid.in_size.x);
    let i = at(first, grid.in_size.x);
    if SUPPORT == 1 {
        let j = i + row;
        return mix(mix(pixel(i), pixel(i + 1u), f.x), mix(pixel(j), pixel(j + 1u), f.x), f.y);
    }
    // Distances to the first four pixels, then to the other two of six.
    let near = vec4f(0.0, 1.0, 2.0, 3.0) - f32(SUPPORT - 1);
    let wx = interpolation4(near - f.x);
    let wy = interpolation4(near - f.y);
    if SUPPORT == 2 {
        return wy.x * row4(i, wx) + wy.y * row4(i + row, wx) + wy.z * row4(i + 2u * row, wx) + wy.w * row4(i + 3u * row, wx);
    }
    let vx = interpolation4(near + 4.0 - f.x);
    let vy = interpolation4(near + 4.0 - f.y);
    let top = wy.x * row6(i, wx, vx) + wy.y * row6(i + row, wx, vx) + wy.z * row6(i + 2u * row, wx, vx);
    return top + wy.w * row6(i + 3u * row, wx, vx) + vy.x * row6(i + 4u * row, wx, vx) + vy.y * row6(i + 5u * row, wx, vx);
}

