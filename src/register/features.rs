//! Alignment by features: SIFT on the logarithmic pictures, RANSAC, and the simplest kind of motion that explains the matches.

use super::motion::{Model, fields, normalised};
use super::picture::Tone;
use crate::pose::project;
use glam::{DMat3, DVec2};
use lowe_sift::{GrayImage, Sift, SiftConfig, match_features};
use nalgebra::{DMatrix, DVector};
use rand::Rng;

/// A match: a point of the reference and one of the frame, centred pixels of their pictures.
pub type Pair = (DVec2, DVec2);

/// Features at most, of each picture: the strongest.
const FEATURES: usize = 600;
/// Ratio of the distances to the nearest and the second-nearest descriptor up to which a match counts.
const RATIO: f32 = 0.8;
/// Distance in pixels within which a match agrees with a motion.
const INLIER: f64 = 2.0;
/// Samples of RANSAC: at a fifth of good matches, 2 pairs are both good in one sample of 25.
const SAMPLES: usize = 600;
/// Largest roll in degrees that a hand makes between two frames.
const LARGEST_ROLL: f64 = 12.0;

/// Matches of two pictures.
pub(super) fn matches(reference: &Tone, frame: &Tone) -> Vec<Pair> {
    let (a, b) = rayon::join(|| detect(reference), || detect(frame));
    let (w, h) = reference.size();
    let centre = DVec2::new(0.5 * (w as f64 - 1.0), 0.5 * (h as f64 - 1.0));
    let place = |f: &lowe_sift::Feature| DVec2::new(f64::from(f.keypoint.x), f64::from(f.keypoint.y)) - centre;
    match_features(&a, &b, RATIO)
        .iter()
        .map(|m| (&a[m.query_index], &b[m.train_index]))
        // Neither zoom nor roll changes between the frames of a bracket, so neither do a feature's scale and angle, much.
        .filter(|(p, q)| (0.7..1.4).contains(&(p.keypoint.scale / q.keypoint.scale)))
        .map(|(p, q)| (place(p), place(q)))
        .collect()
}

fn detect(tone: &Tone) -> Vec<lowe_sift::Feature> {
    let (w, h) = tone.size();
    // Where a picture is clipped it has no structure of its own; its edge must not make features.
    let (low, high) = tone.value.data.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &v| (a.min(v), b.max(v)));
    // SIFT expects values of 0 to 1; its contrast threshold then is 0.03 of six units of the logarithm.
    let range = (high - low).clamp(1e-3, 6.0);
    let data = tone.value.data.iter().map(|v| (v - low) / range).collect();
    let Ok(image) = GrayImage::new(w, h, data) else { return Vec::new() };
    let config = SiftConfig { double_image: false, contrast_threshold: 0.01, ..SiftConfig::default() };
    let mut found = Sift::new(config).map(|s| s.detect_and_compute(&image)).unwrap_or_default();
    found.retain(|f| {
        let (x, y) = (f.keypoint.x as isize, f.keypoint.y as isize);
        let r = (2.0 * f.keypoint.scale) as isize;
        [(0, 0), (r, 0), (-r, 0), (0, r), (0, -r)].iter().all(|(i, j)| tone.valid.clamped(x + i, y + j) > 0.0)
    });
    found.sort_by(|a, b| b.keypoint.response.total_cmp(&a.keypoint.response));
    found.truncate(FEATURES);
    found
}

/// What the matches say.
pub struct Consensus {
    /// Kind of motion.
    pub model: Model,
    /// Frame from reference.
    pub motion: DMat3,
    /// Matches that agree with it.
    pub inliers: usize,
}

/// The motion that most matches agree with, of the simplest kind up to `most` that explains them; `None` when no motion is better than
/// chance. `scale`: distance of the corner from the centre.
pub fn consensus(pairs: &[Pair], scale: f64, most: Model) -> Option<Consensus> {
    if pairs.len() < 4 {
        return None;
    }
    // A fixed seed: the same frames give the same result.
    let mut random = rand_pcg::Pcg64Mcg::new(0x5eed);
    let mut best: Option<(f64, DMat3)> = None;
    for _ in 0..SAMPLES {
        let mut draw = || (random.next_u64() % pairs.len() as u64) as usize;
        let (i, j) = (draw(), draw());
        let Some(motion) = through(pairs[i], pairs[j]) else { continue };
        let cost: f64 = pairs.iter().map(|p| error(&motion, p).min(INLIER * INLIER)).sum();
        if best.as_ref().is_none_or(|b| cost < b.0) {
            best = Some((cost, motion));
        }
    }
    let (_, rough) = best?;
    // Wider at first: a rigid motion through two matches is a few pixels off at the far end, and further where pitch and yaw have a part.
    let near: Vec<Pair> = pairs.iter().filter(|p| error(&rough, p) < (4.0 * INLIER).powi(2)).copied().collect();
    let n = near.len() as f64;
    let mut chosen: Option<(f64, Model, DMat3)> = None;
    let mut from = rough;
    for model in Model::ALL.into_iter().filter(|m| *m <= most) {
        let start = match model {
            Model::Identity => DMat3::IDENTITY,
            Model::Translation => DMat3::from_translation(project(&rough, DVec2::ZERO)),
            Model::Rigid => rough,
            _ => from,
        };
        if 2 * near.len() < model.freedom() + 4 {
            break;
        }
        let motion = fit(&near, &start, model, scale);
        from = motion;
        // Features are placed to about half a pixel; mistaken ones cost the same whatever the motion.
        let cost: f64 = near.iter().map(|p| (error(&motion, p) / 0.25).min(25.0)).sum();
        let criterion = cost + model.freedom() as f64 * (2.0 * n).ln();
        if chosen.as_ref().is_none_or(|c| criterion < c.0) {
            chosen = Some((criterion, model, motion));
        }
    }
    let (_, model, motion) = chosen?;
    let inliers = pairs.iter().filter(|p| error(&motion, p) < INLIER * INLIER).count();
    Some(Consensus { model, motion, inliers })
}

/// Squared distance in pixels.
fn error(motion: &DMat3, pair: &Pair) -> f64 {
    (project(motion, pair.0) - pair.1).length_squared()
}

/// The rigid motion through two matches; `None` where they are no rigid motion, or one that no hand makes.
fn through(a: Pair, b: Pair) -> Option<DMat3> {
    let (p, q) = (b.0 - a.0, b.1 - a.1);
    if p.length() < 20.0 || (p.length() - q.length()).abs() > 3.0 + 0.01 * p.length() {
        return None;
    }
    let angle = p.angle_to(q);
    if angle.to_degrees().abs() > LARGEST_ROLL {
        return None;
    }
    let turn = DMat3::from_angle(angle);
    let shift = 0.5 * (a.1 + b.1) - project(&turn, 0.5 * (a.0 + b.0));
    Some(DMat3::from_translation(shift) * turn)
}

/// Robust least squares over `pairs` from `start`.
fn fit(pairs: &[Pair], start: &DMat3, model: Model, scale: f64) -> DMat3 {
    let k = model.freedom();
    let mut motion = *start;
    if k == 0 {
        return motion;
    }
    for _ in 0..8 {
        let mut a = DMatrix::<f64>::identity(k, k) * 1e-6;
        let mut b = DVector::<f64>::zeros(k);
        for (p, q) in pairs {
            let r = *q - project(&motion, *p);
            let weight = 1.0 / (1.0 + r.length_squared());
            // Near the identity the motion hardly changes a small displacement.
            let f = fields(*p, scale);
            for i in 0..k {
                b[i] += weight * f[i].dot(r);
                for j in 0..k {
                    a[(i, j)] += weight * f[i].dot(f[j]);
                }
            }
        }
        let Some(cholesky) = a.cholesky() else { break };
        let step = cholesky.solve(&b);
        motion = normalised(motion * model.step(step.as_slice(), scale));
        if step.amax() < 1e-6 {
            break;
        }
    }
    motion
}
