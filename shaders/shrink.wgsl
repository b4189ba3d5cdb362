// Means of factor x factor texels: a picture's next smaller copy (2), or what is drawn already copied to where it is shown (1).

override factor = 1u;

struct Params {
    origin: vec2u,   // pixel of the target at the picture's corner
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var picture: texture_2d<f32>;

@fragment
fn main(@builtin(position) position: vec4f) -> @location(0) vec4f {
    let corner = factor * (vec2u(position.xy) - params.origin);
    let last = textureDimensions(picture) - 1u;
    var sum = vec4f(0.0);
    for (var j = 0u; j < factor; j++) {
        for (var i = 0u; i < factor; i++) {
            sum += textureLoad(picture, min(corner + vec2u(i, j), last), 0);
        }
    }
    return sum / f32(factor * factor);
}
