//! How soon the irradiance converges, beside the plain scheme of six outer and fifteen inner iterations: `cargo run --release --example convergence`.
//!
//! Solves drawn brackets with their true TSFs and total variation alone, so that the last iterate is the result, and judges every iterate
//! against the truth. Converged is what the defaults come to after [`LONG`] outer iterations. The time that looking takes is not counted.

use std::cell::RefCell;
use std::time::{Duration, Instant};
use unshaken::deblur::{self, Observation, Prior, Settings};
use unshaken::gpu::{Gpu, read};
use unshaken::image::{Plane, Rgb};
use unshaken::kernels::{DeviceRgb, Kernels, UNSEEN};
use unshaken::metrics::{Judge, score};
use unshaken::noise::{self, NoiseModel};
use unshaken::synth::{self, Camera, SyntheticBracket, Tremor};
use unshaken::tsf::Tsf;
use unshaken::{mask, merge};

/// Outer iterations after which nothing changes any more.
const LONG: usize = 24;
/// How far below the converged result, dB, an iterate has reached it.
const NEAR: f64 = 0.1;
/// Size of the frames, content beyond them, pixels, median luminance (part of white after 1 s) and seed.
const SIZE: (usize, usize) = (384, 288);
const MARGIN: usize = 48;
const MEDIAN: f64 = 0.05;
const SEED: u64 = 1;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let gpu = Gpu::new()?;
    println!("{}", gpu.description);
    let kernels = Kernels::new(&gpu);
    let defaults = Settings { prior: Prior::Tv, ..Settings::default() };
    let long = Settings { outer: LONG, tolerance: 0.0, reduction: 0.0, ..defaults.clone() };
    let plain = Settings { outer: 6, inner: 15, tolerance: 0.0, reduction: 0.0, settled: f64::INFINITY, ..defaults.clone() };
    let shaken = |extent_px, roll_deg| Some(Tremor { extent_px, roll_deg, offset_px: 1.5, offset_deg: 0.1 });
    let two = [(1.0 / 30.0, None), (1.0 / 8.0, None), (1.0 / 5.0, None), (1.0 / 2.0, shaken(6.0, 0.5)), (2.0, shaken(12.0, 1.0))];
    let all = [(1.0 / 8.0, shaken(6.0, 0.5)), (1.0 / 2.0, shaken(9.0, 0.8)), (2.0, shaken(12.0, 1.0))];
    for (name, frames) in [("two of five shaken", &two[..]), ("three of three shaken", &all[..])] {
        let scene = synth::room(SIZE.0, SIZE.1, MARGIN, SEED);
        let made = synth::capture(&scene, &Camera::default(), frames, MEDIAN, SEED)?;
        // The first solve compiles the kernels.
        let converged = iterates(&gpu, &kernels, &made, &long)?.last().ok_or("no iterate")?.1;
        println!("{name}: converged {converged:.2} dB");
        for (scheme, settings) in [("plain", &plain), ("default", &defaults), ("plain", &plain), ("default", &defaults)] {
            let found = iterates(&gpu, &kernels, &made, settings)?;
            let near = found.iter().find(|(_, db)| *db > converged - NEAR);
            let when = near.map_or("never at".into(), |(s, _)| format!("{s:.1} s to"));
            let course = found.iter().map(|(s, db)| format!("{s:.1} s {db:.2}")).collect::<Vec<_>>().join(", ");
            println!("  {scheme}: {when} {NEAR} dB below it; {course}");
        }
    }
    Ok(())
}

/// What is seen of a solve while it works.
struct Seen {
    planes: Option<DeviceRgb>,
    start: Instant,
    looking: Duration,
    iterates: Vec<(f64, Rgb)>,
}

impl Seen {
    /// Keeps the estimate, of `latent` = (width, height) pixels, as it is now if it is another than before.
    fn look(&mut self, gpu: &Gpu, latent: (usize, usize)) -> unshaken::error::Result<()> {
        let begin = Instant::now();
        let Some(planes) = &self.planes else { return Ok(()) };
        let mut now = Rgb::filled(latent.0, latent.1, 0.0);
        for (plane, from) in now.0.iter_mut().zip(planes) {
            *plane = Plane::from_vec(latent.0, latent.1, read(gpu, from, latent.0 * latent.1)?)?;
        }
        if self.iterates.last().is_none_or(|(_, last)| last.0[0].data != now.0[0].data) {
            self.iterates.push(((begin - self.start).saturating_sub(self.looking).as_secs_f64(), now));
        }
        self.looking += begin.elapsed();
        Ok(())
    }
}

/// Seconds and PU21-PSNR of the iterates of a solve, the start included: the merge of the sharp frames, or of all where none is.
fn iterates(gpu: &Gpu, kernels: &Kernels, made: &SyntheticBracket, settings: &Settings) -> Result<Vec<(f64, f64)>, Failure> {
    let (bracket, camera) = (&made.bracket, Camera::default());
    let (frames, (w, h)) = (bracket.frames(), bracket.size());
    let level = NoiseModel::from_electrons(camera.full_well, camera.read_noise);
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, &camera.response)).collect();
    let curves: Vec<[Vec<f32>; 3]> = frames.iter().map(|f| std::array::from_fn(|c| level.curve(&camera.response, c, f.levels))).collect();
    let places: Vec<_> = made.tsfs.iter().map(Tsf::centre).collect();
    let masks = mask::counting(frames, &made.sharp, 0.3, &places);
    let observations: Vec<Observation> = (0..frames.len())
        .map(|i| Observation {
            exposure: Rgb(std::array::from_fn(|c| {
                exposures[i].0[c].zip(&frames[i].intensity.0[c], |x, z| if z < mask::CLIPPED { x } else { UNSEEN })
            })),
            mask: masks[i].clone(),
            exposure_time: frames[i].exposure_time,
            noise: curves[i].clone(),
            black_clipped: true,
            tsf: made.tsfs[i].clone(),
        })
        .collect();
    let sharp: Vec<usize> = (0..frames.len()).filter(|&i| made.sharp[i] || !made.sharp.contains(&true)).collect();
    let merged = merge::irradiance(bracket, &exposures, &masks, &curves, &sharp);
    let pad = deblur::pad_for(&made.tsfs.iter().collect::<Vec<_>>(), w, h, w / 4);
    let latent = (w + 2 * pad, h + 2 * pad);
    let around = |p: &Plane| Plane::from_fn(latent.0, latent.1, |x, y| p.clamped(x as isize - pad as isize, y as isize - pad as isize));
    let seen = RefCell::new(Seen { planes: None, start: Instant::now(), looking: Duration::ZERO, iterates: Vec::new() });
    let mut watch = |planes: &DeviceRgb| {
        let mut seen = seen.borrow_mut();
        seen.planes = Some(planes.clone());
        seen.start = Instant::now();
    };
    let mut progress = |_| seen.borrow_mut().look(gpu, latent).is_ok();
    let solution =
        deblur::solve_watched(gpu, kernels, &observations, &merged.map_planes(around), pad, settings, &mut watch, &mut progress)?;
    let mut seen = seen.into_inner();
    seen.look(gpu, solution.irradiance.size())?;
    let judge = Judge::default();
    let judged = |(s, image): &(f64, Rgb)| Ok((*s, score(&image.map_planes(|p| p.crop(pad, pad, w, h)), &made.truth, &judge)?.pu_psnr));
    seen.iterates.iter().map(judged).collect()
}
