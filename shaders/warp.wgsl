// Rotate-then-shift: one base warp per plane of the output (workgroup z). WIDE pixels of a row per invocation, ACROSS apart: what a warp
// needs to know of its base is then read once for all, and neighbouring invocations still write neighbouring pixels.
const WIDE: i32 = 8;
const ACROSS: i32 = 32;

@compute @workgroup_size(32, 4)
fn main(@builtin(local_invocation_id) id: vec3u, @builtin(workgroup_id) group: vec3u) {
    let size = params.out_size;
    let origin = params.out_origin;
    let grid = Grid(params.centre, params.offset, params.in_size);
    let base = params.first_base + group.z;
    let abc = bases[base].abc;
    let def = bases[base].def;
    let y = i32(group.y) * 4 + i32(id.y);
    let first = group.z * u32(size.x * size.y) + u32(y * size.x);
    let end = min(size.x, i32(group.x + 1u) * WIDE * ACROSS);
    var x = i32(group.x) * WIDE * ACROSS + i32(id.x);
    if x >= end || y >= size.y {
        return;
    }
    // The loop ends at its end: some drivers run what follows a break once more, for nobody.
    loop {
        put(first + u32(x), source(grid, abc, def, vec2i(x, y) + origin));
        x += ACROSS;
        if x >= end {
            break;
        }
    }
}
