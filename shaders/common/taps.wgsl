// The translations of the blur, eq. (4): the sum over taps of weight * image(p - shift). A fractional translation is its interpolation
// kernel splatted on integer shifts, so any number of poses costs as many taps as the camera's path is pixels long.
//
// An invocation makes TALL pixels of a column, and an entry of the table holds up to three shifts that follow one another in y: it loads
// TALL + 2 pixels for three times TALL products, and neighbouring invocations load neighbouring pixels. The image has a margin that every
// shift stays within, so there is no check of the border, which would cost as much as the loads; pixels below the last row read what
// comes next and are not kept, and taps of weight 0 may read it.
//
// `table` starts with the group index, four entries to a vec4i: entry g is where group g begins, entry g + 1 where it ends.
// A group is one entry at least, each vec4i(place, w[0], w[1], w[2]), weights as bits; `place` is the index of the entry's first load
// for output pixel (0, 0), and the k-th shift reads k rows further.
// Pixels are kept as columns of matrices, since some drivers keep arrays in memory; parameters are read before any branch or loop, since
// some drivers read uniforms fast only there.
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

fn four(row: i32, i: i32) -> mat4x3f {
    return mat4x3f(pixel(u32(i)), pixel(u32(i + row)), pixel(u32(i + 2 * row)), pixel(u32(i + 3 * row)));
}

// The sum over the taps of `span` groups from `first` on, for TALL pixels from p on. Loops end at their end: some drivers run what follows
// a break once more, for nobody.
fn taps(row: i32, plane: i32, p: vec2i, first: u32, span: u32) -> Pixels {
    var start = p.y * row + p.x;
    var sum = Pixels();
    var g = first;
    loop {
        var k = table[g / 4u][g % 4u];
        let h = g + 1u;
        let end = table[h / 4u][h % 4u];
        loop {
            let run = table[k];
            let i = start + run.x;
            let a = four(row, i);
            let b = four(row, i + 4 * row);
            let c = four(row, i + 8 * row);
            let d = four(row, i + 12 * row);
            let e = pixel(u32(i + TALL * row));
            let f = pixel(u32(i + (TALL + 1) * row));
            let w = bitcast<vec3f>(run.yzw);
            sum.a += w.x * a + w.y * mat4x3f(a[1], a[2], a[3], b[0]) + w.z * mat4x3f(a[2], a[3], b[0], b[1]);
            sum.b += w.x * b + w.y * mat4x3f(b[1], b[2], b[3], c[0]) + w.z * mat4x3f(b[2], b[3], c[0], c[1]);
            sum.c += w.x * c + w.y * mat4x3f(c[1], c[2], c[3], d[0]) + w.z * mat4x3f(c[2], c[3], d[0], d[1]);
            sum.d += w.x * d + w.y * mat4x3f(d[1], d[2], d[3], e) + w.z * mat4x3f(d[2], d[3], e, f);
            k += 1;
            if k >= end {
                break;
            }
        }
        start += plane;
        g = h;
        if g >= first + span {
            break;
        }
    }
    return sum;
}

// Stores the pixels that lie in the image: `left` of them, from index o on.
fn keep(row: i32, o: i32, left: i32, pixels: Pixels) {
    keep_four(row, o, left, pixels.a);
    keep_four(row, o + 4 * row, left - 4, pixels.b);
    keep_four(row, o + 8 * row, left - 8, pixels.c);
    keep_four(row, o + 12 * row, left - 12, pixels.d);
}
