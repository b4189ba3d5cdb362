// Rotate-then-shift: one base warp per plane of the output (workgroup z).
@group(0) @binding(3) var planes: texture_storage_2d<rgba32float, write>;

@compute @workgroup_size(16, 8)
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(workgroup_id) group: vec3u) {
    let p = vec2i(id.xy);
    if any(p >= params.out_size) {
        return;
    }
    let b = params.first_base + group.z;
    let value = source(bases[b].abc, bases[b].def, p + params.out_origin);
    let i = group.z * u32(params.out_size.x * params.out_size.y) + at(p, params.out_size.x);
    textureStore(planes, texel(i), vec4f(value, 0.0));
}
