//! Memory of a solve: what is planned is what is made, less memory gives the same result; reduced frames; input that is refused.

use crate::support::{files, gpu::gpu, gpu::kernels, gpu::kinds, noise};
use std::collections::BTreeMap;
use unshaken::deblur::{self, Observation, Prior, Settings, Solution, pad_for, solve};
use unshaken::error::Error;
use unshaken::exposure::{Bracket, Frame};
use unshaken::gpu::Gpu;
use unshaken::image::{Plane, Rgb};
use unshaken::kernels::{Kernels, NOISE_STEPS};
use unshaken::pose::Pose;
use unshaken::response::{self, Response};
use unshaken::tsf::{Interpolation, Tsf, TsfEntry, TsfFile};

const SIZE: (usize, usize) = (150, 110);
const PAD: usize = 9;

fn path() -> Tsf {
    let at = |i: usize| {
        let t = i as f64 / 24.0;
        Pose::planar(5.0 * t, 3.0 * (3.0 * t).sin(), 0.6 * t - 0.2, 1.0)
    };
    Tsf::new(200.0, (0..24).map(at).collect()).expect("valid")
}

fn bracket() -> Vec<Observation> {
    let frame = |seed: u64, tsf: Tsf, exposure_time: f64| Observation {
        exposure: Rgb(std::array::from_fn(|c| {
            let n = noise(seed + c as u64, SIZE.0 * SIZE.1);
            Plane::from_fn(SIZE.0, SIZE.1, |x, y| {
                let shade = 0.3 + 0.2 * (0.2 * x as f32).sin() * (0.15 * y as f32).cos();
                (shade * exposure_time as f32 + 0.01 * n[y * SIZE.0 + x]).clamp(0.0, 1.0)
            })
        })),
        mask: Plane::filled(SIZE.0, SIZE.1, 1.0),
        exposure_time,
        noise: std::array::from_fn(|_| vec![0.01; NOISE_STEPS]),
        black_clipped: true,
        tsf,
    };
    vec![frame(1, Tsf::identity(), 0.5), frame(5, path(), 1.0), frame(9, Tsf::identity(), 0.25)]
}

fn run(gpu: &Gpu, kernels: &Kernels, memory_limit: Option<u64>) -> Result<Solution, Error> {
    run_with(gpu, kernels, memory_limit, Prior::Tv)
}

fn run_with(gpu: &Gpu, kernels: &Kernels, memory_limit: Option<u64>, prior: Prior) -> Result<Solution, Error> {
    let start = Rgb::filled(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD, 0.3);
    let settings = Settings { outer: 2, inner: 5, memory_limit, prior, interpolation: Interpolation::Bilinear, ..Settings::default() };
    solve(gpu, kernels, &bracket(), &start, PAD, &settings, &mut |_| true)
}

fn farthest(a: &Rgb, b: &Rgb) -> f32 {
    let pairs = a.0.iter().zip(&b.0).flat_map(|(a, b)| a.data.iter().zip(&b.data));
    pairs.map(|(a, b)| (a - b).abs() / (1e-3 + a.abs())).fold(0.0, f32::max)
}

#[test]
fn less_memory_gives_the_same_irradiance() {
    // On GPUs most operators run by tiles, which take no scratch.
    for software in [true, false] {
        less_memory(&gpu().treated_as(software));
    }
}

fn less_memory(gpu: &Gpu) {
    let kernels = Kernels::new(gpu);
    let all = run(gpu, &kernels, None).expect("solves");
    let memory = all.report.memory;
    assert!(!memory.streamed && !memory.reduced && memory.channels_together == 3);
    // What was planned is what was made.
    assert_eq!(gpu.counted(), memory.bytes);
    let (n, m) = ((SIZE.0 + 2 * PAD) * (SIZE.1 + 2 * PAD), SIZE.0 * SIZE.1);
    let stated = (112 * n + (3 * 16 + 12 + 24) * m) as u64;
    let least = (72 * n + (4 + 24) * m) as u64;
    assert!(memory.bytes > stated && memory.bytes < stated + stated / 2, "{} for {stated} without scratch", memory.bytes);

    let limits = [(memory.bytes - 300_000, false, 3), (stated - 100_000, true, 3), (least + least / 8, true, 1)];
    for (limit, streamed, together) in limits.into_iter().skip(usize::from(!gpu.software)) {
        let less = run(gpu, &kernels, Some(limit)).expect("solves");
        let how = less.report.memory;
        assert_eq!((how.streamed, how.channels_together), (streamed, together), "{limit} of {}", memory.bytes);
        assert!(how.bytes <= limit && gpu.counted() == how.bytes);
        assert!(farthest(&all.irradiance, &less.irradiance) < 1e-5, "{}", farthest(&all.irradiance, &less.irradiance));
        for (a, b) in all.misfit.iter().zip(&less.misfit) {
            assert!(a.data.iter().zip(&b.data).all(|(a, b)| (a - b).abs() <= 1e-3 * (1.0 + a.abs())));
        }
    }
    // The filter chooses patches: where two are as like, a rounding decides.
    let filtered =
        [None, Some(least + least / 8)].map(|limit| run_with(gpu, &kernels, limit, Prior::Collaborative).expect("solves").irradiance);
    let mut far: Vec<f32> = filtered[0].0.iter().zip(&filtered[1].0).flat_map(|(a, b)| a.zip(b, |a, b| (a - b).abs() / a).data).collect();
    far.sort_by(f32::total_cmp);
    assert!(far[far.len() * 98 / 100] < 1e-5 && far[far.len() - 1] < 1e-3, "{} {}", far[far.len() * 98 / 100], far[far.len() - 1]);
    let error = run(gpu, &kernels, Some(1 << 20)).err().expect("too little").to_string();
    assert!(error.contains("MiB") && error.contains("--memory-limit") && error.contains("--scale"), "{error}");
}

#[test]
fn the_device_gives_little_more_than_is_planned() {
    // A device of its own: others' planes would count.
    let gpu = Gpu::new().expect("an adapter");
    let Some(before) = gpu.taken() else { return };
    let values = vec![0.5f32; 10 << 20];
    let planes: Vec<_> = (0..7).map(|_| gpu.upload("plane", &values).expect("there is room")).collect();
    let taken = gpu.taken().expect("told before") - before;
    // 40 MiB each, and what is on its way to them: 64 MiB, and as much that has arrived.
    assert_eq!(gpu.counted(), 280 << 20);
    assert!(taken < (280 + 128 + 16) << 20, "{} MiB for {}", taken >> 20, gpu.counted() >> 20);
    let last = unshaken::gpu::read(&gpu, &planes[6], values.len()).expect("reads");
    assert!(last == values, "arrives whole");
    let taken = gpu.taken().expect("told before") - before;
    assert!(taken < (280 + 40 + 16) << 20, "{} MiB for {} once all has arrived, and one plane was read", taken >> 20, gpu.counted() >> 20);
}

#[test]
fn a_plane_of_several_pieces_arrives_whole() {
    // 68 MiB, of which 64 are under way at a time.
    let values: Vec<f32> = (0..17 << 20).map(|i: u32| (i % 8191) as f32).collect();
    let gpu = gpu();
    let plane = gpu.upload("plane", &values).expect("there is room");
    assert!(unshaken::gpu::read(gpu, &plane, values.len()).expect("reads") == values);
}

/// By the plan that `less_memory_gives_the_same_irradiance` holds against what is made.
#[test]
fn large_brackets_fit_the_memory_that_there_is() {
    // A path of 60 px and 0.3 degrees of roll, as a frame of 6000 pixels sees what is 4 px in one of 400.
    let at = |i: usize, size: (usize, usize)| {
        let t = i as f64 / 120.0;
        Pose::planar(0.01 * size.0 as f64 * t, 0.004 * size.0 as f64 * (3.0 * t).sin(), 0.3 * t, 1.0)
    };
    for kind in kinds() {
        large_brackets_fit(kind, &at);
    }
}

fn large_brackets_fit((gpu, kernels): &(Gpu, Kernels), at: &impl Fn(usize, (usize, usize)) -> Pose) {
    let memory = |size: (usize, usize), shaken: usize, limit: u64| {
        let path = Tsf::new(1.2 * size.0 as f64, (0..120).map(|i| at(i, size)).collect()).expect("valid");
        let sharp = Tsf::identity();
        let tsfs: Vec<&Tsf> = (0..5).map(|i| if i < shaken { &path } else { &sharp }).collect();
        let pad = pad_for(&tsfs, size.0, size.1, size.0 / 4);
        let settings = Settings { memory_limit: Some(limit), ..Settings::default() };
        deblur::memory(gpu, kernels, &tsfs, size, pad, &settings)
    };
    let (small, large) = ((6000, 4000), (9000, 6667));
    for (size, shaken, limit) in [(small, 2, 4_000_000_000), (small, 3, 4_000_000_000), (large, 2, 8_000_000_000)] {
        let planned = memory(size, shaken, limit).expect("fits");
        assert!(planned.bytes <= limit && planned.streamed, "{planned:?}");
        // The table of docs/PERFORMANCE.md.
        let (most, least) = (memory(size, shaken, u64::MAX).expect("fits"), memory(size, shaken, 1).expect_err("does not fit"));
        println!("{size:?}, {shaken} shaken, software {}: {} bytes; {least}", gpu.software, most.bytes);
    }
    // With more of it everything stays on the device.
    let roomy = memory(small, 2, 16_000_000_000).expect("fits");
    assert!(!roomy.streamed && roomy.channels_together == 3 && roomy.bytes > 4_000_000_000, "{roomy:?}");
    assert!(matches!(memory(small, 2, 2_000_000_000), Err(Error::OutOfMemory(_))));
}

#[test]
fn a_device_that_runs_out_of_memory_is_asked_for_less() {
    let all = run(gpu(), kernels(), None).expect("solves");
    let small = Gpu::new().expect("an adapter").with_memory_limit(all.report.memory.bytes * 3 / 4);
    let kernels = Kernels::new(&small);
    let less = run(&small, &kernels, None).expect("solves all the same");
    assert!(less.report.memory.reduced && less.report.memory.bytes < all.report.memory.bytes);
    assert!(farthest(&all.irradiance, &less.irradiance) < 1e-5);
    let tiny = Gpu::new().expect("an adapter").with_memory_limit(1 << 20);
    assert!(matches!(run(&tiny, &kernels, None), Err(Error::OutOfMemory(_))));
}

/// A bracket whose planes no binding holds is solved in bands, whether exposures stay on the host or not; below the rows that an operator
/// reads at once it is refused.
#[test]
fn frames_beyond_a_binding_are_solved_in_bands() {
    for (software, bytes) in [(true, 60_000), (false, 72_000)] {
        solved_in_bands(&gpu().treated_as(software), bytes);
    }
}

fn solved_in_bands(gpu: &Gpu, bytes: u64) {
    let all = run(gpu, &Kernels::new(gpu), None).expect("solves");
    let narrow = gpu.treated_as(gpu.software).with_binding_limit(bytes);
    let kernels = Kernels::new(&narrow);
    assert!(narrow.max_binding() < (SIZE.0 + 2 * PAD) * (SIZE.1 + 2 * PAD));
    for limit in [None, Some(all.report.memory.bytes * 3 / 4)] {
        let bands = run(&narrow, &kernels, limit).expect("solves");
        assert!(farthest(&all.irradiance, &bands.irradiance) < 1e-5, "{}", farthest(&all.irradiance, &bands.irradiance));
        for (a, b) in all.misfit.iter().zip(&bands.misfit) {
            assert!(a.data.iter().zip(&b.data).all(|(a, b)| (a - b).abs() <= 1e-3 * (1.0 + a.abs())));
        }
    }
    let narrower = gpu.treated_as(gpu.software).with_binding_limit(20_000);
    let kernels = Kernels::new(&narrower);
    let error = run(&narrower, &kernels, None).err().expect("too large").to_string();
    assert!(error.contains("150 x 110") && error.contains("--scale"), "{error}");
}

fn frames(size: (usize, usize), value: impl Fn(usize, usize) -> f32 + Copy + Sync) -> Bracket {
    let frame = |name: &str, exposure_time: f64, factor: f32| Frame {
        name: name.into(),
        intensity: Rgb(std::array::from_fn(|_| {
            Plane::from_fn(size.0, size.1, |x, y| ((factor * value(x, y)).min(1.0) * 255.0).round() / 255.0)
        })),
        levels: 255,
        chroma_subsampled: false,
        lossy: false,
        speed: None,
        exposure_time,
    };
    Bracket::new(vec![frame("a.png", 0.5, 0.5), frame("b.png", 1.0, 1.0)]).expect("a bracket")
}

#[test]
fn reduced_frames_are_means_of_irradiance() {
    // Squares of black and one shade: the mean of the intensities is not the intensity of the mean.
    let bracket = frames((67, 50), |x, y| if (x + y) % 2 == 0 { 0.8 } else { 0.0 });
    for response in [Response::Srgb, Response::Linear, Response::Gamma(2.2)] {
        let small = response::reduced(&bracket, &response, 2).expect("large enough");
        assert_eq!(small.size(), (33, 25));
        for (frame, full) in small.frames().iter().zip([0.4f64, 0.8]) {
            let expected = 0.5 * response.inverse(1, (full * 255.0).round() / 255.0);
            let got = response.inverse(1, f64::from(frame.intensity.0[1].at(20, 11)));
            assert!((got - expected).abs() < 1e-4, "{}: {got} {expected}", response.name());
        }
    }
    // One clipped pixel clips its square.
    let bracket = frames((64, 64), |x, y| if (x, y) == (37, 22) { 1.0 } else { 0.3 });
    let small = response::reduced(&bracket, &Response::Srgb, 4).expect("large enough");
    let clipped: Vec<usize> = (0..256).filter(|&i| small.frames()[1].intensity.0[0].data[i] >= 1.0).collect();
    assert_eq!(clipped, [5 * 16 + 9]);
    let error = response::reduced(&bracket, &Response::Srgb, 8).expect_err("too small").to_string();
    assert!(error.contains("8 x 8") && error.contains("--scale"), "{error}");
}

#[test]
fn a_reduced_motion_is_the_same_motion() {
    let tsf = path();
    let small = tsf.scaled(0.25);
    for (p, q) in tsf.poses.iter().zip(&small.poses) {
        let at = glam::DVec2::new(60.0, -44.0);
        let (full, part) = (p.apply(tsf.focal_px, at), q.apply(small.focal_px, 0.25 * at));
        assert!((0.25 * full - part).length() < 1e-9, "{full} {part}");
    }
    let entry = TsfEntry { frame: "a.png".into(), width: 1003, height: 662, focal_px: 900.0, poses: tsf.poses.clone(), base: None };
    let file = TsfFile::new(vec![entry]).reduced(4);
    let found = file.find("a.png", 250, 165).expect("fits").expect("there");
    assert_eq!((found.focal_px, found.poses[23].t_x), (225.0, 0.25 * tsf.poses[23].t_x));
}

#[test]
fn bad_motions_and_pixels_are_refused_by_name() {
    let entry = |poses: Vec<Pose>| TsfEntry { frame: "a.png".into(), width: 60, height: 40, focal_px: 80.0, poses, base: None };
    let refuse = |poses: Vec<Pose>| TsfFile::new(vec![entry(poses)]).find("a.png", 60, 40).expect_err("refused").to_string();
    let cases = [
        (vec![], "at least one pose"),
        (vec![Pose::planar(0.0, 0.0, 0.0, 1.0), Pose::planar(1.0, 0.0, 0.0, -0.1)], "negative weight"),
        (vec![Pose::planar(f64::NAN, 0.0, 0.0, 1.0)], "not finite"),
        (vec![Pose::planar(0.0, 0.0, 0.0, 0.9), Pose::planar(3.0, -40.0, 0.0, 0.1)], "out of view"),
    ];
    for (poses, word) in cases {
        let error = refuse(poses);
        assert!(error.contains("a.png") && error.contains(word), "{error}");
    }
    let mut frames = frames((20, 20), |x, _| x as f32 / 20.0).frames().to_vec();
    frames[1].intensity.0[2].data[20 * 7 + 3] = f32::NAN;
    let error = Bracket::new(frames).expect_err("refused").to_string();
    assert!(error.contains("b.png") && error.contains("blue of pixel (3, 7)"), "{error}");
}

#[test]
fn scale_and_memory_limit_on_the_command_line() {
    let dir = tempfile::tempdir().expect("a folder");
    let shade = |x: u32, y: u32, f: f32| ((120.0 + 60.0 * ((x / 4 + y / 6) % 2) as f32) * f) as u8;
    let (a, b) = (dir.path().join("a.png"), dir.path().join("b.png"));
    files::write_png(&a, 96, 72, |x, y| shade(x, y, 0.6));
    files::write_png(&b, 96, 72, |x, y| shade(x, y, 1.0));
    let merge = |options: &[&str]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_unshaken"));
        command.arg("merge").args([&a, &b]).args(["--exposures", "0.1,0.3", "--response", "srgb", "--sharp", "1,2", "--overwrite"]);
        let out = dir.path().join("out.exr");
        command.arg("-o").arg(&out).args(options).output().expect("runs")
    };
    let wrong: BTreeMap<&str, &str> = BTreeMap::from([("--scale", "0.3"), ("--memory-limit", "2")]);
    for (option, value) in wrong {
        let run = merge(&[option, value]);
        let text = String::from_utf8_lossy(&run.stderr).into_owned();
        assert!(run.status.code() == Some(2) && text.contains(option) && text.contains(value), "{text}");
    }
    let run = merge(&["--memory-limit", "100kB"]);
    assert_eq!(run.status.code(), Some(2), "kB is no unit that helps");
    let run = merge(&["--memory-limit", "0.4MiB"]);
    assert!(run.status.code() == Some(1) && String::from_utf8_lossy(&run.stderr).contains("MiB of device memory"));
    let run = merge(&["--scale", "0.25", "--memory-limit", "64MiB"]);
    let text = String::from_utf8_lossy(&run.stdout).into_owned();
    assert!(run.status.success() && text.contains("24 x 18"), "{text} {}", String::from_utf8_lossy(&run.stderr));
}
