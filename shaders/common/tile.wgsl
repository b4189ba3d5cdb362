// The design for GPUs: K and its adjoint a tile at a time. What a base warp holds of the tile stands in workgroup memory, and the sums of
// its shifts are formed in registers, so that nothing but input and output touches device memory.
//
// An invocation makes TALL pixels of a column. `table` starts with two entries for every group of shifts that share a base warp: the
// corner of what they read, relative to the tile, and its size; then first and last entry of the shifts, the base, and whether the base's
// shifts end with this group. Entries of shifts are those of taps.wgsl; `place` is relative to the corner.
// Output is that of output.wgsl.
// Pixels that workgroup memory holds.
override HELD: u32 = 1365u;
const SIDE: i32 = 32;
const TALL: i32 = 4;
const LANES: i32 = 256;

struct Params {
    in_size: vec2i,    // of the latent grid (K), of the frame (adjoint)
    in_rows: vec2i,    // of it: the first that is bound, and the one after the last
    out_size: vec2i,   // of the frame (K), of the latent grid (adjoint)
    rows: vec2i,       // of it: the first to compute, and the one after the last
    pad: vec2i,        // latent pixel of frame pixel (0, 0)
    centre: vec2f,     // of the frame, pixels
    in_first: i32,     // row of the input that comes first in the binding
    out_first: i32,    // row of the output, likewise
    groups: i32,
    side: i32,         // of a tile
    factor: f32,       // of everything that is written
    _pad0: f32,
    _pad1: vec2f,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<uniform> bases: array<Base, 512>;
@group(0) @binding(2) var<uniform> table: array<vec4i, 4096>;
@group(0) @binding(6) var<storage, read> in_r: array<f32>;
@group(0) @binding(7) var<storage, read> in_g: array<f32>;
@group(0) @binding(8) var<storage, read> in_b: array<f32>;

// Value i of the input's binding.
fn pixel(i: i32) -> vec3f {
    if CHANNELS > 1u {
        return vec3f(in_r[i], in_g[i], in_b[i]);
    }
    return vec3f(in_r[i], 0.0, 0.0);
}

var<workgroup> held_r: array<f32, HELD>;
var<workgroup> held_g: array<f32, HELD>;
var<workgroup> held_b: array<f32, HELD>;

fn held(i: i32) -> vec3f {
    if CHANNELS > 1u {
        return vec3f(held_r[i], held_g[i], held_b[i]);
    }
    return vec3f(held_r[i], 0.0, 0.0);
}

fn hold(i: i32, value: vec3f) {
    held_r[i] = value.x;
    if CHANNELS > 1u {
        held_g[i] = value.y;
        held_b[i] = value.z;
    }
}

// Pixel i of an image of `width`: without a division of integers, which costs dozens of instructions.
fn place(i: i32, width: i32, reciprocal: f32) -> vec2i {
    let y = i32((f32(i) + 0.5) * reciprocal);
    return vec2i(i - y * width, y);
}

// Adds the shifts `first` to `last` - 1 of what is held, in rows of `row`, to the TALL pixels from index `start` on.
fn shifts(pixels: mat4x3f, start: i32, row: i32, first: i32, last: i32) -> mat4x3f {
    var sum = pixels;
    for (var k = first; k < last; k += 1) {
        let run = table[k];
        let i = start + run.x;
        let w = bitcast<vec3f>(run.yzw);
        let a = mat4x3f(held(i), held(i + row), held(i + 2 * row), held(i + 3 * row));
        sum += w.x * a;
        // No shift follows this one: the same for all invocations.
        if run.z == 0 {
            continue;
        }
        let b = held(i + 4 * row);
        let c = held(i + 5 * row);
        sum += w.y * mat4x3f(a[1], a[2], a[3], b) + w.z * mat4x3f(a[2], a[3], b, c);
    }
    return sum;
}
