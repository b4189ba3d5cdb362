//! `cargo bench --bench kernels`: K, Kᵀ and an iteration of the conjugate gradients on a fixed workload, beside a CPU version of the
//! same algorithm. The table at the end alternates between them in one run: on a machine that others use only its ratios mean something.

mod rotate_shift;
mod workload;

use criterion::Criterion;
use rotate_shift::RotateShift;
use std::time::Instant;
use unshaken::deblur::{self, Prior, Settings};
use unshaken::gpu::{Gpu, Step, read};
use unshaken::image::Rgb;
use unshaken::kernels::{Blur, DeviceRgb, Kernels, Scratch, channels};
use unshaken::tsf::{Interpolation, TapSet};
use workload::{motion, noise, observation, workload};

/// Side of the workload's square frame, pixels.
const SIDE: usize = 1024;

struct Device {
    gpu: Gpu,
    frame: DeviceRgb,
    back: DeviceRgb,
    forward: Vec<Step>,
    adjoint: Vec<Step>,
}

impl Device {
    fn new(taps: &TapSet, image: &[Vec<f32>; 3]) -> Self {
        let gpu = Gpu::new().expect("an adapter");
        let kernels = Kernels::new(&gpu);
        let blur = Blur::new(&gpu, kernels.blur(Interpolation::Bilinear), taps, (SIDE, SIDE), 0);
        let scratch = Scratch::new(&gpu, blur.scratch_wanted(), 3).expect("memory");
        let latent = image.each_ref().map(|c| gpu.upload("latent", c).expect("memory"));
        let frame = channels(&gpu, "frame", SIDE * SIDE).expect("memory");
        let back = channels(&gpu, "back", SIDE * SIDE).expect("memory");
        let forward = blur.forward(&gpu, kernels.blur(Interpolation::Bilinear), &scratch, &latent, &frame);
        let adjoint = blur.adjoint(&gpu, kernels.blur(Interpolation::Bilinear), &scratch, &latent, &back, 1.0);
        Self { gpu, frame, back, forward, adjoint }
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
    let image = [1, 2, 3].map(|seed| noise(seed, SIDE * SIDE));
    let device = Device::new(&taps, &image);
    let cpu = RotateShift::new(&taps, SIDE, SIDE);
    let mut out = image.clone();
    println!(
        "{}, {} threads; K and its adjoint, {SIDE} x {SIDE} pixels, 3 channels, 64 poses",
        device.gpu.description,
        rayon::current_num_threads()
    );

    // Both must compute the same before their times compare.
    let same = |what: &str, buffer: &wgpu::Buffer, expected: &[f32]| {
        let got = read(&device.gpu, buffer, SIDE * SIDE).expect("the device answers");
        let worst = got.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-4, "{what}: the two differ by {worst}");
    };
    device.run(&device.forward);
    cpu.forward(&image, &mut out);
    same("K", &device.frame[0], &out[0]);
    device.run(&device.adjoint);
    cpu.adjoint(&image, &mut out);
    same("adjoint of K", &device.back[0], &out[0]);

    let rounds: usize = std::env::var("ROUNDS").ok().and_then(|v| v.parse().ok()).unwrap_or(9);
    let mut times: [Vec<f64>; 4] = Default::default();
    for _ in 0..rounds {
        times[0].push(time(|| device.run(&device.forward)));
        times[1].push(time(|| cpu.forward(&image, &mut out)));
        times[2].push(time(|| device.run(&device.adjoint)));
        times[3].push(time(|| cpu.adjoint(&image, &mut out)));
    }
    let [k, k_cpu, t, t_cpu] = times.each_mut().map(|r| median(r));
    let parts = |steps: &[Step]| {
        let each = steps.iter().map(|s| median(&mut (0..rounds).map(|_| time(|| device.run(std::slice::from_ref(s)))).collect::<Vec<_>>()));
        each.map(|t| format!("{t:.0}")).collect::<Vec<_>>().join(" + ")
    };
    println!("Step by step, ms: K {}; its adjoint {}", parts(&device.forward), parts(&device.adjoint));
    println!("| | device, ms | CPU, ms | ratio |\n|---|---|---|---|");
    println!("| K | {k:.0} | {k_cpu:.0} | {:.2} |\n| adjoint of K | {t:.0} | {t_cpu:.0} | {:.2} |", k / k_cpu, t / t_cpu);

    // An iteration: the difference between long and short solves.
    let observation = observation(SIDE, image.each_ref().map(Vec::as_slice), motion());
    let start = Rgb::filled(SIDE, SIDE, 0.5);
    let kernels = Kernels::new(&device.gpu);
    let solve = |inner: usize| {
        let (interpolation, prior) = (Interpolation::Bilinear, Prior::Tv);
        // As many iterations as are asked for.
        let settings = Settings { outer: 1, inner, reduction: 0.0, interpolation, prior, ..Settings::default() };
        time(|| drop(deblur::solve(&device.gpu, &kernels, std::slice::from_ref(&observation), &start, 0, &settings, &mut |_| true)))
    };
    let mut differences: Vec<f64> = (0..rounds.div_ceil(4)).map(|_| (solve(12) - solve(2)) / 10.0).collect();
    let iteration = median(&mut differences);
    println!(
        "An iteration of the conjugate gradients: {iteration:.0} ms; beside K and its adjoint {:.1} %",
        100.0 * (iteration / (k + t) - 1.0)
    );

    let mut criterion = Criterion::default().sample_size(10).configure_from_args();
    let mut group = criterion.benchmark_group("64 poses");
    group.bench_function("K, device", |b| b.iter(|| device.run(&device.forward)));
    group.bench_function("K, CPU", |b| b.iter(|| cpu.forward(&image, &mut out)));
    group.bench_function("adjoint, device", |b| b.iter(|| device.run(&device.adjoint)));
    group.bench_function("adjoint, CPU", |b| b.iter(|| cpu.adjoint(&image, &mut out)));
    group.finish();
    criterion.final_summary();
}
