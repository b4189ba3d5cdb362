//! K and Kᵀ entry by entry against explicit matrix rows, and the taps of a TSF against its poses.

use crate::oracle::blur::{self, Matrix};
use crate::support::gpu::{POISON, buffer, gpu, kinds, planes, poisoned, read, run};
use crate::support::{assert_close, f64s, noise};
use glam::{DMat3, DVec2};
use unshaken::gpu::Gpu;
use unshaken::kernels::{Blur, DeviceRgb, Kernels, Scratch, ScratchSize};
use unshaken::pose::Pose;
use unshaken::tsf::{INDISTINGUISHABLE, Interpolation, Tap, TapSet, Tsf};

const ALL: [Interpolation; 3] = [Interpolation::Bilinear, Interpolation::Bicubic, Interpolation::SixPoint];
const SIZES: [(usize, usize); 7] = [(1, 1), (1, 7), (7, 1), (17, 9), (33, 65), (67, 31), (300, 5)];

/// Inputs with more behind their end: what a missing check of the border would read.
fn with_more(values: &[Vec<f32>; 3]) -> DeviceRgb {
    planes(&values.each_ref().map(|v| [v.as_slice(), &[POISON; 400]].concat()))
}

fn turned(t: (f64, f64), theta_deg: (f64, f64, f64), weight: f64) -> Pose {
    let planar = Pose::planar(t.0, t.1, theta_deg.2, weight);
    Pose { theta_x_deg: theta_deg.0, theta_y_deg: theta_deg.1, ..planar }
}

/// TSFs by name for a frame of `width` pixels: what a hand does, and what it hardly does.
fn motions(width: usize) -> Vec<(&'static str, Tsf)> {
    let focal = 1.3 * width.max(20) as f64;
    let make = |poses: Vec<Pose>| Tsf::new(focal, poses).expect("valid poses");
    let same = |x: f64, y: f64, weight: f64| turned((x, y), (0.4, -0.8, 0.3), weight);
    let planar = |p: &[(f64, f64, f64, f64)]| make(p.iter().map(|p| Pose::planar(p.0, p.1, p.2, p.3)).collect());
    vec![
        ("integer shift", planar(&[(3.0, -2.0, 0.0, 1.0)])),
        ("fractional shifts", planar(&[(0.37, -1.61, 0.0, 0.5), (1.93, 0.25, 0.0, 0.3), (-2.5, 4.75, 0.0, 0.2)])),
        ("rotations", planar(&[(0.4, -0.3, -0.7, 0.3), (1.2, 0.8, 0.1, 0.5), (-2.6, 1.1, 0.9, 0.2)])),
        // A row sum of the Jacobian of cos 21° + sin 21° = 1.29: targets lie farther apart than the support.
        ("large rotation", planar(&[(0.3, 0.6, 21.0, 1.0)])),
        // Two poses that share a base warp, and one by itself.
        ("pitch and yaw", make(vec![same(0.2, -0.9, 0.4), same(-2.7, 1.4, 0.2), turned((-1.3, 0.5), (-1.1, 0.9, -0.5), 0.4)])),
        ("strong perspective", make([(0.4, 0.7), (1.9, -1.2)].map(|t| turned(t, (6.0, -11.0, 4.0), 0.5)).to_vec())),
        ("extreme perspective", make(vec![turned((0.4, 0.7), (-14.0, 24.0, 8.0), 1.0)])),
        ("partly beyond the frame", planar(&[(0.6 * width as f64, 2.3, 0.4, 0.5), (0.2, -3.4, 0.0, 0.5)])),
        ("wholly beyond the frame", planar(&[(2.0 * width as f64 + 40.5, 90.25, 0.0, 1.0)])),
    ]
}

/// Bound of the f32 error of one entry of K x or Kᵀ y for inputs within ±1.
///
/// The displacement H⁻¹q - q carries 5 roundings (coefficient, product, sum, perspective sum, division) of its size D; an
/// interpolation's weights sum to at most 1.5 in absolute value per axis and their slopes to at most 4, so a position error
/// δ on both axes moves a value by 2 · 4 · 1.5 δ. The sums of 4 S² and of all taps round once per term, at most.
fn tolerance(taps: &TapSet, frame: (usize, usize), support: usize) -> f64 {
    let half_ulp = 2f64.powi(-24);
    let reach = taps.taps.iter().map(|t| t.dx.abs().max(t.dy.abs())).max().unwrap_or(0) as f64;
    let corner = DVec2::new(frame.0 as f64, frame.1 as f64) / 2.0 + reach;
    let mut displacement = 1.0f64;
    for h in &taps.bases {
        for s in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            let q = corner * DVec2::new(s.0, s.1);
            displacement = displacement.max((blur::transform(&h.inverse(), q) - q).abs().max_element());
        }
    }
    let total: f64 = taps.taps.iter().map(|t| t.weight.abs()).sum();
    total * half_ulp * (12.0 * 5.0 * displacement + (4 * support * support + taps.taps.len()) as f64)
}

struct Case {
    name: String,
    kind: &'static (Gpu, Kernels),
    frame: (usize, usize),
    pad: usize,
    interpolation: Interpolation,
    matrix: Matrix,
    blur: Blur,
    tolerance: f64,
}

/// Rotate-then-shift, as scratch planes or by tiles.
fn shifted(tsf: &Tsf, frame: (usize, usize), interpolation: Interpolation) -> TapSet {
    TapSet::shifted(tsf, frame.0, frame.1, interpolation)
}

/// Every pose for itself.
fn direct(tsf: &Tsf, frame: (usize, usize), _: Interpolation) -> TapSet {
    TapSet::direct(tsf, frame.0, frame.1)
}

impl Case {
    fn new(
        name: &str,
        kind: &'static (Gpu, Kernels),
        taps: &TapSet,
        frame: (usize, usize),
        pad: usize,
        interpolation: Interpolation,
    ) -> Self {
        Self {
            name: format!("{name}, {} x {} pixels, pad {pad}, {interpolation:?}, software: {}", frame.0, frame.1, kind.0.software),
            kind,
            frame,
            pad,
            interpolation,
            matrix: blur::of_taps(taps, interpolation, frame, pad),
            blur: Blur::new(&kind.0, kind.1.blur(interpolation), taps, frame, pad),
            tolerance: tolerance(taps, frame, interpolation.support()),
        }
    }

    fn counts(&self) -> (usize, usize) {
        ((self.frame.0 + 2 * self.pad) * (self.frame.1 + 2 * self.pad), self.frame.0 * self.frame.1)
    }

    /// [`Case::check`] of three channels at a time and of one.
    fn check_with(&self, size: ScratchSize) {
        for channels in [3, 1] {
            self.check(&Scratch::new(&self.kind.0, size, channels).expect("fits"));
        }
    }

    fn forward(&self, scratch: &Scratch, latent: &DeviceRgb) -> [Vec<f32>; 3] {
        let m = self.counts().1;
        let out = [poisoned(m), poisoned(m), poisoned(m)];
        let kernels = self.kind.1.blur(self.interpolation);
        for (latent, out) in latent.chunks(scratch.channels()).zip(out.chunks(scratch.channels())) {
            run(&self.blur.forward(&self.kind.0, kernels, scratch, latent, out));
        }
        out.map(|o| read(&o, m))
    }

    /// `start + factor Kᵀ frame`.
    fn adjoint(&self, scratch: &Scratch, frame: &DeviceRgb, start: &[Vec<f32>; 3], factor: f32) -> [Vec<f32>; 3] {
        let out = planes(start);
        let kernels = self.kind.1.blur(self.interpolation);
        for (frame, out) in frame.chunks(scratch.channels()).zip(out.chunks(scratch.channels())) {
            run(&self.blur.adjoint(&self.kind.0, kernels, scratch, frame, out, factor));
        }
        out.map(|o| read(&o, self.counts().0))
    }

    /// Both operators on noise, and columns of both.
    fn check(&self, scratch: &Scratch) {
        let (n, m) = self.counts();
        let latent = [noise(1, n), noise(2, n), noise(3, n)];
        for (c, got) in self.forward(scratch, &with_more(&latent)).iter().enumerate() {
            let expected = self.matrix.apply(&f64s(&latent[c]));
            assert_close(&format!("K, channel {c}, {}", self.name), got, &expected, |_| self.tolerance);
        }
        let frame = [noise(4, m), noise(5, m), noise(6, m)];
        let (start, factor) = ([noise(7, n), noise(8, n), noise(9, n)], 0.75f32);
        for (c, got) in self.adjoint(scratch, &with_more(&frame), &start, factor).iter().enumerate() {
            let back = self.matrix.transposed(&f64s(&frame[c]));
            let expected: Vec<f64> = start[c].iter().zip(&back).map(|(&s, b)| f64::from(s) + f64::from(factor) * b).collect();
            // A source pixel may have somewhat more targets than a target has sources.
            assert_close(&format!("Kᵀ, channel {c}, {}", self.name), got, &expected, |_| 2.0 * self.tolerance + 2e-7);
        }
        // Columns: three unit vectors at once, one per channel.
        let unit = |i: usize, count: usize| (0..count).map(|k| if k == i { 1.0 } else { 0.0 }).collect::<Vec<f32>>();
        let (w, h) = self.frame;
        for pixels in [[0, w - 1, m - w], [m - 1, (h / 2) * w + w / 2, (h / 3) * w + w / 4]] {
            let units = pixels.map(|i| unit(i, m));
            let zero = [vec![0.0; n], vec![0.0; n], vec![0.0; n]];
            for (c, got) in self.adjoint(scratch, &with_more(&units), &zero, 1.0).iter().enumerate() {
                let expected = self.matrix.transposed(&f64s(&units[c]));
                assert_close(&format!("row {} of K by Kᵀ, {}", pixels[c], self.name), got, &expected, |_| self.tolerance);
            }
        }
        let middle = (h / 2 + self.pad) * (w + 2 * self.pad) + w / 2 + self.pad;
        let units = [0, middle, n - 1].map(|i| unit(i, n));
        for (c, got) in self.forward(scratch, &with_more(&units)).iter().enumerate() {
            let expected = self.matrix.apply(&f64s(&units[c]));
            assert_close(&format!("column of K, channel {c}, {}", self.name), got, &expected, |_| self.tolerance);
        }
    }
}

fn check_all(interpolation: Interpolation) {
    for frame in SIZES {
        for (name, tsf) in motions(frame.0) {
            for pad in [0, 5] {
                for (how, taps) in [("shifted", shifted as fn(&_, _, _) -> _), ("direct", direct)] {
                    for kind in kinds() {
                        let case = Case::new(&format!("{how}, {name}"), kind, &taps(&tsf, frame, interpolation), frame, pad, interpolation);
                        // More than the operator asks for: what lies beyond must not be read.
                        let wanted = case.blur.scratch_wanted();
                        case.check_with(ScratchSize { planes: wanted.planes + 1, copy: wanted.copy + 1 });
                    }
                }
            }
        }
    }
}

#[test]
fn bilinear_blur_and_adjoint_equal_the_matrix() {
    check_all(Interpolation::Bilinear);
}

#[test]
fn bicubic_blur_and_adjoint_equal_the_matrix() {
    check_all(Interpolation::Bicubic);
}

#[test]
fn six_point_blur_and_adjoint_equal_the_matrix() {
    check_all(Interpolation::SixPoint);
}

#[test]
fn a_frame_six_thousand_pixels_wide_keeps_its_precision() {
    let poses = vec![Pose::planar(0.3, -0.2, 0.15, 0.6), Pose::planar(2.8, 0.4, 0.16, 0.4)];
    let (tsf, frame) = (Tsf::new(7000.0, poses).expect("valid"), (6001, 3));
    for taps in [shifted, direct] {
        for kind in kinds() {
            let case = Case::new("wide", kind, &taps(&tsf, frame, Interpolation::Bicubic), frame, 12, Interpolation::Bicubic);
            case.check_with(case.blur.scratch_wanted());
        }
    }
}

#[test]
fn several_passes_equal_one() {
    let frame = (33, 21);
    let [software, _] = kinds();
    for (name, tsf) in motions(33).into_iter().filter(|m| ["rotations", "pitch and yaw", "partly beyond the frame"].contains(&m.0)) {
        for kind in kinds() {
            let direct = Case::new(name, kind, &direct(&tsf, frame, Interpolation::Bicubic), frame, 4, Interpolation::Bicubic);
            direct.check_with(direct.blur.scratch_needed());
        }
        let case = Case::new(name, software, &shifted(&tsf, frame, Interpolation::Bicubic), frame, 4, Interpolation::Bicubic);
        let (least, wanted) = (case.blur.scratch_needed(), case.blur.scratch_wanted());
        assert!(wanted.planes > 3 * least.planes && wanted.copy > least.copy, "{name}: {wanted:?} {least:?}");
        for planes in [least.planes, least.planes + 1, 3 * least.planes, wanted.planes / 2, wanted.planes - 1] {
            for copy in [least.copy, wanted.copy] {
                case.check_with(ScratchSize { planes, copy });
            }
        }
    }
}

#[test]
fn a_base_warp_that_serves_one_pose_is_that_pose() {
    let of = |poses: &[Pose]| TapSet::shifted(&Tsf::new(40.0, poses.to_vec()).expect("valid"), 33, 21, Interpolation::Bicubic);
    let (one, other) = (turned((0.2, -0.9), (0.4, -0.8, 0.3), 0.6), turned((-1.3, 0.5), (-1.1, 0.9, -0.5), 0.4));
    let apart = of(&[one, other]);
    assert!(apart.is_direct(), "nothing is left to be shifted: {:?}", apart.taps);
    for (base, pose) in apart.bases.iter().zip([one, other]) {
        assert!((*base - pose.homography(40.0)).to_cols_array().iter().all(|d| d.abs() < 1e-12), "{base} for {pose:?}");
    }
    let shared = of(&[one, other, Pose { t_x: -2.7, ..one }]);
    let taps = |b: usize| shared.taps.iter().filter(|t| t.base == b).count();
    assert!(shared.bases.len() == 2 && taps(0) > 16 && taps(1) == 1, "{:?}", shared.taps);
}

/// 512 base warps are bound at a time.
#[test]
fn more_base_warps_than_a_binding_holds_are_done_in_parts() {
    let pose = |i: i32| Pose::planar(0.3 * f64::from(i % 25), 0.3 * f64::from(i / 25), 0.02 * f64::from(i % 7), 1.0 / 600.0);
    let (tsf, frame) = (Tsf::new(900.0, (0..600).map(pose).collect()).expect("valid"), (17, 9));
    let taps = TapSet::direct(&tsf, 17, 9);
    assert!(taps.bases.len() > 512);
    // The same with a shift, so that tiles do it.
    let shifted = TapSet { bases: taps.bases.clone(), taps: taps.taps.iter().map(|t| Tap { dx: 1, ..*t }).collect() };
    for (kind, taps) in kinds().iter().flat_map(|k| [(k, &taps), (k, &shifted)]) {
        let case = Case::new("600 poses", kind, taps, frame, 10, Interpolation::Bilinear);
        case.check_with(case.blur.scratch_wanted());
    }
}

/// Shifts that reach farther than workgroup memory does, and more of them than a table holds: parts of a base warp.
#[test]
fn tiles_split_long_paths() {
    let (frame, pad) = ((67, 45), 30);
    let bases: Vec<DMat3> = [-0.6, 0.5].map(|theta| Pose::planar(0.0, 0.0, theta, 1.0).rotation(90.0)).to_vec();
    let long = (-28..=28).flat_map(|i| [(0, i, i / 3), (1, i / 2, -i)]);
    let square = (-35..=35).flat_map(|x| (-35..=35).map(move |y| (0, x, y))).filter(|t| (t.1 * 7 + t.2 * 3) % 4 != 0);
    let set = |shifts: Vec<(usize, i32, i32)>| {
        let weight = |i: usize| (1.0 + 0.5 * (i as f64).sin()) / shifts.len() as f64;
        let taps = shifts.iter().enumerate().map(|(i, &(base, dx, dy))| Tap { base, dx, dy, weight: weight(i) }).collect();
        TapSet { bases: bases.clone(), taps }
    };
    let [_, gpu] = kinds();
    for (name, taps) in [("long path", set(long.collect())), ("dense square", set(square.chain([(1, 3, 4)]).collect()))] {
        let case = Case::new(name, gpu, &taps, frame, pad, Interpolation::Bicubic);
        assert_eq!(case.blur.scratch_wanted(), ScratchSize::default(), "{name}: by tiles");
        case.check_with(case.blur.scratch_wanted());
    }
}

#[test]
fn scratch_is_shared_without_traces() {
    for kind in kinds() {
        let scratch = Scratch::new(&kind.0, ScratchSize { planes: 40 * 60 * 110, copy: 300 * 200 }, 3).expect("fits");
        for round in 0..2 {
            for (name, tsf) in motions(33).iter().take(7) {
                let taps = shifted(tsf, (33, 21), Interpolation::Bicubic);
                let case = Case::new(&format!("round {round}, {name}"), kind, &taps, (33, 21), 4, Interpolation::Bicubic);
                let loud = [1.0f32, 2.0, 3.0].map(|v| vec![v * POISON; case.counts().0]);
                case.forward(&scratch, &with_more(&loud));
                case.check(&scratch);
            }
        }
    }
}

#[test]
fn interpolations_reproduce_polynomials() {
    for (interpolation, degree) in ALL.into_iter().zip([1, 2, 3]) {
        for step in 0..40 {
            let f = f64::from(step) / 40.0;
            for n in 0..=degree {
                let sum: f64 = (-4..=4).map(|k| blur::weight(interpolation, f64::from(k) - f) * f64::from(k).powi(n)).sum();
                assert!((sum - f.powi(n)).abs() < 1e-12, "{interpolation:?} of x^{n} at {f}: {sum}");
            }
        }
        for x in noise(11, 500).iter().map(|&v| 4.0 * f64::from(v)) {
            let (w, e) = (interpolation.weight(x), 1e-6);
            assert!((w - blur::weight(interpolation, x)).abs() < 1e-14, "{interpolation:?} at {x}");
            let slope = (blur::weight(interpolation, x + e) - blur::weight(interpolation, x - e)) / (2.0 * e);
            assert!((interpolation.slope(x) - slope).abs() < 1e-5, "{interpolation:?}: slope at {x}");
        }
    }
}

/// Poses of a TSF as (homography, weight), composed here and not by `Pose`: T K exp([θ]×) K⁻¹, the exponential by its series.
fn homographies(tsf: &Tsf) -> Vec<(DMat3, f64)> {
    tsf.poses
        .iter()
        .map(|p| {
            let (x, y, z) = (p.theta_x_deg.to_radians(), p.theta_y_deg.to_radians(), p.theta_z_deg.to_radians());
            let phi = DMat3::from_cols_array(&[0.0, z, -y, -z, 0.0, x, y, -x, 0.0]);
            let (mut rotation, mut term) = (DMat3::IDENTITY, DMat3::IDENTITY);
            for n in 1..20 {
                term = term * phi * (1.0 / f64::from(n));
                rotation += term;
            }
            let f = tsf.focal_px;
            let k = DMat3::from_cols_array(&[f, 0.0, 0.0, 0.0, f, 0.0, 0.0, 0.0, 1.0]);
            let shift = DMat3::from_cols_array(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, p.t_x, p.t_y, 1.0]);
            (shift * k * rotation * k.inverse(), p.weight)
        })
        .collect()
}

#[test]
fn translations_become_taps_without_loss() {
    for interpolation in ALL {
        for (name, tsf) in motions(17).into_iter().filter(|m| ["integer shift", "fractional shifts"].contains(&m.0)) {
            let taps = TapSet::shifted(&tsf, 17, 9, interpolation);
            assert_eq!(taps.bases.len(), 1, "{name}");
            let (got, expected) =
                (blur::of_taps(&taps, interpolation, (17, 9), 8), blur::of_poses(&homographies(&tsf), interpolation, (17, 9), 8));
            let latent = f64s(&noise(21, got.columns));
            // Taps below 5e-4 of the largest are dropped, at most 4 S² per pose, and the others scaled back to sum 1.
            let largest = taps.taps.iter().fold(0.0f64, |a, t| a.max(t.weight.abs()));
            let bound = 2.0 * 5e-4 * largest * (4 * interpolation.support().pow(2) * tsf.poses.len()) as f64;
            for (a, b) in got.apply(&latent).iter().zip(expected.apply(&latent)) {
                assert!((a - b).abs() <= bound, "{name}, {interpolation:?}: {a} {b}");
            }
        }
    }
}

#[test]
fn taps_see_what_the_poses_see() {
    // An image whose wavelengths are long (16 to 30 px), so that interpolation costs little and misplaced pixels much.
    let waves = [(0.38, 0.11, 0.3), (-0.17, 0.29, 1.1), (0.05, -0.35, 2.0)];
    let image = |p: DVec2| waves.iter().map(|w: &(f64, f64, f64)| (w.0 * p.x + w.1 * p.y + w.2).sin() / 3.0).sum::<f64>();
    let gradient = waves.iter().map(|w| w.0.hypot(w.1) / 3.0).sum::<f64>();
    let curvature = waves.iter().map(|w| (w.0 * w.0 + w.1 * w.1) / 3.0).sum::<f64>();
    let (frame, pad) = ((61usize, 47usize), 16usize);
    let centre = DVec2::new(30.0, 23.0);
    for (name, tsf) in motions(frame.0).into_iter().filter(|m| !m.0.contains("beyond") && m.0 != "extreme perspective") {
        let poses = homographies(&tsf);
        for (pose, (h, _)) in tsf.poses.iter().zip(&poses) {
            let p = DVec2::new(-20.0, 13.0);
            assert!((pose.apply(tsf.focal_px, p) - blur::transform(h, p)).length() < 1e-9, "{name}: {pose:?}");
        }
        let taps = TapSet::shifted(&tsf, frame.0, frame.1, Interpolation::SixPoint);
        let matrix = blur::of_taps(&taps, Interpolation::SixPoint, frame, pad);
        let width = frame.0 + 2 * pad;
        let at = |i: usize| DVec2::new((i % width) as f64, (i / width) as f64) - DVec2::splat(pad as f64) - centre;
        let latent: Vec<f64> = (0..matrix.columns).map(|i| image(at(i))).collect();
        let ones = matrix.apply(&vec![1.0; matrix.columns]);
        // Poses that share a base are off by 0.3 px at most. Two interpolations of fourth order: below 1e-3 at these wavelengths;
        // dropped taps too.
        let shared = taps.bases.len() < tsf.poses.len();
        let bound = if shared { 0.3 * gradient } else { 0.5 * 0.0625 * curvature } + 3e-3;
        let mut interior = 0;
        for (i, got) in matrix.apply(&latent).iter().enumerate() {
            if (ones[i] - 1.0).abs() < 1e-9 {
                let q = DVec2::new((i % frame.0) as f64, (i / frame.0) as f64) - centre;
                let expected: f64 = poses.iter().map(|(h, w)| w * image(blur::transform(&h.inverse(), q))).sum();
                assert!((got - expected).abs() <= bound, "{name} at {q}: {got}, expected {expected} within {bound}");
                interior += 1;
            }
        }
        assert!(interior > frame.0 * frame.1 / 2, "{name}: only {interior} pixels see inside");
    }
}

#[test]
fn nearby_poses_with_pitch_and_yaw_share_a_base() {
    let poses = (0..8).map(|i| turned((0.0, 0.0), (0.02 * f64::from(i), 0.3 - 0.05 * f64::from(i), 0.0), 0.125)).collect();
    let tsf = Tsf::new(80.0, poses).expect("valid");
    let taps = TapSet::shifted(&tsf, 61, 47, Interpolation::Bicubic);
    assert!(taps.bases.len() < 8, "{} bases", taps.bases.len());
    let total: f64 = taps.taps.iter().map(|t| t.weight).sum();
    assert!((total - 1.0).abs() < 1e-12);
    // The centre's PSF must lie where the poses put the centre, on average.
    let mean = taps.taps.iter().fold(DVec2::ZERO, |a, t| {
        let base = blur::transform(&taps.bases[t.base], DVec2::ZERO);
        a + t.weight * (base + DVec2::new(f64::from(t.dx), f64::from(t.dy)))
    });
    let expected = homographies(&tsf).iter().fold(DVec2::ZERO, |a, (h, w)| a + *w * blur::transform(h, DVec2::ZERO));
    assert!((mean - expected).length() < 0.05, "{mean} {expected}");
}

#[test]
fn energy_is_the_sum_of_squares_of_the_psf() {
    let two = Tsf::new(500.0, vec![Pose::planar(0.0, 0.0, 0.0, 0.75), Pose::planar(4.0, 1.0, 0.0, 0.25)]).expect("valid");
    for taps in [TapSet::shifted(&two, 17, 9, Interpolation::Bicubic), TapSet::direct(&two, 17, 9)] {
        let energy = taps.energy();
        assert!((energy - (0.75 * 0.75 + 0.25 * 0.25)).abs() < 1e-12, "{energy}");
    }
}

#[test]
fn nan_and_infinity_are_refused() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let error = gpu().upload("plane", &[0.0, bad]).expect_err("must be refused").to_string();
        assert!(error.contains("plane") && error.contains("value 1"), "{error}");
    }
    assert_eq!(read(&buffer(&[1.5]), 1), [1.5]);
}

/// A path of 3000 poses: a slow swing with a fast tremor, in shuffled order.
fn long_path() -> Tsf {
    let at = |i: usize| {
        let t = (i * 1009 % 3000) as f64 / 3000.0;
        let weight = 1.0 + (9.0 * t).sin() * 0.3;
        Pose::planar(6.0 * (4.0 * t).sin() + 0.8 * (60.0 * t).sin(), 5.0 * t * t + 0.6 * (47.0 * t).cos(), 0.8 * (3.0 * t).cos(), weight)
    };
    Tsf::new(900.0, (0..3000).map(at).collect()).expect("valid")
}

#[test]
fn poses_that_no_pixel_tells_apart_become_one() {
    let (tsf, size) = (long_path(), (640, 480));
    let half = DVec2::new(319.5, 239.5);
    let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|s| half * DVec2::new(s.0, s.1));
    for bound in [INDISTINGUISHABLE, 0.5] {
        let merged = tsf.merged(size.0, size.1, bound);
        assert!(merged.poses.len() < if bound > 0.2 { 1000 } else { 2000 }, "{bound} px: {}", merged.poses.len());
        assert!((merged.poses.iter().map(|p| p.weight).sum::<f64>() - 1.0).abs() < 1e-12);
        for p in &tsf.poses {
            let farthest = |q: &Pose| corners.iter().map(|&c| (p.apply(900.0, c) - q.apply(900.0, c)).length()).fold(0.0, f64::max);
            let near = merged.poses.iter().map(farthest).fold(f64::INFINITY, f64::min);
            assert!(near <= bound, "{p:?} is {near} px from the nearest of what it became");
        }
        // The mean stays where it was, and a second pass changes little.
        let (a, b) = (tsf.mean(), merged.mean());
        assert!((a.t_x - b.t_x).abs() + (a.t_y - b.t_y).abs() + (a.theta_z_deg - b.theta_z_deg).abs() < 1e-9);
    }
}

#[test]
fn a_pose_is_never_far_from_its_base_warp() {
    let (tsf, size) = (long_path(), (640, 480));
    let taps = TapSet::shifted(&tsf, size.0, size.1, Interpolation::Bilinear);
    let angles: Vec<f64> = taps.bases.iter().map(|h| h.x_axis.y.atan2(h.x_axis.x).to_degrees()).collect();
    for p in &tsf.poses {
        let near = angles.iter().map(|a| (a - p.theta_z_deg).abs()).fold(f64::INFINITY, f64::min);
        assert!(near.to_radians() * 400.0 <= 0.3 + 1e-9, "{p:?}: {near} degrees");
    }
    assert!(taps.bases.len() < 25 && taps.taps.len() < 1500, "{} bases, {} taps", taps.bases.len(), taps.taps.len());
    // A path is cheaper shifted, a single pose direct.
    assert_eq!(TapSet::new(&tsf, size.0, size.1, Interpolation::Bilinear).taps, taps.taps);
    let one = Tsf::new(900.0, vec![Pose::planar(1.3, -0.4, 0.2, 1.0)]).expect("valid");
    let taps = TapSet::new(&one, size.0, size.1, Interpolation::Bilinear);
    // Whole pixels cost nothing, as a shift.
    assert_eq!((taps.bases.len(), taps.taps.len(), taps.taps[0].dx, taps.taps[0].dy), (1, 1, 1, 0));
}

#[test]
fn the_rough_blur_costs_less_and_is_about_the_same() {
    // A path as cameras draw it: a degree of roll, a dozen pixels.
    let at = |i: usize| {
        let t = f64::from(i as u32) / 60.0;
        Pose::planar(9.0 * (2.0 * t).sin(), 6.0 * t * t - 0.9 * (11.0 * t).cos(), 0.5 * (2.5 * t).cos(), 1.0 + 0.5 * (5.0 * t).sin())
    };
    let (tsf, size) = (Tsf::new(900.0, (0..60).map(at).collect()).expect("valid"), (640, 480));
    let exact = TapSet::new(&tsf, size.0, size.1, Interpolation::Bicubic);
    let rough = exact.rougher(&tsf, size.0, size.1, Interpolation::Bicubic).expect("a path");
    assert!(3 * rough.bases.len() <= 2 * exact.bases.len(), "{} of {} base warps", rough.bases.len(), exact.bases.len());
    assert!(3 * rough.taps.len() <= 2 * exact.taps.len(), "{} of {} taps", rough.taps.len(), exact.taps.len());
    assert!((rough.taps.iter().map(|t| t.weight).sum::<f64>() - 1.0).abs() < 1e-12);
    // Power at a frequency: what K^T K is made of.
    let power = |set: &TapSet, f: DVec2| {
        let (re, im) = set.taps.iter().fold((0.0, 0.0), |(re, im), t| {
            let (sin, cos) = (std::f64::consts::TAU * f.dot(DVec2::new(f64::from(t.dx), f64::from(t.dy)))).sin_cos();
            (re + t.weight * cos, im + t.weight * sin)
        });
        re * re + im * im
    };
    for f in [(0.01, 0.0), (0.0, 0.03), (0.05, 0.02), (0.1, -0.1), (0.2, 0.15), (0.4, 0.0), (0.3, 0.4)] {
        let f = DVec2::from(f);
        let (a, b) = (power(&exact, f), power(&rough, f));
        assert!((a - b).abs() <= 0.02 + 0.1 * a, "at {f}: {b} for {a}");
    }
    // A pose alone stays what it is.
    let one = Tsf::new(900.0, vec![Pose::planar(1.3, -0.4, 0.2, 1.0)]).expect("valid");
    let exact = TapSet::new(&one, 640, 480, Interpolation::Bicubic);
    assert!(exact.rougher(&one, 640, 480, Interpolation::Bicubic).is_none());
}

/// K and Kᵀ of every band on a device whose bindings hold less than a plane.
#[test]
fn planes_larger_than_a_binding_are_bound_in_bands() {
    for software in [true, false] {
        check_bands(&gpu().treated_as(software).with_binding_limit(96 * 1024));
    }
}

fn check_bands(gpu: &Gpu) {
    let kernels = Kernels::new(gpu);
    let (frame, pad) = ((120, 500), 8);
    let (n, m) = ((frame.0 + 2 * pad) * (frame.1 + 2 * pad), frame.0 * frame.1);
    assert!(m > gpu.max_binding());
    let tsf = Tsf::new(500.0, vec![Pose::planar(0.4, -0.3, -0.4, 0.6), Pose::planar(2.2, 3.8, 0.5, 0.4)]).expect("valid");
    for taps in [TapSet::shifted(&tsf, frame.0, frame.1, Interpolation::Bilinear), TapSet::direct(&tsf, frame.0, frame.1)] {
        let blur = Blur::new(gpu, kernels.blur(Interpolation::Bilinear), &taps, frame, pad);
        let most = ScratchSize { planes: gpu.max_texels(), copy: gpu.max_texels() };
        let scratch = Scratch::new(gpu, blur.scratch_wanted().min(most), 3).expect("fits");
        let upload = |seed: u64, count: usize| -> ([Vec<f32>; 3], DeviceRgb) {
            let values = [noise(seed, count), noise(seed + 1, count), noise(seed + 2, count)];
            let buffers = values.each_ref().map(|v| gpu.upload("test", v).expect("fits"));
            (values, buffers)
        };
        let ((latent, e), (seen, b)) = (upload(1, n), upload(4, m));
        let ((_, out), (start, back)) = (upload(7, m), upload(10, n));
        gpu.submit(&blur.forward(gpu, kernels.blur(Interpolation::Bilinear), &scratch, &e, &out));
        gpu.submit(&blur.adjoint(gpu, kernels.blur(Interpolation::Bilinear), &scratch, &b, &back, 1.0));
        let matrix = blur::of_taps(&taps, Interpolation::Bilinear, frame, pad);
        let bound = tolerance(&taps, frame, 1);
        for c in 0..3 {
            let got = unshaken::gpu::read(gpu, &out[c], m).expect("the device answers");
            assert_close("K in bands", &got, &matrix.apply(&f64s(&latent[c])), |_| bound);
            let got = unshaken::gpu::read(gpu, &back[c], n).expect("the device answers");
            let expected = matrix.transposed(&f64s(&seen[c]));
            let expected: Vec<f64> = expected.iter().zip(&start[c]).map(|(e, &s)| e + f64::from(s)).collect();
            assert_close("Kᵀ in bands", &got, &expected, |_| 2.0 * bound + 2e-7);
        }
    }
}

#[test]
fn a_frame_twelve_thousand_pixels_wide_runs_in_one_piece_and_in_bands() {
    let (frame, pad) = ((12000, 64), 8);
    let (n, m) = ((frame.0 + 2 * pad) * (frame.1 + 2 * pad), frame.0 * frame.1);
    let tsf = Tsf::new(9000.0, vec![Pose::planar(0.3, -0.2, 0.02, 0.5), Pose::planar(2.3, 3.4, 0.0, 0.5)]).expect("valid");
    let taps = TapSet::shifted(&tsf, frame.0, frame.1, Interpolation::Bilinear);
    let [(gpu, kernels), (fast, others)] = kinds();
    let kernels = kernels.blur(Interpolation::Bilinear);
    let blur = Blur::new(gpu, kernels, &taps, frame, pad);
    let (latent, seen) = (planes(&[1, 2, 3].map(|s| noise(s, n))), planes(&[4, 5, 6].map(|s| noise(s, m))));
    let (least, wanted) = (blur.scratch_needed(), blur.scratch_wanted());
    let results = [wanted, ScratchSize { planes: wanted.planes / 7, copy: (wanted.copy / 2).max(least.copy) }].map(|size| {
        let scratch = Scratch::new(gpu, size, 3).expect("fits");
        let (out, back) = ([poisoned(m), poisoned(m), poisoned(m)], planes(&[7, 8, 9].map(|s| noise(s, n))));
        let (forward, adjoint) =
            (blur.forward(gpu, kernels, &scratch, &latent, &out), blur.adjoint(gpu, kernels, &scratch, &seen, &back, 1.0));
        let steps = forward.len() + adjoint.len();
        run(&forward);
        run(&adjoint);
        (steps, read(&out[1], m), read(&back[1], n))
    });
    let [(few, k, t), (many, k_bands, t_bands)] = results;
    assert!(many > few, "{few} and {many} steps");
    let far = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(far(&k, &k_bands) < 1e-5 && far(&t, &t_bands) < 1e-5, "{} {}", far(&k, &k_bands), far(&t, &t_bands));
    // No pixel was left out: K of noise is nowhere what the buffer held, and Kᵀ moved the start.
    assert!(k.iter().all(|v| v.abs() < 2.0) && t.iter().all(|v| v.is_finite()));
    // As tiles, which compute in another order.
    let kernels = others.blur(Interpolation::Bilinear);
    let blur = Blur::new(fast, kernels, &taps, frame, pad);
    let scratch = Scratch::new(fast, blur.scratch_wanted(), 3).expect("fits");
    let (out, back) = ([poisoned(m), poisoned(m), poisoned(m)], planes(&[7, 8, 9].map(|s| noise(s, n))));
    run(&blur.forward(fast, kernels, &scratch, &latent, &out));
    run(&blur.adjoint(fast, kernels, &scratch, &seen, &back, 1.0));
    let (k_tiles, t_tiles) = (read(&out[1], m), read(&back[1], n));
    assert!(far(&k, &k_tiles) < 1e-5 && far(&t, &t_tiles) < 1e-5, "{} {}", far(&k, &k_tiles), far(&t, &t_tiles));
}
