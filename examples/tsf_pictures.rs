//! Pictures of an estimated TSF beside the truth, for docs/: `cargo run --release --example tsf_pictures -- docs/pictures`.
//!
//! Reconstructs the demo's bracket and draws, for its longest frame, the local PSFs (`tsf-psfs.jpg`), the TSF in three projections
//! (`tsf-projections.jpg`) and the camera's path over the frame (`tsf-path.jpg`).

use glam::DVec2;
use image::{Rgb, RgbImage};
use std::path::Path;
use unshaken::cli::demo;
use unshaken::pipeline::{self, Settings};
use unshaken::pose::project;
use unshaken::response::Response;
use unshaken::synth::font;
use unshaken::tonemap;
use unshaken::tsf::{Tsf, TsfEntry};

const TRUE: [u8; 3] = [120, 230, 120];
const FOUND: [u8; 3] = [255, 120, 80];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args().nth(1).ok_or("name a folder for the pictures")?;
    let folder = Path::new(&folder);
    let made = demo::bracket()?;
    let outcome = pipeline::merge(&made.bracket, &Response::Srgb, &Settings::default(), None, &mut |_| true)?;
    let last = made.tsfs.len() - 1;
    let report = &outcome.report["frames"][last];
    let entry: TsfEntry = serde_json::from_value(report["tsf"].clone())?;
    let found = Tsf::new(entry.focal_px, entry.poses)?;
    println!("model {}, {} poses", report["blur"]["model"], found.poses.len());
    let size = made.bracket.size();
    psfs(&report["blur"]["patches"], &made.tsfs[last], &found, size).save(folder.join("tsf-psfs.jpg"))?;
    projections(&made.tsfs[last], &found).save(folder.join("tsf-projections.jpg"))?;
    let tone_mapped = tonemap::preview(&made.truth);
    path(tone_mapped, &made.tsfs[last], &found, size).save(folder.join("tsf-path.jpg"))?;
    Ok(())
}

/// Draws `text` with its upper left corner at (x, y).
fn write(image: &mut RgbImage, text: &str, x: f32, y: f32, colour: [u8; 3]) {
    for [a, b] in font::segments(text, 11.0) {
        line(
            image,
            DVec2::new(f64::from(a.0 + x), f64::from(a.1 + y)),
            DVec2::new(f64::from(b.0 + x), f64::from(b.1 + y)),
            0.8,
            colour,
            1.0,
        );
    }
}

/// Draws a straight line `width` pixels wide.
fn line(image: &mut RgbImage, a: DVec2, b: DVec2, width: f64, colour: [u8; 3], strength: f64) {
    let (lo, hi) = (a.min(b) - width - 1.0, a.max(b) + width + 2.0);
    let clip = |v: f64, n: u32| v.clamp(0.0, f64::from(n)) as u32;
    for y in clip(lo.y, image.height())..clip(hi.y, image.height()) {
        for x in clip(lo.x, image.width())..clip(hi.x, image.width()) {
            let ends = [a, b].map(|p| (p.x as f32, p.y as f32));
            let d = f64::from(font::distance(ends, x as f32, y as f32));
            let cover = (0.5 * width + 0.5 - d).clamp(0.0, 1.0) * strength;
            let p = image.get_pixel_mut(x, y);
            *p = Rgb(std::array::from_fn(|c| (f64::from(p.0[c]) * (1.0 - cover) + f64::from(colour[c]) * cover) as u8));
        }
    }
}

/// Fills a square of `side` pixels with a map of `values`, `n` x `n`, brightest white.
fn tile(image: &mut RgbImage, values: &[f64], n: usize, x: u32, y: u32, side: u32) {
    let top = values.iter().fold(1e-12f64, |m, v| m.max(*v));
    for j in 0..side {
        for i in 0..side {
            let (u, v) = (i as usize * n / side as usize, j as usize * n / side as usize);
            let z = (values[v * n + u] / top).max(0.0).sqrt();
            image.put_pixel(x + i, y + j, Rgb([(255.0 * z) as u8; 3]));
        }
    }
}

/// The PSF that `tsf` makes at the centred point `p`, bilinear on a square of side 2 `radius` + 1: eq. (5).
fn psf_at(tsf: &Tsf, p: DVec2, radius: isize) -> Vec<f64> {
    let n = 2 * radius + 1;
    let mut out = vec![0.0; (n * n) as usize];
    for pose in &tsf.poses {
        let u = p - project(&pose.homography(tsf.focal_px).inverse(), p);
        let f = u - u.floor();
        for (j, wy) in [(0, 1.0 - f.y), (1, f.y)] {
            for (i, wx) in [(0, 1.0 - f.x), (1, f.x)] {
                let (x, y) = (u.x.floor() as isize + i + radius, u.y.floor() as isize + j + radius);
                if (0..n).contains(&x) && (0..n).contains(&y) {
                    out[(y * n + x) as usize] += pose.weight * wx * wy;
                }
            }
        }
    }
    out
}

fn psfs(patches: &serde_json::Value, truth: &Tsf, found: &Tsf, size: (usize, usize)) -> RgbImage {
    let (side, gap) = (120u32, 8u32);
    let mut list: Vec<(DVec2, f64, isize, Vec<f64>)> = Vec::new();
    for p in patches.as_array().into_iter().flatten() {
        let n = |k: &str| p[k].as_f64().unwrap_or(0.0);
        let centre = DVec2::new(n("x"), n("y")) + (n("size") - 1.0) / 2.0;
        let values = p["psf"]["values"].as_array().into_iter().flatten().filter_map(serde_json::Value::as_f64).collect();
        list.push((centre, n("confidence"), p["psf"]["radius"].as_i64().unwrap_or(0) as isize, values));
    }
    list.sort_by_key(|a| (a.0.y as i64 / 96, a.0.x as i64));
    let columns = 3;
    let cell = (3 * (side + gap) + 2 * gap, side + gap + 20);
    let rows = list.len().div_ceil(columns) as u32;
    let mut image = RgbImage::from_pixel(columns as u32 * cell.0, rows * cell.1 + 24, Rgb([40, 40, 40]));
    for c in 0..columns as u32 {
        for (k, name) in ["TRUE", "PATCH", "TSF"].iter().enumerate() {
            write(&mut image, name, (c * cell.0 + gap + k as u32 * (side + gap)) as f32, 6.0, [230; 3]);
        }
    }
    let middle = DVec2::new(size.0 as f64 - 1.0, size.1 as f64 - 1.0) / 2.0;
    for (k, (centre, confidence, radius, values)) in list.iter().enumerate() {
        let (x, y) = ((k % columns) as u32 * cell.0 + gap, (k / columns) as u32 * cell.1 + 24);
        let n = (2 * radius + 1) as usize;
        for (i, map) in
            [psf_at(truth, *centre - middle, *radius), values.clone(), psf_at(found, *centre - middle, *radius)].iter().enumerate()
        {
            tile(&mut image, map, n, x + i as u32 * (side + gap), y, side);
        }
        let text = format!("AT {:.0},{:.0}  CONFIDENCE {confidence:.2}", centre.x, centre.y);
        write(&mut image, &text, x as f32, (y + side + 5) as f32, [200; 3]);
    }
    image
}

/// Three projections of both TSFs, one over the other.
fn projections(truth: &Tsf, found: &Tsf) -> RgbImage {
    let (side, gap) = (260.0, 40.0);
    let mut image = RgbImage::from_pixel((3.0 * (side + gap) + gap) as u32, (side + 2.0 * gap) as u32, Rgb([40, 40, 40]));
    let axes: [fn(&unshaken::pose::Pose) -> f64; 3] = [|p| p.t_x, |p| p.t_y, |p| p.theta_z_deg];
    let names = ["TX", "TY", "ROLL"];
    let range = |f: fn(&unshaken::pose::Pose) -> f64| {
        let all = truth.poses.iter().chain(&found.poses).map(f);
        let (a, b) = all.fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        (a - 0.1 * (b - a), b + 0.1 * (b - a))
    };
    for (column, (i, j)) in [(0, 1), (0, 2), (1, 2)].into_iter().enumerate() {
        let o = DVec2::new(gap + column as f64 * (side + gap), gap);
        for (a, b) in [(DVec2::ZERO, DVec2::X), (DVec2::X, DVec2::ONE), (DVec2::ONE, DVec2::Y), (DVec2::Y, DVec2::ZERO)] {
            line(&mut image, o + a * side, o + b * side, 1.0, [110; 3], 1.0);
        }
        let (x, y) = (range(axes[i]), range(axes[j]));
        let at = |p: &unshaken::pose::Pose| DVec2::new((axes[i](p) - x.0) / (x.1 - x.0), (axes[j](p) - y.0) / (y.1 - y.0)) * side + o;
        for pair in truth.poses.windows(2) {
            line(&mut image, at(&pair[0]), at(&pair[1]), 1.5, TRUE, 0.6);
        }
        let top = found.poses.iter().map(|p| p.weight).fold(0.0, f64::max);
        for p in &found.poses {
            line(&mut image, at(p), at(p), 3.0 + 6.0 * (p.weight / top).sqrt(), FOUND, 0.9);
        }
        write(&mut image, &format!("{} {:.1} TO {:.1}", names[i], x.0, x.1), o.x as f32, (o.y + side + 8.0) as f32, [210; 3]);
        write(&mut image, &format!("{} {:.1} TO {:.1}", names[j], y.0, y.1), o.x as f32, (o.y - 17.0) as f32, [210; 3]);
    }
    write(&mut image, "TRUE", (gap + 165.0) as f32, 23.0, TRUE);
    write(&mut image, "FOUND", (gap + 215.0) as f32, 23.0, FOUND);
    image
}

/// Paths of nine points of the scene, three times enlarged about each.
fn path(mut image: RgbImage, truth: &Tsf, found: &Tsf, size: (usize, usize)) -> RgbImage {
    for p in image.pixels_mut() {
        p.0 = p.0.map(|v| (f64::from(v) * 0.6) as u8);
    }
    let middle = DVec2::new(size.0 as f64 - 1.0, size.1 as f64 - 1.0) / 2.0;
    let top = found.poses.iter().map(|p| p.weight).fold(0.0, f64::max);
    for j in [-1.0, 0.0, 1.0] {
        for i in [-1.0, 0.0, 1.0] {
            let p = DVec2::new(i, j) * middle * 0.75;
            let at = |tsf: &Tsf, k: usize| p + middle + 3.0 * (tsf.poses[k].apply(tsf.focal_px, p) - p);
            for k in 0..found.poses.len() {
                let q = at(found, k);
                line(&mut image, q, q, 2.0 + 5.0 * (found.poses[k].weight / top).sqrt(), FOUND, 0.9);
            }
            for k in 1..truth.poses.len() {
                line(&mut image, at(truth, k - 1), at(truth, k), 0.8, TRUE, 0.8);
            }
        }
    }
    write(&mut image, "TRUE", 8.0, 8.0, TRUE);
    write(&mut image, "FOUND", 60.0, 8.0, FOUND);
    write(&mut image, "SHAKE ENLARGED 3 TIMES", 130.0, 8.0, [235; 3]);
    image
}
