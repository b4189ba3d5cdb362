//! Colour that a file holds at a lower resolution than brightness.

use crate::support::files::shared;
use image::{Rgb, RgbImage};
use unshaken::io::{chroma, ldr};

fn ycc(p: [u8; 3]) -> [f64; 3] {
    let [r, g, b] = p.map(f64::from);
    let y = 0.299 * r + 0.587 * g + 0.114 * b;
    [y, (b - y) * 0.5 / 0.886, (r - y) * 0.5 / 0.701]
}

/// What a decoder makes of `picture` when its file holds one colour per block: sums over all blocks with triangular weights.
fn decoded(picture: &RgbImage, block: (u32, u32)) -> RgbImage {
    let (w, h) = picture.dimensions();
    let points = (w.div_ceil(block.0), h.div_ceil(block.1));
    let mut held = vec![[0.0; 3]; (points.0 * points.1) as usize];
    for (x, y, p) in picture.enumerate_pixels() {
        let at = (y / block.1 * points.0 + x / block.0) as usize;
        let [_, blue, red] = ycc(p.0);
        held[at] = [held[at][0] + blue, held[at][1] + red, held[at][2] + 1.0];
    }
    let weights = |i: u32, block: u32, points: u32| -> Vec<f64> {
        let place = ((f64::from(i) + 0.5) / f64::from(block) - 0.5).clamp(0.0, f64::from(points - 1));
        (0..points).map(|k| (1.0 - (place - f64::from(k)).abs()).max(0.0)).collect()
    };
    RgbImage::from_fn(w, h, |x, y| {
        let (across, down) = (weights(x, block.0, points.0), weights(y, block.1, points.1));
        let (mut blue, mut red) = (0.0, 0.0);
        for (k, [b, r, count]) in held.iter().enumerate() {
            let weight = across[k % points.0 as usize] * down[k / points.0 as usize] / count;
            (blue, red) = (blue + weight * b, red + weight * r);
        }
        let luma = ycc(picture.get_pixel(x, y).0)[0];
        let (r, b) = (luma + 1.402 * red, luma + 1.772 * blue);
        Rgb([r, (luma - 0.299 * r - 0.114 * b) / 0.587, b].map(|v| v.round() as u8))
    })
}

fn restored(picture: &RgbImage, block: (u32, u32)) -> RgbImage {
    let mut codes = picture.clone();
    let size = (picture.width() as usize, picture.height() as usize);
    chroma::restore(&mut codes, size, (block.0 as usize, block.1 as usize));
    codes
}

/// Root mean square of the difference in codes, of luma or of both colours.
fn difference(a: &RgbImage, b: &RgbImage, of: std::ops::Range<usize>) -> f64 {
    let squares: f64 = a.pixels().zip(b.pixels()).flat_map(|(p, q)| of.clone().map(|k| (ycc(p.0)[k] - ycc(q.0)[k]).powi(2))).sum();
    (squares / f64::from(a.width() * a.height())).sqrt()
}

/// A dark red disc on a bright bluish ground that grows brighter towards the right.
fn disc(w: u32, h: u32) -> RgbImage {
    RgbImage::from_fn(w, h, |x, y| {
        let (dx, dy) = (f64::from(x) - 0.4 * f64::from(w), f64::from(y) - 0.55 * f64::from(h));
        let light = 0.8 + 0.2 * f64::from(x) / f64::from(w);
        let colour = if dx.hypot(dy) < 0.3 * f64::from(h.min(w)) { [170.0, 50.0, 40.0] } else { [190.0, 205.0, 220.0] };
        Rgb(colour.map(|c| (light * c) as u8))
    })
}

#[test]
fn colour_ends_where_brightness_does() {
    for (size, block) in [((97, 75), (2, 2)), ((96, 76), (2, 1)), ((50, 51), (1, 2)), ((90, 60), (4, 1))] {
        let truth = disc(size.0, size.1);
        let coarse = decoded(&truth, block);
        let fine = restored(&coarse, block);
        let (before, after) = (difference(&truth, &coarse, 1..3), difference(&truth, &fine, 1..3));
        assert!(before > 3.0, "{block:?}: the test has edges of colour, {before:.2}");
        assert!(after < 0.5 * before, "{block:?}: {after:.2} of {before:.2} codes are left");
        assert!(difference(&coarse, &fine, 0..1) < 0.6, "{block:?}: brightness stays");
    }
}

/// Where brightness knows nothing of colour, and where there is no colour.
#[test]
fn colour_without_edges_of_brightness_stays_as_decoded() {
    let alike = RgbImage::from_fn(40, 33, |x, y| {
        // Edges of colour alone, and noise of brightness alone.
        let noise = f64::from((x * 7919 + y * 104_729) % 5);
        let (red, blue) = if x + y < 36 { (30.0, -20.0) } else { (-15.0, 25.0) };
        let luma = 120.0 + noise;
        Rgb([luma + 1.402 * red, luma - 0.714 * red - 0.344 * blue, luma + 1.772 * blue].map(|v: f64| v.round() as u8))
    });
    let coarse = decoded(&alike, (2, 2));
    let (own, changed) = (difference(&alike, &coarse, 1..3), difference(&coarse, &restored(&coarse, (2, 2)), 1..3));
    assert!(changed < 0.25 * own, "changed by {changed:.2} codes, where decoding made {own:.2}");
    let grey = RgbImage::from_fn(31, 20, |x, y| Rgb([(x * y % 256) as u8; 3]));
    assert_eq!(restored(&grey, (2, 2)), grey);
}

#[test]
fn smallest_pictures_keep_their_colour() {
    for size in [(1, 1), (1, 5), (2, 1), (3, 3)] {
        let one = RgbImage::from_pixel(size.0, size.1, Rgb([200, 90, 20]));
        for block in [(2, 2), (2, 1), (1, 2), (4, 1)] {
            for pixel in restored(&one, block).pixels() {
                assert!(pixel.0.iter().zip([200, 90, 20]).all(|(a, b)| a.abs_diff(b) <= 1), "{size:?}, {block:?}: {pixel:?}");
            }
        }
    }
}

/// A photograph (4:2:0) is read so.
#[test]
fn photographs_are_read_with_the_colour_brought_back() {
    let Some(folder) = shared("data/brackets/office") else { return };
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.retain(|p| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg")));
    files.sort();
    let path = &files[files.len() / 2];
    let plain = image::open(path).unwrap().into_rgb8();
    let read = ldr::read(path).unwrap();
    assert!(read.chroma_subsampled);
    let codes = RgbImage::from_fn(plain.width(), plain.height(), |x, y| {
        Rgb(std::array::from_fn(|c| (255.0 * read.intensity.0[c].at(x as usize, y as usize)).round() as u8))
    });
    assert_eq!(codes, restored(&plain, (2, 2)));
    let (luma, colour) = (difference(&plain, &codes, 0..1), difference(&plain, &codes, 1..3));
    assert!(luma < 1.0 && colour > 0.5, "brightness {luma:.2}, colour {colour:.2} codes");
}
