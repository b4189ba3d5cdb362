//! How far the blurs that are found are from the true ones: ‖K_found E - K E‖ / ‖K E‖, E the truth.
//!
//! `cargo run --release --example operator_error -- DIR...`: folders `<scene>-<case>` as the benchmark's `run.py --work` leaves them (`bracket.json` with sRGB frames,
//! `truth.npy`, `truth_tsf.json`). Each bracket is merged with default options. K takes every true pose, K_found is the solver's operator under the TSF found; both
//! read the mean of the channels by cubic convolution, [`BORDER`] pixels and more from the border: as it is, and with its brightest hundredth clipped, since the
//! trails of lamps of one pixel outweigh all else. A line for each shaken frame, in the end the medians; beside them the true TSFs under the solver's operator.

use rayon::prelude::*;
use std::path::Path;
use unshaken::blind::Operator;
use unshaken::exposure::{Bracket, Frame};
use unshaken::image::Plane;
use unshaken::io::ldr;
use unshaken::pipeline::{self, Settings};
use unshaken::pose::project;
use unshaken::response::Response;
use unshaken::tsf::{Interpolation, Tsf, TsfFile};

type Failure = Box<dyn std::error::Error>;

const BORDER: usize = 26;
/// Part of the pixels that is not clipped where lights are left out.
const DIM: f64 = 0.99;

/// Mean of the channels of a NumPy array of height x width x 3 floats (little-endian, C order).
fn truth(path: &Path) -> Result<Plane, Failure> {
    let bytes = std::fs::read(path)?;
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = std::str::from_utf8(&bytes[10..start])?;
    if !header.contains("'<f4'") || header.contains("'fortran_order': True") {
        return Err(format!("{}: not an array of 32-bit floats in C order", path.display()).into());
    }
    let shape = header.split('(').nth(1).and_then(|s| s.split(')').next()).ok_or("an array without a shape")?;
    let sides: Vec<usize> = shape.split(',').filter_map(|s| s.trim().parse().ok()).collect();
    let [height, width, 3] = sides[..] else { return Err(format!("{}: its shape is ({shape})", path.display()).into()) };
    let values: Vec<f32> = bytes[start..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    Ok(Plane { width, height, data: values.chunks_exact(3).map(|c| (c[0] + c[1] + c[2]) / 3.0).collect() })
}

/// `scene` at (x, y) by cubic convolution, repeated beyond its border.
fn read(scene: &Plane, x: f64, y: f64) -> f64 {
    let (i, j) = (x.floor() as isize, y.floor() as isize);
    let weight = |k: isize, v: f64| Interpolation::Bicubic.weight(v - k as f64);
    let row = |k: isize| (i - 1..=i + 2).map(|l| weight(l, x) * f64::from(scene.clamped(l, k))).sum::<f64>();
    (j - 1..=j + 2).map(|k| weight(k, y) * row(k)).sum()
}

/// K E pose by pose, within the border.
fn exact(scene: &Plane, tsf: &Tsf) -> Vec<f64> {
    let (w, h) = scene.size();
    let (cx, cy) = (0.5 * (w as f64 - 1.0), 0.5 * (h as f64 - 1.0));
    let back: Vec<_> = tsf.poses.iter().map(|p| ((p.homography(tsf.focal_px) * tsf.base).inverse(), p.weight)).collect();
    let pixels: Vec<(usize, usize)> = (BORDER..h - BORDER).flat_map(|y| (BORDER..w - BORDER).map(move |x| (x, y))).collect();
    let one = |&(x, y): &(usize, usize)| {
        let q = glam::DVec2::new(x as f64 - cx, y as f64 - cy);
        let seen = |(h, weight): &(glam::DMat3, f64)| {
            let p = project(h, q);
            weight * read(scene, p.x + cx, p.y + cy)
        };
        back.iter().map(seen).sum()
    };
    pixels.par_iter().map(one).collect()
}

/// The same by the solver's operator.
fn by_taps(scene: &Plane, tsf: &Tsf) -> Vec<f64> {
    let ((w, h), pad) = (scene.size(), 2 * BORDER);
    let blurred = Operator::new(tsf, w, h, pad).blur(&scene.padded(pad));
    blurred.crop(BORDER, BORDER, w - 2 * BORDER, h - 2 * BORDER).data.into_iter().map(f64::from).collect()
}

fn error(found: &[f64], want: &[f64]) -> f64 {
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|v| v * v).sum::<f64>().sqrt();
    100.0 * norm(&mut found.iter().zip(want).map(|(a, b)| a - b)) / norm(&mut want.iter().copied())
}

fn clipped(scene: &Plane) -> Plane {
    let mut all = scene.data.clone();
    let at = ((all.len() - 1) as f64 * DIM) as usize;
    let most = *all.select_nth_unstable_by(at, f32::total_cmp).1;
    scene.map(|v| v.min(most))
}

fn median(mut all: Vec<f64>) -> f64 {
    all.sort_by(f64::total_cmp);
    let n = all.len();
    if n == 0 { f64::NAN } else { 0.5 * (all[(n - 1) / 2] + all[n / 2]) }
}

fn main() -> Result<(), Failure> {
    let mut all: Vec<[f64; 4]> = Vec::new();
    for folder in std::env::args().skip(1) {
        let folder = Path::new(&folder);
        let text = |name: &str| std::fs::read_to_string(folder.join(name));
        let told: serde_json::Value = serde_json::from_str(&text("bracket.json")?)?;
        let of = |key: &str| told[key].as_array().cloned().unwrap_or_default();
        let frames = of("frames").into_iter().zip(of("exposures")).map(|(name, time)| {
            let name = name.as_str().ok_or("a frame without a name")?.to_string();
            let p = ldr::read(&folder.join(&name))?;
            let exposure_time = time.as_f64().ok_or("a frame without a time")?;
            let (intensity, levels) = (p.intensity, p.levels);
            Ok(Frame { name, intensity, levels, chroma_subsampled: p.chroma_subsampled, lossy: p.lossy, speed: None, exposure_time })
        });
        let bracket = Bracket::new(frames.collect::<Result<_, Failure>>()?)?;
        let found = pipeline::merge(&bracket, &Response::Srgb, &Settings::default(), None, &mut |_| true)?;
        let scene = truth(&folder.join("truth.npy"))?;
        let (scenes, true_tsfs) = ([clipped(&scene), scene.clone()], TsfFile::parse(&text("truth_tsf.json")?)?);
        for (k, frame) in bracket.frames().iter().enumerate().filter(|(k, _)| told["meta"][*k]["sharp"] == false) {
            let name = format!("{} {}", folder.file_name().unwrap_or_default().display(), frame.name);
            let report = &found.report["frames"][k];
            if report["used"] == false || report["sharp"] == true {
                println!("{name}: not deblurred");
                continue;
            }
            let (w, h) = scene.size();
            let entry = TsfFile::new(vec![serde_json::from_value(report["tsf"].clone())?]);
            let found = entry.find(&frame.name, w, h)?.ok_or("a shaken frame without a TSF")?;
            let true_one = true_tsfs.find(&frame.name, w, h)?.ok_or("no true TSF")?;
            let errors = |scene: &Plane| {
                let want = exact(scene, &true_one);
                [error(&by_taps(scene, &found), &want), error(&by_taps(scene, &true_one), &want)]
            };
            let [dim, whole] = [errors(&scenes[0]), errors(&scenes[1])];
            println!("{name}: {:.2} % (true TSF {:.2}), with lights {:.2} % ({:.2})", dim[0], dim[1], whole[0], whole[1]);
            all.push([dim[0], dim[1], whole[0], whole[1]]);
        }
    }
    let [dim, dim_true, whole, whole_true] = [0, 1, 2, 3].map(|i| median(all.iter().map(|e| e[i]).collect()));
    println!("median of {}: {dim:.2} % (true TSFs {dim_true:.2}), with lights {whole:.2} % ({whole_true:.2})", all.len());
    Ok(())
}
