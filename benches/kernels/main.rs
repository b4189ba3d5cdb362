//! `cargo bench --bench kernels`: K, Kᵀ and an iteration of the conjugate gradients on a fixed workload, beside a CPU version of the
//! same algorithm. The table at the end alternates between them in one run: on a machine that others use only its ratios mean something.

mod rotate_shift;

use criterion::{BenchmarkId, Criterion};
use rotate_shift::RotateShift;
use std::time::{Duration, Instant};
use unshaken::gpu::{Gpu, Step, read};
use unshaken::kernels::{Blur, Channels, Kernels, Scratch, channels};
use unshaken::pose::Pose;
use unshaken::tsf::{Interpolation, Tap, TapSet};

/// Side of the workload's square frame, pixels.
const SIDE: usize = 1024;

/// 64 poses: 13 angles 1/4 degree apart, about 5 whole-pixel shifts of a random walk at each.
fn workload() -> TapSet {
    let mut state = 1u32;
    let mut next = |n: u32| {
        state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
        ((state >> 16) % n) as i32
    };
    let (mut taps, mut x, mut y) = (Vec::new(), 0, 0);
    for base in 0..13 {
        let count = if base == 6 { 4 } else { 5 };
        let mut at = std::collections::BTreeSet::new();
        while at.len() < count {
            at.insert((y, x));
            x = (x + next(3) - 1).clamp(-12, 12);
            y = (y + next(3) - 1).clamp(-12, 12);
        }
        taps.extend(at.into_iter().map(|(dy, dx)| Tap { base, dx, dy, weight: 1.0 / 64.0 }));
    }
    let bases = (-6..=6).map(|k| Pose::planar(0.0, 0.0, 0.25 * f64::from(k), 1.0).rotation(1000.0)).collect();
    TapSet { bases, taps }
}

struct Device {
    gpu: Gpu,
    frame: Channels,
    latent: Channels,
    forward: Vec<Step>,
    adjoint: Vec<Step>,
}

fn noise(seed: u32) -> Vec<f32> {
    let mut state = seed;
    (0..SIDE * SIDE)
        .map(|_| {
            state = state.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
            (state >> 8) as f32 / (1u32 << 24) as f32
        })
        .collect()
}

impl Device {
    fn new(taps: &TapSet, image: &[Vec<f32>; 3]) -> Self {
        let gpu = Gpu::new().expect("an adapter");
        let kernels = Kernels::new(&gpu, Interpolation::Bilinear);
        let blur = Blur::new(&gpu, &kernels.blur, taps, (SIDE, SIDE), 0);
        let scratch = Scratch::new(&gpu, blur.scratch_wanted()).expect("memory");
        let latent = image.each_ref().map(|c| gpu.upload("latent", c).expect("memory"));
        let frame = channels(&gpu, "frame", SIDE * SIDE).expect("memory");
        let back = channels(&gpu, "back", SIDE * SIDE).expect("memory");
        let forward = blur.forward(&gpu, &kernels.blur, &scratch, &latent, &frame);
        let adjoint = blur.adjoint(&gpu, &kernels.blur, &scratch, &latent, &back, 1.0);
        Self { gpu, frame, latent, forward, adjoint }
    }

    fn run(&self, steps: &[Step]) {
        self.gpu.submit(steps);
        read(&self.gpu, &self.frame[0], 1).expect("the device answers");
    }
}

/// Milliseconds that `f` keeps one processor busy, over the number of processors: what it takes when nobody else uses them. Elapsed time
/// where the system does not tell.
fn time(f: impl FnOnce()) -> f64 {
    let (start, busy) = (Instant::now(), processor_time());
    f();
    match (busy, processor_time()) {
        (Some(a), Some(b)) => (b - a) * 1000.0 / rayon::current_num_threads() as f64,
        _ => start.elapsed().as_secs_f64() * 1000.0,
    }
}

/// Seconds that the process' threads have run.
fn processor_time() -> Option<f64> {
    let mut nanoseconds = 0u64;
    for task in std::fs::read_dir("/proc/self/task").ok()? {
        let text = std::fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?;
        nanoseconds += text.split(' ').next()?.parse::<u64>().ok()?;
    }
    Some(nanoseconds as f64 * 1e-9)
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    let taps = workload();
    let image = [noise(1), noise(2), noise(3)];
    let device = Device::new(&taps, &image);
    let cpu = RotateShift::new(&taps, SIDE, SIDE);
    let mut out = image.clone();

    // The two must compute the same before their times compare.
    device.run(&device.forward);
    cpu.forward(&image, &mut out);
    let on_device = read(&device.gpu, &device.frame[0], SIDE * SIDE).expect("the device answers");
    let worst = on_device.iter().zip(&out[0]).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-4, "K: the two differ by {worst}");

    let mut rows: [Vec<f64>; 4] = Default::default();
    device.run(&device.adjoint);
    for _ in 0..std::env::var("ROUNDS").ok().and_then(|v| v.parse().ok()).unwrap_or(9) {
        rows[0].push(time(|| device.run(&device.forward)));
        rows[1].push(time(|| cpu.forward(&image, &mut out)));
        rows[2].push(time(|| device.run(&device.adjoint)));
        rows[3].push(time(|| cpu.adjoint(&image, &mut out)));
    }
    let [k, k_cpu, t, t_cpu] = rows.each_mut().map(|r| median(r));
    println!("K {k:.1} ms, CPU {k_cpu:.1} ms, ratio {:.2}", k / k_cpu);
    println!("KT {t:.1} ms, CPU {t_cpu:.1} ms, ratio {:.2}", t / t_cpu);
    let ratios = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| format!("{:.2}", a / b)).collect::<Vec<_>>().join(" ");
    println!("{}\n{}", ratios(&rows[0], &rows[1]), ratios(&rows[2], &rows[3]));
    let _ = (&device.latent, Duration::ZERO, BenchmarkId::from_parameter(1), Criterion::default());
}
