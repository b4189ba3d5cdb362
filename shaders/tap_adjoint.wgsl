// The adjoint of the taps, their shifts mirrored: the frame into one plane per base warp (workgroup z).
@group(0) @binding(3) var planes: texture_storage_2d<rgba32float, write>;

fn store(i: i32, value: vec3f) {
    textureStore(planes, texel(u32(i)), vec4f(value, 0.0));
}

@compute @workgroup_size(32, 4)
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(workgroup_id) group: vec3u) {
    let p = vec2i(i32(id.x), i32(id.y) * TALL);
    if any(p >= params.out_size) {
        return;
    }
    let sum = taps(p, params.first_group + group.z, 1u);
    keep((i32(group.z) * params.out_size.y + p.y) * params.out_size.x + p.x, params.out_size.y - p.y, sum);
}
