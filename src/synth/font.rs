//! A small stroke font: capitals, digits and punctuation as polylines, drawn at any size.

/// Strokes of `c` (small letters as capitals): polylines of (x, y) with x in 0..=4 and y in 0..=6, y down. A stroke of
/// two equal points is a dot; unknown characters have no strokes.
pub fn strokes(c: char) -> Vec<Vec<(f32, f32)>> {
    glyph(c.to_ascii_uppercase())
        .split(' ')
        .filter(|s| !s.is_empty())
        .map(|s| s.as_bytes().chunks_exact(2).map(|p| (f32::from(p[0] - b'0'), f32::from(p[1] - b'0'))).collect())
        .collect()
}

/// Distance from one character to the next, in the units of [`strokes`].
pub const ADVANCE: f32 = 6.0;
/// Height of a capital, in the units of [`strokes`].
pub const HEIGHT: f32 = 6.0;

/// Straight pieces of `text` whose capitals are `height` high and whose first character has its upper left corner at
/// the origin, running to the right.
pub fn segments(text: &str, height: f32) -> Vec<[(f32, f32); 2]> {
    let k = height / HEIGHT;
    let mut out = Vec::new();
    for (i, c) in text.chars().enumerate() {
        let x0 = i as f32 * ADVANCE;
        for s in strokes(c) {
            for w in s.windows(2) {
                out.push([((x0 + w[0].0) * k, w[0].1 * k), ((x0 + w[1].0) * k, w[1].1 * k)]);
            }
        }
    }
    out
}

/// Width of `text` whose capitals are `height` high.
pub fn width(text: &str, height: f32) -> f32 {
    (text.chars().count() as f32 * ADVANCE - (ADVANCE - 4.0)).max(0.0) * height / HEIGHT
}

/// Distance from (x, y) to a straight piece.
pub fn distance([a, b]: [(f32, f32); 2], x: f32, y: f32) -> f32 {
    let (dx, dy) = (b.0 - a.0, b.1 - a.1);
    let t = (((x - a.0) * dx + (y - a.1) * dy) / (dx * dx + dy * dy).max(1e-9)).clamp(0.0, 1.0);
    let (u, v) = (x - a.0 - t * dx, y - a.1 - t * dy);
    (u * u + v * v).sqrt()
}

/// Writes light `text` on the dark ground of `image`; upper left corner at (x, y), capitals `height` pixels high.
pub fn write(image: &mut image::RgbImage, text: &str, x: f32, y: f32, height: f32) {
    let radius = 0.07 * height;
    for [a, b] in segments(text, height) {
        let (a, b) = ((a.0 + x, a.1 + y), (b.0 + x, b.1 + y));
        let range = |p: f32, q: f32, n: u32| ((p.min(q) - 2.0).max(0.0) as u32, ((p.max(q) + 3.0) as u32).min(n));
        let ((x0, x1), (y0, y1)) = (range(a.0, b.0, image.width()), range(a.1, b.1, image.height()));
        for v in y0..y1 {
            for u in x0..x1 {
                let cover = (radius + 0.5 - distance([a, b], u as f32, v as f32)).clamp(0.0, 1.0);
                let pixel = &mut image.get_pixel_mut(u, v).0;
                *pixel = pixel.map(|c| c.max((235.0 * cover) as u8));
            }
        }
    }
}

fn glyph(c: char) -> &'static str {
    match c {
        'A' => "062046 1434",
        'B' => "06003041423303 3344453606",
        'C' => "4130100105163645",
        'D' => "06002042442606",
        'E' => "40000646 0333",
        'F' => "400006 0333",
        'G' => "41301001051636454323",
        'H' => "0006 4046 0343",
        'I' => "1030 2026 1636",
        'J' => "4045361605",
        'K' => "0006 4004 1346",
        'L' => "000646",
        'M' => "0600234046",
        'N' => "06004640",
        'O' => "100105163645413010",
        'P' => "06003041423303",
        'Q' => "100105163645413010 2446",
        'R' => "06003041423303 2346",
        'S' => "413010010213334445361605",
        'T' => "0040 2026",
        'U' => "000516364540",
        'V' => "002640",
        'W' => "0016223640",
        'X' => "0046 4006",
        'Y' => "0023 4023 2326",
        'Z' => "00400646",
        '0' => "100105163645413010 1531",
        '1' => "112026 1636",
        '2' => "01103041420646",
        '3' => "01103041423323 334445361605",
        '4' => "36300444",
        '5' => "400002324345361605",
        '6' => "30100105163645443303",
        '7' => "004016",
        '8' => "100102133344453616050413 3342413010",
        '9' => "16364541301001021343",
        '.' => "2626",
        ',' => "2617",
        ':' => "2222 2525",
        '-' => "1333",
        '+' => "0343 2125",
        '/' => "0640",
        '%' => "4006 1111 3535",
        '(' => "30121436",
        ')' => "10323416",
        '=' => "0242 0444",
        '!' => "2024 2626",
        '\'' => "2021",
        _ => "",
    }
}
