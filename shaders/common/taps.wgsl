// The translations of the blur, eq. (4): the sum over taps of weight * image(p - shift). A fractional translation is its interpolation
// kernel splatted on integer shifts, so any number of poses costs as many taps as the camera's path is pixels long.
//
// An invocation makes TALL pixels of a column, and taps come as runs of consecutive shifts in y: a run of n loads TALL - 1 + n pixels for
// TALL n products, and neighbouring invocations load neighbouring pixels. The image has a margin that every shift stays within, so there
// is no check of the border, which would cost as much as the loads; pixels below the last row read what comes next and are not kept.
//
// `table` starts with the group index, four entries to a vec4i: entry g is where group g begins, entry g + 1 where it ends.
// A group is its runs one after another; a run is vec4i(place, count, w[0], w[1]) and w[2..count], four to a vec4i, weights as bits.
// `place` is the index of the run's first load for output pixel (0, 0); the k-th shift reads k rows further.
// Pixels are kept as columns of matrices, since some drivers keep arrays in memory.
const TALL: i32 = 16;

struct Params {
    out_size: vec2i,
    in_stride: i32,    // pixels per row of the input
    in_plane: i32,     // pixels from one group's plane of the input to the next
    first_group: u32,  // that of workgroups with z = 0
    span: u32,         // groups that one invocation of K sums
    out_first: i32,    // row of the binding at which the output begins
    _pad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<uniform> table: array<vec4i, 4096>;

// Consecutive pixels of a column.
struct Pixels {
    a: mat4x3f,
    b: mat4x3f,
    c: mat4x3f,
    d: mat4x3f,
}

fn four(i: i32) -> mat4x3f {
    let row = params.in_stride;
    return mat4x3f(pixel(u32(i)), pixel(u32(i + row)), pixel(u32(i + 2 * row)), pixel(u32(i + 3 * row)));
}

// The sum over the taps of `span` groups from `first` on, for TALL pixels from p on.
fn taps(p: vec2i, first: u32, span: u32) -> Pixels {
    let row = params.in_stride;
    var start = p.y * params.in_stride + p.x;
    var sum = Pixels();
    for (var g = first; g < first + span; g += 1u) {
        var k = table[g / 4u][g % 4u];
        let h = g + 1u;
        let end = table[h / 4u][h % 4u];
        while k < end {
            let run = table[k];
            k += 1;
            var i = start + run.x;
            var a = four(i);
            var b = four(i + 4 * row);
            var c = four(i + 8 * row);
            var d = four(i + 12 * row);
            i += TALL * row;
            let w = bitcast<f32>(run.z);
            sum.a += w * a;
            sum.b += w * b;
            sum.c += w * c;
            sum.d += w * d;
            var more = vec4f(bitcast<f32>(run.w), 0.0, 0.0, 0.0);
            for (var n = 1; n < run.y; n += 1) {
                if n % 4 == 2 {
                    more = bitcast<vec4f>(table[k]);
                    k += 1;
                }
                // The window moves on by one pixel.
                a = mat4x3f(a[1], a[2], a[3], b[0]);
                b = mat4x3f(b[1], b[2], b[3], c[0]);
                c = mat4x3f(c[1], c[2], c[3], d[0]);
                d = mat4x3f(d[1], d[2], d[3], pixel(u32(i)));
                i += row;
                sum.a += more.x * a;
                sum.b += more.x * b;
                sum.c += more.x * c;
                sum.d += more.x * d;
                more = more.yzwx;
            }
        }
        start += params.in_plane;
    }
    return sum;
}

// Stores the pixels that lie in the image: `left` of them, from index o on.
fn keep(o: i32, left: i32, pixels: Pixels) {
    let row = params.out_size.x;
    keep_four(o, left, pixels.a);
    keep_four(o + 4 * row, left - 4, pixels.b);
    keep_four(o + 8 * row, left - 8, pixels.c);
    keep_four(o + 12 * row, left - 12, pixels.d);
}

fn keep_four(o: i32, left: i32, pixels: mat4x3f) {
    let row = params.out_size.x;
    if left > 0 {
        store(o, pixels[0]);
    }
    if left > 1 {
        store(o + row, pixels[1]);
    }
    if left > 2 {
        store(o + 2 * row, pixels[2]);
    }
    if left > 3 {
        store(o + 3 * row, pixels[3]);
    }
}
