//! Gain and black offset of each frame and channel: what the pixels say of exposure, white balance and black level.
//!
//! Frame i shows x_ic(p) = g_ic Δt_i E_c(p) + o_ic, where g is 1 and o is 0 if file and camera agree. Both are found on means of squares of registered frames, which
//! blur and small errors of registration hardly change where the neighbouring squares are as bright. E is the weighted mean of all frames under
//! the present g and o; each frame is then regressed on it, in turn, robustly and with priors: ln g of a channel is 0 ± [`GAIN`], with the heavy tail of a
//! file that notes something else; o is one [`OFFSET`] for all frames and channels of a camera, and each one's differs from that by [`OWN_OFFSET`].
//! What all frames have in common cannot be seen: on average over the light that they hold, g is 1.

use crate::exposure::Frame;
use crate::image::Rgb;
use crate::mask::CLIPPED;
use crate::noise::FrameNoise;
use crate::pose::project;
use crate::robust::precision;
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use serde::Serialize;

/// Standard deviation of ln g: a tenth of an EV of white balance and as much of the shutter.
const GAIN: f64 = 0.1;
/// Standard deviation of the offset that all frames and channels share, and of what one frame and channel adds to it; parts of white. Random brackets have 0 to 3e-3, for which 1.5e-3 and 5e-4 err
/// less (MEASUREMENTS, *Photometry beside the truth*); a phone's frames of ISO 3200 and 100 have more, and came out tinted with these.
const OFFSET: f64 = 4e-3;
const OWN_OFFSET: f64 = 1e-3;
/// Relative error of a square's mean that noise does not explain: curve, engine, flare.
const MODEL: f64 = 0.03;
/// Standard deviation of all squares of like brightness together, as the same curve and engine are behind them: so many squares at most count as independent.
const INDEPENDENT: f64 = 60.0;
/// Part of the difference to the neighbouring squares that blur and displacement move into one.
const MOVED: f64 = 0.3;
/// The longer side holds so many squares, and a square has at least so many pixels a side. A shaken frame shows less contrast between small squares than a sharp one, which regression takes for a
/// gain above 1 and an offset below 0.
const SQUARES: usize = 30;
const LEAST_SIDE: usize = 5;
/// A square of which more than this part is cut off at black hides its mean.
const BLACK: f64 = 0.02;
/// Rounds of E, gains and offsets in turn.
const ROUNDS: usize = 25;

/// What was found about one frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct FramePhotometry {
    /// g of red, green and blue.
    pub gain: [f64; 3],
    /// o of red, green and blue, parts of white.
    pub offset: [f64; 3],
    /// Squares of each channel that another frame shows as well.
    pub squares: [usize; 3],
}

impl FramePhotometry {
    /// A frame that is as its file says.
    pub const AS_NOTED: Self = Self { gain: [1.0; 3], offset: [0.0; 3], squares: [0; 3] };

    /// Exposures as they would be if gain and offset were 1 and 0.
    pub fn corrected(&self, exposure: &Rgb) -> Rgb {
        Rgb(std::array::from_fn(|c| {
            let (gain, offset) = (self.gain[c] as f32, self.offset[c] as f32);
            exposure.0[c].map(|x| ((x - offset) / gain).max(BELOW_BLACK))
        }))
    }

    /// Factors of the exposures' scale.
    pub fn factors(&self) -> [f64; 3] {
        self.gain.map(|g| 1.0 / g)
    }
}

/// Least exposure after an offset is taken off: what the solver takes for an unseen channel is far below.
const BELOW_BLACK: f32 = -0.05;

/// Mean of a square of one channel, its uncertainty beside [`MODEL`], and whether it is there.
#[derive(Clone, Copy)]
struct Square {
    mean: f64,
    deviation: f64,
}

/// Gains and offsets of the frames `ids`, which lie at `motions` from the reference (centred pixels); all others as noted.
pub fn photometry(frames: &[Frame], exposures: &[Rgb], noise: &[FrameNoise], ids: &[usize], motions: &[DMat3]) -> Vec<FramePhotometry> {
    let mut found = vec![FramePhotometry::AS_NOTED; frames.len()];
    if ids.len() < 2 {
        return found;
    }
    let times: Vec<f64> = ids.iter().map(|&i| frames[i].exposure_time).collect();
    let of = |c: usize| Channel::new(ids.iter().map(|&i| squares(&frames[i], &exposures[i], &noise[i], c, &motions[i])).collect());
    let mut channels: Vec<Channel> = (0..3).into_par_iter().map(of).collect();
    for _ in 0..ROUNDS {
        let sum: f64 = channels.iter().flat_map(|c| &c.offsets).sum();
        let common = sum / ((3 * ids.len()) as f64 + (OWN_OFFSET / OFFSET).powi(2));
        channels.par_iter_mut().for_each(|c| c.improve(&times, common));
    }
    for (c, channel) in channels.iter().enumerate() {
        for (k, &i) in ids.iter().enumerate() {
            (found[i].gain[c], found[i].offset[c], found[i].squares[c]) = (channel.gains[k], channel.offsets[k], channel.counts[k]);
        }
    }
    found
}

/// Side of the squares of frames of `size`.
fn side(size: (usize, usize)) -> usize {
    (size.0.max(size.1) / SQUARES).max(LEAST_SIDE)
}

/// The squares of the reference's grid as a frame at `motion` shows channel `c` of them.
fn squares(frame: &Frame, exposure: &Rgb, noise: &FrameNoise, c: usize, motion: &DMat3) -> Vec<Option<Square>> {
    let (w, h) = frame.intensity.size();
    let side = side((w, h));
    let (columns, rows) = (w / side, h / side);
    let centre = 0.5 * DVec2::new(w as f64 - 1.0, h as f64 - 1.0);
    let stride = side.div_ceil(16);
    let cut_off = frame.black(c);
    let mean = |k: usize| -> Option<f64> {
        let middle = DVec2::new((k % columns * side) as f64, (k / columns * side) as f64) + 0.5 * (side as f64 - 1.0);
        let at = (project(motion, middle - centre) + centre - 0.5 * (side as f64 - 1.0)).round();
        if at.x < 0.0 || at.y < 0.0 || at.x as usize + side > w || at.y as usize + side > h {
            return None;
        }
        let (x, y) = (at.x as usize, at.y as usize);
        let (mut sum, mut black, mut n) = (0.0, 0usize, 0usize);
        for j in (y..y + side).step_by(stride) {
            for i in (x..x + side).step_by(stride) {
                if frame.intensity.0.iter().any(|p| p.at(i, j) >= CLIPPED) {
                    return None;
                }
                sum += f64::from(exposure.0[c].at(i, j));
                black += usize::from(frame.intensity.0[c].at(i, j) <= cut_off);
                n += 1;
            }
        }
        (black as f64 <= BLACK * n as f64).then(|| sum / n as f64)
    };
    let means: Vec<Option<f64>> = (0..columns * rows).map(mean).collect();
    let per_side = side.div_ceil(stride);
    let averaged = (per_side * per_side) as f64;
    (0..means.len())
        .map(|k| {
            let own = means[k]?;
            let (x, y) = (k % columns, k / columns);
            let mut step = 0.0f64;
            for j in y.saturating_sub(1)..=(y + 1).min(rows - 1) {
                for i in x.saturating_sub(1)..=(x + 1).min(columns - 1) {
                    // What is clipped next door may have been smeared in here.
                    step = step.max((means[j * columns + i]? - own).abs());
                }
            }
            let noise = &noise.channels[c];
            let variance = noise.variance(own) / averaged + noise.clipping_bias(own).powi(2) + (MOVED * step).powi(2);
            Some(Square { mean: own, deviation: variance.sqrt() })
        })
        .collect()
}

/// What is known of one channel of all frames.
struct Channel {
    /// Of each frame.
    squares: Vec<Vec<Option<Square>>>,
    /// Those that two frames show.
    shared: Vec<usize>,
    /// Of each frame, how many of these it shows.
    counts: Vec<usize>,
    gains: Vec<f64>,
    offsets: Vec<f64>,
}

impl Channel {
    fn new(squares: Vec<Vec<Option<Square>>>) -> Self {
        let (n, count) = (squares.len(), squares[0].len());
        let shared: Vec<usize> = (0..count).filter(|&p| squares.iter().filter(|s| s[p].is_some()).count() >= 2).collect();
        let counts = squares.iter().map(|s| shared.iter().filter(|&&p| s[p].is_some()).count()).collect();
        Self { squares, shared, counts, gains: vec![1.0; n], offsets: vec![0.0; n] }
    }

    /// Radiance of each shared square under the present gains and offsets.
    fn radiance(&self, times: &[f64]) -> Vec<f64> {
        let of = |&p: &usize| {
            let (mut sum, mut total) = (0.0, 0.0);
            for (k, s) in self.squares.iter().enumerate() {
                if let Some(s) = s[p] {
                    let scale = self.gains[k] * times[k];
                    let weight = (scale * scale) / (s.deviation.powi(2) + (MODEL * s.mean).powi(2) + OWN_OFFSET * OWN_OFFSET);
                    sum += weight * (s.mean - self.offsets[k]) / scale;
                    total += weight;
                }
            }
            (sum / total).max(0.0)
        };
        self.shared.iter().map(of).collect()
    }

    /// Gain and offset of each frame, the radiances being what they are now; `common`: the offset of all frames and channels.
    fn improve(&mut self, times: &[f64], common: f64) {
        let radiance = self.radiance(times);
        for (k, time) in times.iter().enumerate() {
            // Unknown: ln g and o, linearised at the present values.
            let (mut a, mut b) = ([[0.0f64; 2]; 2], [0.0f64; 2]);
            let tempered = (INDEPENDENT / self.counts[k].max(1) as f64).min(1.0);
            for (&p, e) in self.shared.iter().zip(&radiance) {
                let Some(s) = self.squares[k][p] else { continue };
                let expected = self.gains[k] * time * e;
                let r = s.mean - expected - self.offsets[k];
                let w = tempered * precision(r, s.deviation.hypot(MODEL * expected.max(s.mean)));
                let row = [expected, 1.0];
                for i in 0..2 {
                    for j in 0..2 {
                        a[i][j] += w * row[i] * row[j];
                    }
                    b[i] += w * row[i] * r;
                }
            }
            let log = self.gains[k].ln();
            let prior = precision(log, GAIN);
            a[0][0] += prior;
            b[0] -= prior * log;
            let own = self.offsets[k] - common;
            let prior = OWN_OFFSET.powi(-2);
            a[1][1] += prior;
            b[1] -= prior * own;
            let det = a[0][0] * a[1][1] - a[0][1] * a[1][0];
            let step = (a[1][1] * b[0] - a[0][1] * b[1]) / det;
            self.gains[k] *= step.clamp(-0.7, 0.7).exp();
            self.offsets[k] = (self.offsets[k] + (a[0][0] * b[1] - a[1][0] * b[0]) / det).clamp(-3.0 * OFFSET, 3.0 * OFFSET);
        }
        // The light that a frame holds: white and channel balance are those of the frames that hold most of it.
        let light = |k: usize| self.squares[k].iter().flatten().map(|s| s.mean).sum::<f64>();
        let total: f64 = (0..times.len()).map(light).sum();
        let mean = (0..times.len()).map(|k| light(k) / total.max(f64::MIN_POSITIVE) * self.gains[k].ln()).sum::<f64>();
        self.gains.iter_mut().for_each(|g| *g *= (-mean).exp());
    }
}
