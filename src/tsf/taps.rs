//! A TSF as base warps and integer shifts: the form in which the blur K of eq. (4) is computed.
//!
//! `K = sum over bases b of (small sparse kernel_b) * (Warp_b E)`: the bases hold the rotations, and a fractional translation
//! is its interpolation kernel splatted on integer shifts. The cost depends on the length of the camera's path in pixels, not
//! on the number of poses that sample it.

use super::Tsf;
use crate::pose::{Pose, project};
use glam::{DMat3, DVec2};
use std::collections::BTreeMap;

/// Interpolation of the warps: half-width of its kernel in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// Two taps per axis, at half the time of the longer kernels. It is itself a blur: with the true poses the operator is off by
    /// 1.5 to 3.7 % of the blurred image.
    Bilinear,
    /// Four taps per axis: cubic convolution (Keys 1981, a = -1/2).
    Bicubic,
    /// Six taps per axis: Keys' cubic convolution of fourth order.
    SixPoint,
}

impl Interpolation {
    /// Half-width of the kernel in pixels.
    pub fn support(self) -> usize {
        match self {
            Self::Bilinear => 1,
            Self::Bicubic => 2,
            Self::SixPoint => 3,
        }
    }

    /// Weight at distance `x` in pixels; the weights of any fractional position sum to 1.
    pub fn weight(self, x: f64) -> f64 {
        let t = x.abs();
        match self {
            Self::Bilinear => (1.0 - t).max(0.0),
            Self::Bicubic if t < 1.0 => (1.5 * t - 2.5) * t * t + 1.0,
            Self::Bicubic if t < 2.0 => ((-0.5 * t + 2.5) * t - 4.0) * t + 2.0,
            Self::SixPoint if t < 1.0 => (4.0 / 3.0 * t - 7.0 / 3.0) * t * t + 1.0,
            Self::SixPoint if t < 2.0 => ((-7.0 / 12.0 * t + 3.0) * t - 59.0 / 12.0) * t + 2.5,
            Self::SixPoint if t < 3.0 => ((t / 12.0 - 2.0 / 3.0) * t + 1.75) * t - 1.5,
            _ => 0.0,
        }
    }

    /// Derivative of [`Interpolation::weight`].
    pub fn slope(self, x: f64) -> f64 {
        let t = x.abs();
        let d = match self {
            Self::Bilinear if t < 1.0 => -1.0,
            Self::Bicubic if t < 1.0 => (4.5 * t - 5.0) * t,
            Self::Bicubic if t < 2.0 => (-1.5 * t + 5.0) * t - 4.0,
            Self::SixPoint if t < 1.0 => (4.0 * t - 14.0 / 3.0) * t,
            Self::SixPoint if t < 2.0 => (-1.75 * t + 6.0) * t - 59.0 / 12.0,
            Self::SixPoint if t < 3.0 => (0.25 * t - 4.0 / 3.0) * t + 1.75,
            _ => 0.0,
        };
        d * x.signum()
    }
}

/// One shift of one base warp: `frame(q) += weight * warp_base(q - (dx, dy))`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tap {
    /// Index of the base warp.
    pub base: usize,
    /// Shift to the right, pixels.
    pub dx: i32,
    /// Shift down, pixels.
    pub dy: i32,
    /// Weight; the taps' weights sum to 1.
    pub weight: f64,
}

/// Base warps (homographies of the scene to the frame, centred pixels) and taps, sorted by (base, dy, dx).
#[derive(Clone, Debug)]
pub struct TapSet {
    /// The warps' homographies.
    pub bases: Vec<DMat3>,
    /// The shifts.
    pub taps: Vec<Tap>,
}

/// Span of the angles that share a base warp, as the displacement of the worst pixel: the base lies in their middle, so that no pixel is
/// off by more than half of this, and the errors of a path's many poses average out. Splitting a pose between two bases would double the
/// taps for no smaller error (it blurs by as much).
const TOLERANCE: f64 = 0.6;
/// The same for [`TapSet::rougher`].
const ROUGH_TOLERANCE: f64 = 1.2;

/// Taps below this fraction of the largest are dropped: together they are below the 8-bit quantisation of any pixel.
const NEGLIGIBLE: f64 = 5e-4;
/// The same for [`TapSet::rougher`]: several per cent of the weight are dropped.
const ROUGHLY_NEGLIGIBLE: f64 = 2e-2;

/// What a load of a warp, which has its own arithmetic, costs in taps: a bicubic warp of sixteen and its adjoint take 100 ns per pixel of three
/// channels on lavapipe, a tap and its adjoint 2.1 ns.
pub const WARP_COST: f64 = 3.0;

/// Largest distance in pixels, anywhere in the frame, between poses that [`TapSet::direct`] makes one: see [`Tsf::merged`].
pub const INDISTINGUISHABLE: f64 = 0.1;

impl TapSet {
    /// The cheaper of [`TapSet::direct`] and [`TapSet::shifted`] on a `width` x `height` frame: a single pose as itself, which costs one
    /// warp; a path, as base warps and shifts.
    pub fn new(tsf: &Tsf, width: usize, height: usize, interpolation: Interpolation) -> Self {
        if let Some(motion) = tsf.single().filter(|_| !tsf.is_identity()) {
            return Self::still(&motion);
        }
        let (direct, shifted) = (Self::direct(tsf, width, height), Self::shifted(tsf, width, height, interpolation));
        if direct.cost(interpolation) <= shifted.cost(interpolation) { direct } else { shifted }
    }

    /// About the same blur as this one of `tsf` at about half the cost, for the matrix of a Gauss-Newton step: the residual that the step starts
    /// from decides where the iteration ends, the matrix only how fast. Poses are displaced by up to 0.6 px. `None` where that costs no less.
    pub fn rougher(&self, tsf: &Tsf, width: usize, height: usize, interpolation: Interpolation) -> Option<Self> {
        let rough = Self::shifted_within(tsf, width, height, interpolation, ROUGH_TOLERANCE, ROUGHLY_NEGLIGIBLE);
        (rough.cost(interpolation) < self.cost(interpolation)).then_some(rough)
    }

    /// Whether each tap is a base warp of its own that nothing shifts, as [`TapSet::direct`] makes them.
    pub fn is_direct(&self) -> bool {
        self.taps.len() == self.bases.len() && self.taps.iter().enumerate().all(|(i, t)| (t.base, t.dx, t.dy) == (i, 0, 0))
    }

    /// What K and its adjoint cost, in taps.
    fn cost(&self, interpolation: Interpolation) -> f64 {
        let warps = WARP_COST * (2 * interpolation.support()).pow(2) as f64 * self.bases.len() as f64;
        if self.is_direct() { warps } else { warps + self.taps.len() as f64 }
    }

    /// Every pose a base warp of its own that nothing shifts; poses that no pixel tells apart are one ([`INDISTINGUISHABLE`]).
    pub fn direct(tsf: &Tsf, width: usize, height: usize) -> Self {
        let merged = tsf.merged(width, height, INDISTINGUISHABLE);
        let taps = merged.poses.iter().enumerate().map(|(base, p)| Tap { base, dx: 0, dy: 0, weight: p.weight }).collect();
        Self { bases: merged.poses.iter().map(|p| p.homography(merged.focal_px) * tsf.base).collect(), taps }
    }

    /// Base warps, to the nearest of which each pose's rotation is rounded (by 0.3 px at most, anywhere), and the shifts that are left.
    pub fn shifted(tsf: &Tsf, width: usize, height: usize, interpolation: Interpolation) -> Self {
        Self::shifted_within(tsf, width, height, interpolation, TOLERANCE, NEGLIGIBLE)
    }

    /// [`TapSet::shifted`] with base warps for rotations within `tolerance` pixels, less taps below the part `negligible` of the largest.
    fn shifted_within(tsf: &Tsf, width: usize, height: usize, interpolation: Interpolation, tolerance: f64, negligible: f64) -> Self {
        let flat = tsf.poses.iter().all(|p| p.theta_x_deg == 0.0 && p.theta_y_deg == 0.0);
        let (bases, parts) = if flat { roll_bases(tsf, width, height, tolerance) } else { general_bases(tsf, width, height, tolerance) };
        let mut grid: BTreeMap<(usize, i32, i32), f64> = BTreeMap::new();
        for (base, t, weight) in parts {
            splat(interpolation, t, |dx, dy, w| *grid.entry((base, dy, dx)).or_default() += weight * w);
        }
        let largest = grid.values().fold(0.0f64, |a, w| a.max(w.abs()));
        grid.retain(|_, w| w.abs() > negligible * largest);
        let sum: f64 = grid.values().sum();
        let taps = grid.iter().map(|(&(base, dy, dx), &w)| Tap { base, dx, dy, weight: w / sum }).collect();
        Self { bases, taps }
    }

    /// A sharp frame displaced by `motion`: all of it in one warp, which interpolates once, but for whole pixels, which cost nothing.
    fn still(motion: &DMat3) -> Self {
        let shift = project(motion, DVec2::ZERO).round();
        let tap = Tap { base: 0, dx: shift.x as i32, dy: shift.y as i32, weight: 1.0 };
        Self { bases: vec![DMat3::from_translation(-shift) * *motion], taps: vec![tap] }
    }

    /// The PSF (x, y, weight) that the taps make near the frame's centre, in whole pixels.
    pub fn psf(&self) -> Vec<(f64, f64, f64)> {
        let mut psf: BTreeMap<(i32, i32), f64> = BTreeMap::new();
        for t in &self.taps {
            let at = project(&self.bases[t.base], DVec2::ZERO) + DVec2::new(f64::from(t.dx), f64::from(t.dy));
            *psf.entry((at.x.round() as i32, at.y.round() as i32)).or_default() += t.weight;
        }
        psf.into_iter().map(|((x, y), w)| (f64::from(x), f64::from(y), w)).collect()
    }

    /// Sum of the squared weights of [`TapSet::psf`].
    pub fn energy(&self) -> f64 {
        self.psf().iter().map(|(_, _, w)| w * w).sum()
    }
}

/// Calls `f(dx, dy, weight)` for the integer shifts that make the fractional translation `t`.
pub(super) fn splat(interpolation: Interpolation, t: DVec2, mut f: impl FnMut(i32, i32, f64)) {
    let s = interpolation.support() as i32;
    let (fx, fy) = (t.x.floor(), t.y.floor());
    for j in 1 - s..=s {
        let wy = interpolation.weight(f64::from(j) - (t.y - fy));
        for i in 1 - s..=s {
            let w = wy * interpolation.weight(f64::from(i) - (t.x - fx));
            if w != 0.0 {
                f(fx as i32 + i, fy as i32 + j, w);
            }
        }
    }
}

type Parts = (Vec<DMat3>, Vec<(usize, DVec2, f64)>);

/// Roll angles, as few as leave none of the poses' farther than half the tolerance.
fn roll_bases(tsf: &Tsf, width: usize, height: usize, tolerance: f64) -> Parts {
    let corner = 0.5 * (width as f64).hypot(height as f64);
    let span = (tolerance / corner).to_degrees();
    let mut order: Vec<&Pose> = tsf.poses.iter().collect();
    order.sort_by(|a, b| a.theta_z_deg.total_cmp(&b.theta_z_deg));
    let (mut bases, mut parts) = (Vec::new(), Vec::new());
    let mut rest = order.as_slice();
    while let Some(first) = rest.first() {
        let n = rest.partition_point(|p| p.theta_z_deg <= first.theta_z_deg + span);
        let angle = 0.5 * (first.theta_z_deg + rest[n - 1].theta_z_deg);
        parts.extend(rest[..n].iter().map(|p| (bases.len(), DVec2::new(p.t_x, p.t_y), p.weight)));
        bases.push(Pose::planar(0.0, 0.0, angle, 1.0).rotation(tsf.focal_px) * tsf.base);
        rest = &rest[n..];
    }
    (bases, parts)
}

/// For poses with pitch and yaw: a base for each group of poses whose rotations differ by little more than a translation; for a pose without others one
/// that holds its translation, too.
fn general_bases(tsf: &Tsf, width: usize, height: usize, tolerance: f64) -> Parts {
    let (x, y) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let samples: Vec<DVec2> =
        [-1.0, -0.5, 0.0, 0.5, 1.0].iter().flat_map(|&j| [-1.0, -0.5, 0.0, 0.5, 1.0].map(|i| DVec2::new(i * x, j * y))).collect();
    let mut bases: Vec<DMat3> = Vec::new();
    let mut moved: Vec<Vec<DVec2>> = Vec::new();
    let mut parts = Vec::new();
    for p in &tsf.poses {
        let h = p.rotation(tsf.focal_px);
        let to: Vec<DVec2> = samples.iter().map(|&s| project(&h, s)).collect();
        // Distance to a base: the worst pixel's displacement once the mean displacement is counted as translation.
        let distance = |from: &[DVec2]| {
            let mean = to.iter().zip(from).map(|(a, b)| *a - *b).sum::<DVec2>() / to.len() as f64;
            let worst = to.iter().zip(from).map(|(a, b)| (*a - *b - mean).length()).fold(0.0, f64::max);
            (worst, mean)
        };
        let near = moved.iter().enumerate().map(|(i, m)| (i, distance(m))).min_by(|a, b| a.1.0.total_cmp(&b.1.0));
        let (base, shift) = match near {
            Some((i, (worst, mean))) if worst < 0.5 * tolerance => (i, mean),
            _ => {
                bases.push(h);
                moved.push(to);
                (bases.len() - 1, DVec2::ZERO)
            }
        };
        parts.push((base, DVec2::new(p.t_x, p.t_y) + shift, p.weight));
    }
    // Where a base serves one pose it is that pose: nothing is left to be shifted, and one interpolation does.
    let mut poses = vec![0; bases.len()];
    parts.iter().for_each(|(base, ..)| poses[*base] += 1);
    for (base, shift, _) in parts.iter_mut().filter(|(base, ..)| poses[*base] == 1) {
        bases[*base] = DMat3::from_translation(*shift) * bases[*base];
        *shift = DVec2::ZERO;
    }
    (bases.into_iter().map(|h| h * tsf.base).collect(), parts)
}
