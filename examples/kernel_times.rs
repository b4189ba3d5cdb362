//! Times of K and Kᵀ, step by step, for the TSFs of a TSF file: `cargo run --release --example kernel_times -- TSF.json`.

use std::time::Instant;
use unshaken::gpu::{Gpu, read};
use unshaken::kernels::{Blur, Kernels, Scratch, channels};
use unshaken::tsf::{Interpolation, TapSet, Tsf, TsfFile};

/// Runs of each step; the first one compiles and is not counted.
const RUNS: u32 = 5;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("name a TSF file")?;
    let file = TsfFile::parse(&std::fs::read_to_string(path)?)?;
    let gpu = Gpu::new()?;
    println!("{}", gpu.description);
    for interpolation in [Interpolation::Bilinear, Interpolation::Bicubic, Interpolation::SixPoint] {
        let kernels = Kernels::new(&gpu);
        for entry in &file.frames {
            let tsf = Tsf::new(entry.focal_px, entry.poses.clone())?;
            if tsf.is_identity() {
                continue;
            }
            let size = (entry.width, entry.height);
            let pad = unshaken::deblur::pad_for(&[&tsf], size.0, size.1, size.0 / 4);
            let taps = TapSet::new(&tsf, size.0, size.1, interpolation);
            println!(
                "{} {size:?} {interpolation:?}: {} poses, {} base warps, {} taps",
                entry.frame,
                tsf.poses.len(),
                taps.bases.len(),
                taps.taps.len()
            );
            let blur = Blur::new(&gpu, kernels.blur(interpolation), &taps, size, pad);
            let scratch = Scratch::new(&gpu, blur.scratch_wanted(), 3)?;
            let latent = channels(&gpu, "latent", (size.0 + 2 * pad) * (size.1 + 2 * pad))?;
            let frame = channels(&gpu, "frame", size.0 * size.1)?;
            let forward = blur.forward(&gpu, kernels.blur(interpolation), &scratch, &latent, &frame);
            let adjoint = blur.adjoint(&gpu, kernels.blur(interpolation), &scratch, &frame, &latent, 1.0);
            for (name, steps) in [("K", forward), ("Kᵀ", adjoint)] {
                for (i, step) in steps.iter().enumerate() {
                    gpu.submit(std::slice::from_ref(step));
                    read(&gpu, &frame[0], 1)?;
                    let start = Instant::now();
                    for _ in 0..RUNS {
                        gpu.submit(std::slice::from_ref(step));
                    }
                    read(&gpu, &frame[0], 1)?;
                    println!("  {name} step {i}: {:.1} ms", start.elapsed().as_secs_f64() * 1000.0 / f64::from(RUNS));
                }
            }
        }
    }
    Ok(())
}
