//! Which frames are sharp: fine structure of each frame, noise taken off, against that of the others.

use crate::exposure::Frame;
use crate::image::{Plane, Rgb};
use crate::mask;
use crate::noise::NoiseModel;
use crate::pose::nearest_pixel;
use glam::DMat3;
use serde::Serialize;

/// What the triage found about one frame.
#[derive(Clone, Debug, Serialize)]
pub struct Verdict {
    /// Whether the frame counts as sharp.
    pub sharp: bool,
    /// Energy of one-pixel differences over that of the frame with most of it, relative to the same ratio of coarse differences, worst
    /// direction, on pixels that both see: 1 for equally sharp frames.
    pub detail: f64,
    /// Energy of one-pixel over that of two-pixel differences, worst direction: about 0.5 where edges are one pixel wide, 0.25 where
    /// they are ramps.
    pub steepness: f64,
    /// Why, in words.
    pub reason: String,
}

/// Below this share of another frame's fine structure a frame is blurred: a blur of 2 px halves the energy of one-pixel differences
/// across its direction. Sharp frames measure 0.73 and more, shaken ones 0.02 to 0.56.
const DETAIL: f64 = 0.6;
/// Below this no edge is steep: even the best frame is blurred.
const STEEPNESS: f64 = 0.335;
/// Relative error of the noise level that is taken off the energies.
const NOISE_ERROR: f64 = 0.2;
/// Lag in pixels of the differences that tell contrast.
const COARSE: usize = 24;
/// Directions in which differences are taken.
const DIRECTIONS: [(usize, usize, bool); 4] = [(1, 0, false), (0, 1, false), (1, 1, false), (1, 1, true)];

struct Luminance {
    value: Plane,    // irradiance
    variance: Plane, // of it
    valid: Vec<bool>,
}

fn luminance(frame: &Frame, x: &Rgb, noise: &NoiseModel) -> Luminance {
    let clipped = mask::clipped(frame);
    let dt = frame.exposure_time;
    let mean = x.mean();
    // Below three standard deviations, noise clipped at black is no longer symmetric.
    let floor = 3.0 * noise.read.sqrt();
    let valid = mean.data.iter().zip(&clipped).map(|(&v, &c)| !c && f64::from(v) > floor).collect();
    let variance = mean.map(|v| (noise.variance(f64::from(v)) / 3.0 / (dt * dt)) as f32);
    Luminance { value: mean.map(|v| (f64::from(v) / dt) as f32), variance, valid }
}

impl Luminance {
    /// As pixels of another frame see it, `motion` being the way from there to here: the nearest pixel, since interpolation would take
    /// fine structure away.
    fn seen(&self, motion: &DMat3) -> Self {
        let (w, h) = self.value.size();
        let mut out = Self { value: self.value.clone(), variance: self.variance.clone(), valid: vec![false; w * h] };
        for p in 0..w * h {
            if let Some(q) = nearest_pixel(motion, w, h, p % w, p / w) {
                out.value.data[p] = self.value.data[q];
                out.variance.data[p] = self.variance.data[q];
                out.valid[p] = self.valid[q];
            }
        }
        out
    }
}

/// Noise-free energy and its uncertainty (two standard deviations, and the noise level's own error), of differences over `lag` pixels in `direction`, of `a`, on pixels that are valid in `a` and `b`;
/// weighted by the larger variance of the two, so that both sums of a pair speak of the same pixels in the same way.
fn energy(a: &Luminance, b: &Luminance, direction: (usize, usize, bool), lag: usize) -> (f64, f64) {
    let (w, h) = a.value.size();
    let (dx, dy) = (direction.0 * lag, direction.1 * lag);
    let (mut sum, mut scatter, mut noise) = (0.0, 0.0, 0.0);
    for y in 0..h.saturating_sub(dy) {
        for x in 0..w.saturating_sub(dx) {
            let (i, j) = if direction.2 { (y * w + x + dx, (y + dy) * w + x) } else { (y * w + x, (y + dy) * w + x + dx) };
            if !(a.valid[i] && a.valid[j] && b.valid[i] && b.valid[j]) {
                continue;
            }
            let own = f64::from(a.variance.data[i] + a.variance.data[j]);
            let weight = 1.0 / own.max(f64::from(b.variance.data[i] + b.variance.data[j]));
            let d = f64::from(a.value.data[i] - a.value.data[j]);
            sum += weight * (d * d - own);
            noise += weight * own;
            // Variance of a squared difference of noise sigma^2: 2 sigma^4 + 4 d^2 sigma^2.
            scatter += weight * weight * (2.0 * own * own + 4.0 * (d * d - own).max(0.0) * own);
        }
    }
    (sum, 2.0 * scatter.sqrt() + NOISE_ERROR * noise)
}

/// Sorts the frames. `given` (from the user) overrides; the numbers are reported all the same. `motions`: each frame's place, from the
/// reference, centred pixels.
pub fn triage(
    frames: &[Frame],
    exposures: &[Rgb],
    noise: &NoiseModel,
    excluded: &[bool],
    given: Option<&[usize]>,
    motions: &[DMat3],
) -> Vec<Verdict> {
    let all: Vec<Luminance> = frames.iter().zip(exposures).map(|(f, x)| luminance(f, x, noise)).collect();
    let used: Vec<usize> = (0..frames.len()).filter(|&i| !excluded[i]).collect();
    let mut verdicts: Vec<Verdict> = (0..frames.len())
        .map(|i| {
            let mut detail = 1.0f64;
            for &j in used.iter().filter(|&&j| j != i) {
                // Each of the two on its own pixels, of which those count that the other sees as well.
                let apart = motions[i] != motions[j];
                let from_i = apart.then(|| all[j].seen(&(motions[j] * motions[i].inverse())));
                let from_j = apart.then(|| all[i].seen(&(motions[i] * motions[j].inverse())));
                let (a, b) = (from_i.as_ref().unwrap_or(&all[j]), from_j.as_ref().unwrap_or(&all[i]));
                for direction in DIRECTIONS {
                    let ((own, own_error), (other, error)) = (energy(&all[i], a, direction, 1), energy(&all[j], b, direction, 1));
                    let (coarse, coarse_other) = (energy(&all[i], a, direction, COARSE).0, energy(&all[j], b, direction, COARSE).0);
                    // A response or exposure time that is not quite true changes structure of all sizes alike; blur takes the finest.
                    let contrast = if coarse > 0.0 && coarse_other > 0.0 { (coarse / coarse_other).min(1.0) } else { 1.0 };
                    // Only where the other frame's fine structure stands clear of its noise, and of this frame's.
                    if other > 3.0 * error && other > 3.0 * own_error {
                        detail = detail.min((own + own_error).max(0.0) / (other * contrast));
                    }
                }
            }
            let steep = DIRECTIONS.iter().filter_map(|&d| {
                let ((one, _), (two, error)) = (energy(&all[i], &all[i], d, 1), energy(&all[i], &all[i], d, 2));
                (two > 3.0 * error).then(|| one.max(0.0) / two)
            });
            let steepness = steep.fold(f64::INFINITY, f64::min);
            let steepness = if steepness.is_finite() { steepness } else { 0.5 };
            Verdict { sharp: false, detail, steepness, reason: String::new() }
        })
        .collect();
    for (i, v) in verdicts.iter_mut().enumerate() {
        if let Some(list) = given {
            v.sharp = list.contains(&i);
            v.reason = if v.sharp { "sharp by option" } else { "blurred by option" }.into();
        } else if excluded[i] {
            v.reason = "left out".into();
        } else if v.detail < DETAIL {
            v.reason = format!("has {:.0} % of another frame's fine structure", 100.0 * v.detail);
        } else if v.steepness < STEEPNESS {
            v.reason = format!("no steep edge in one direction (steepness {:.2})", v.steepness);
        } else {
            v.sharp = true;
            v.reason = format!("fine structure {:.0} % of the best frame's, steepness {:.2}", 100.0 * v.detail, v.steepness);
        }
    }
    verdicts
}
