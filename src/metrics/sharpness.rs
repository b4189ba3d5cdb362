//! Sharpness of a picture without a reference: the cumulative probability of blur detection (N. Narvekar and L. Karam, "A No-Reference
//! Image Blur Metric Based on the Cumulative Probability of Blur Detection (CPBD)", 2011).

use crate::image::Plane;

/// Side of the blocks that contrast is measured in, pixels.
const BLOCK: usize = 64;
/// Exponent β of the probability of seeing blur.
const BETA: f64 = 3.6;
/// Part of a block's pixels that must be edges.
const EDGES: f64 = 0.002;
/// Probability up to which an edge counts as sharp: that of the just noticeable width, 1 - 1/e, in steps of a hundredth.
const JUST_NOTICEABLE: usize = 64;
/// Longest walk from an edge to its end, pixels.
const LONGEST: usize = 101;

/// CPBD of a colour picture: of its luma (Rec. 601) in whole codes. See [`cpbd`].
pub fn cpbd_of(picture: &image::RgbImage) -> f64 {
    cpbd(&Plane::from_fn(picture.width() as usize, picture.height() as usize, |x, y| {
        let [r, g, b] = picture.get_pixel(x as u32, y as u32).0.map(f32::from);
        (0.299 * r + 0.587 * g + 0.114 * b).round()
    }))
}

/// CPBD of a grey picture with codes 0..=255: the part of its vertical edges whose blur is not noticeable, 0 (blurred) to 1 (sharp); 0
/// for a picture without edges. A block takes part by its Sobel edges; the paper asks Canny's, which differ in blocks that hold hardly
/// any edge.
pub fn cpbd(grey: &Plane) -> f64 {
    let edges = sobel_edges(grey);
    let (mut histogram, mut total) = ([0usize; 101], 0usize);
    for by in 0..grey.height / BLOCK {
        for bx in 0..grey.width / BLOCK {
            let pixels = (by * BLOCK..(by + 1) * BLOCK).flat_map(|y| (bx * BLOCK..(bx + 1) * BLOCK).map(move |x| (x, y)));
            let (mut low, mut high, mut count) = (f32::MAX, f32::MIN, 0usize);
            let mut widths = Vec::new();
            for (x, y) in pixels {
                let v = grey.at(x, y);
                (low, high) = (low.min(v), high.max(v));
                if edges[y * grey.width + x] {
                    count += 1;
                    widths.extend(width(grey, x, y));
                }
            }
            if count as f64 <= EDGES * (BLOCK * BLOCK) as f64 {
                continue;
            }
            // Just noticeable widths of the experiments: 5 px at low contrast, 3 px above.
            let noticeable = if high - low < 51.0 { 5.0 } else { 3.0 };
            for w in widths {
                let seen = 1.0 - (-(w as f64 / noticeable).powf(BETA)).exp();
                histogram[(seen * 100.0).round_ties_even() as usize] += 1;
                total += 1;
            }
        }
    }
    histogram[..JUST_NOTICEABLE].iter().sum::<usize>() as f64 / total.max(1) as f64
}

/// Vertical edges: squared horizontal Sobel gradient above twice the root of its mean, thinned to local maxima of its row or column.
fn sobel_edges(grey: &Plane) -> Vec<bool> {
    let (w, h) = grey.size();
    let at = |x: usize, y: usize, dx: isize, dy: isize| {
        // The plane is mirrored beyond its border, which repeats the edge pixel.
        f64::from(grey.clamped(x as isize + dx, y as isize + dy))
    };
    let mut strength = vec![0f64; w * h];
    for y in 0..h {
        for x in 0..w {
            let side = |dx: isize| at(x, y, dx, -1) + 2.0 * at(x, y, dx, 0) + at(x, y, dx, 1);
            strength[y * w + x] = ((side(1) - side(-1)) / 8.0).powi(2);
        }
    }
    let threshold = 2.0 * (strength.iter().sum::<f64>() / strength.len().max(1) as f64).sqrt();
    for v in &mut strength {
        if *v <= threshold {
            *v = 0.0;
        }
    }
    let of =
        |x: isize, y: isize| if x < 0 || y < 0 || x >= w as isize || y >= h as isize { 0.0 } else { strength[y as usize * w + x as usize] };
    (0..w * h)
        .map(|i| {
            let (x, y) = ((i % w) as isize, (i / w) as isize);
            let s = strength[i];
            (s > of(x - 1, y) && s > of(x + 1, y)) || (s > of(x, y - 1) && s > of(x, y + 1))
        })
        .collect()
}

/// Width of the edge at (x, y): from the end of its rise to the other, along the row; only for edges whose gradient is nearly horizontal
/// (P. Marziliano et al., "A no-reference perceptual blur metric", 2002).
fn width(grey: &Plane, x: usize, y: usize) -> Option<usize> {
    let (w, h) = grey.size();
    if x == 0 || y == 0 || x + 1 >= w || y + 1 >= h {
        return None;
    }
    let gx = f64::from(grey.at(x + 1, y) - grey.at(x - 1, y));
    let gy = f64::from(grey.at(x, y + 1) - grey.at(x, y - 1));
    // Where the row does not change the angle counts as none; otherwise to the nearest 45°.
    let octant = if gx == 0.0 { 0.0 } else { (gy.atan2(gx).to_degrees() / 45.0).round_ties_even() };
    let sign = match octant.abs() {
        4.0 => -1.0f32,
        0.0 => 1.0,
        _ => return None,
    };
    let walk = |direction: isize| {
        let mut steps = 1;
        while steps < LONGEST {
            let outer = x as isize + direction * (1 + steps as isize);
            if outer < 0 || outer >= w as isize {
                break;
            }
            let change = grey.at(outer as usize, y) - grey.at((outer - direction) as usize, y);
            // Going right a rising edge rises on, going left it falls on.
            if change * sign * direction as f32 <= 0.0 {
                break;
            }
            steps += 1;
        }
        steps
    };
    Some(walk(-1) + walk(1))
}
