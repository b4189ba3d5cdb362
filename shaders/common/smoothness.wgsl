// D^T w D x at pixel p, which is value i of the bindings, for forward differences D that are zero across the border. No bindings, no
// entry points; the including kernel declares `edge` (w) and the pointer-free accessor `value(i)` of x.
fn smoothness(p: vec2i, i: u32, size: vec2i) -> f32 {
    let row = u32(size.x);
    let here = value(i);
    let weight = edge[i];
    var sum = 0.0;
    if p.x + 1 < size.x { sum += weight * (here - value(i + 1u)); }
    if p.y + 1 < size.y { sum += weight * (here - value(i + row)); }
    if p.x > 0 { sum += edge[i - 1u] * (here - value(i - 1u)); }
    if p.y > 0 { sum += edge[i - row] * (here - value(i - row)); }
    return sum;
}

// Diagonal of D^T w D.
fn smoothness_diagonal(p: vec2i, i: u32, size: vec2i) -> f32 {
    var sum = 0.0;
    if p.x + 1 < size.x { sum += edge[i]; }
    if p.y + 1 < size.y { sum += edge[i]; }
    if p.x > 0 { sum += edge[i - 1u]; }
    if p.y > 0 { sum += edge[i - u32(size.x)]; }
    return sum;
}
