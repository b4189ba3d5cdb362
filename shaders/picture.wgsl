// Planes to a picture that fragments sample: linear Rec. 709 at half precision.
//
// Half precision holds 11 bits and some thirty stops about 1, where the matrix puts the middle of the light: less than a tenth of a
// code of the screen, and a quarter of what the planes take to read. Done once per picture; zoom, pan, exposure and curve come later.

struct Picture {
    size: vec2u,     // pixels of the picture, without pad
    stride: u32,     // values per row of the planes
    first: u32,      // index of the picture's first value
}

struct Params {
    matrix: array<vec4f, 3>, // columns: the planes' RGB to Rec. 709, in units of the picture
    place: Picture,
    factor: u32,     // pixels per texel, along each side; 1 unless a texture cannot be so large
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> red: array<f32>;
@group(0) @binding(2) var<storage, read> green: array<f32>;
@group(0) @binding(3) var<storage, read> blue: array<f32>;

@fragment
fn main(@builtin(position) position: vec4f) -> @location(0) vec4f {
    let corner = params.factor * vec2u(position.xy);
    var sum = vec3f(0.0);
    for (var j = 0u; j < params.factor; j++) {
        for (var i = 0u; i < params.factor; i++) {
            let q = min(corner + vec2u(i, j), params.place.size - 1u);
            let at = params.place.first + q.y * params.place.stride + q.x;
            sum += vec3f(red[at], green[at], blue[at]);
        }
    }
    let v = sum / f32(params.factor * params.factor);
    let own = params.matrix[0].xyz * v.r + params.matrix[1].xyz * v.g + params.matrix[2].xyz * v.b;
    // The largest number of half precision is 65504.
    return vec4f(clamp(own, vec3f(-65000.0), vec3f(65000.0)), 1.0);
}
