//! Times of K, Kᵀ and an iteration of the conjugate gradients at several sizes, on the adapter that a merge would use:
//! `cargo run --release --example gpu_times -- 1 12 24` (megapixels; and `operators` for K and Kᵀ alone). `benches/peers.py --device cuda 1 12 24` times PyTorch at the same work.

#[path = "../benches/kernels/workload.rs"]
mod workload;

use std::time::{Duration, Instant};
use unshaken::deblur::{self, Prior, Settings};
use unshaken::error::Result;
use unshaken::gpu::{Gpu, Step, read};
use unshaken::image::Rgb;
use unshaken::kernels::{Blur, Kernels, Scratch, channels};
use unshaken::tsf::{Interpolation, TapSet, Tsf};
use workload::{motion, noise, observation, workload};

/// How long each figure is measured at least.
const LEAST: Duration = Duration::from_millis(200);
/// Frames of the bracket whose iterations are timed; two of them shaken.
const FRAMES: usize = 5;

/// Milliseconds of one run of `steps`, of as many as fill [`LEAST`], queued behind one another.
fn time(gpu: &Gpu, steps: &[Step], probe: &wgpu::Buffer) -> Result<f64> {
    let run = |count: u32| {
        let start = Instant::now();
        for _ in 0..count {
            gpu.submit(steps);
        }
        read(gpu, probe, 1)?;
        Ok(start.elapsed())
    };
    run(1)?; // drivers compile at the first run
    let mut count = 1;
    loop {
        let took = run(count)?;
        if took > LEAST {
            return Ok(took.as_secs_f64() * 1000.0 / f64::from(count));
        }
        count *= 2;
    }
}

fn operators(gpu: &Gpu, kernels: &Kernels, side: usize, interpolation: Interpolation) -> Result<(f64, f64)> {
    let blur = Blur::new(gpu, kernels.blur(interpolation), &workload(), (side, side), 0);
    let scratch = Scratch::new(gpu, blur.scratch_wanted(), 3)?;
    let values = noise(1, side * side);
    let latent = [0, 1, 2].map(|_| gpu.upload("latent", &values)).into_iter().collect::<Result<Vec<_>>>()?;
    let (frame, back) = (channels(gpu, "frame", side * side)?, channels(gpu, "back", side * side)?);
    let forward = blur.forward(gpu, kernels.blur(interpolation), &scratch, &latent, &frame);
    let adjoint = blur.adjoint(gpu, kernels.blur(interpolation), &scratch, &latent, &back, 1.0);
    for (name, steps) in [("K", &forward), ("adjoint", &adjoint)] {
        let parts: Result<Vec<f64>> = steps.iter().map(|s| time(gpu, std::slice::from_ref(s), &back[0])).collect();
        let parts: Vec<String> = parts?.iter().map(|t| format!("{t:.3}")).collect();
        println!("  {name}, {interpolation:?}, step by step: {} ms", parts.join(" + "));
    }
    Ok((time(gpu, &forward, &frame[0])?, time(gpu, &adjoint, &back[0])?))
}

/// Milliseconds that one iteration takes: the median between reports, of which there is one every five iterations.
fn iteration(gpu: &Gpu, kernels: &Kernels, side: usize, interpolation: Interpolation) -> Result<f64> {
    let values = noise(1, side * side);
    let moved = motion();
    println!("  {} taps", TapSet::new(&moved, side, side, interpolation).taps.len());
    let tsf = |f: usize| if f < 2 { moved.clone() } else { Tsf::identity() };
    let frames: Vec<_> = (0..FRAMES).map(|f| observation(side, [values.as_slice(); 3], tsf(f))).collect();
    let start = Rgb::filled(side, side, 0.5);
    let settings = Settings { outer: 1, inner: 45, reduction: 0.0, interpolation, prior: Prior::Tv, ..Settings::default() };
    let (mut last, mut times) = (Instant::now(), Vec::new());
    deblur::solve(gpu, kernels, &frames, &start, 0, &settings, &mut |_| {
        let now = Instant::now();
        times.push((now - std::mem::replace(&mut last, now)).as_secs_f64() * 1000.0 / 5.0);
        true
    })?;
    times.remove(0); // all that comes before
    times.sort_by(f64::total_cmp);
    Ok(times[times.len() / 2])
}

fn main() -> Result<()> {
    let gpu = Gpu::new()?;
    println!("{}; 3 channels, 64 poses", gpu.description);
    let sizes: Vec<f64> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let whole = !std::env::args().any(|a| a == "operators");
    for megapixels in sizes {
        let side = (megapixels * 1e6).sqrt() as usize;
        println!("{megapixels} MP, {side} x {side}");
        for interpolation in [Interpolation::Bilinear, Interpolation::Bicubic] {
            let kernels = Kernels::new(&gpu);
            let (k, adjoint) = operators(&gpu, &kernels, side, interpolation)?;
            println!("{megapixels} MP, {interpolation:?}: K {k:.3} ms, adjoint {adjoint:.3} ms");
            if whole {
                let iteration = iteration(&gpu, &kernels, side, interpolation)?;
                println!("  {FRAMES} frames, 2 shaken: iteration {iteration:.3} ms");
            }
        }
    }
    Ok(())
}
