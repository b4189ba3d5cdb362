//! The joint estimate: luminance and TSFs in turn, from coarse to fine.

use super::lens::behind_lens;
use super::luminance::{self, Effort, Frame, chi_squared, operators};
use super::operator::Operator;
use crate::image::Plane;
use crate::mask;
use crate::merge::gradient_level;
use crate::pose::{Pose, PoseGrid};
use crate::random::Random;
use crate::sampling::bilinear;
use crate::tsf::{self, Latent, Stride, Tsf, WholeFrame};
use glam::{DMat3, DVec2};
use rayon::prelude::*;
use serde::Serialize;
use std::borrow::Cow;
use std::cell::Cell;

/// Where the estimate is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stage {
    /// Pixels of the frame per pixel of the level that is worked on, per axis.
    pub scale: usize,
    /// Part of the whole that is done, 0..=1.
    pub fraction: f32,
}

/// What was found.
pub struct Joint {
    /// One TSF per frame; the mean pose of the reference frame is the identity.
    pub tsfs: Vec<Tsf>,
    /// Latent luminance (irradiance) on the frame's grid.
    pub luminance: Plane,
    /// Pixels of the frame per pixel of the finest level that was worked on, per axis.
    pub scale: usize,
    /// Frame whose mean pose is the identity.
    pub reference: usize,
    /// Mean squared residual over noise variance of each frame on pixels that no part of the estimate has seen.
    pub held_out: Vec<f64>,
    /// The same for a scene solved from the frames as they are placed, unblurred: what a merge explains.
    pub held_out_merge: Vec<f64>,
    /// Standard deviation in pixels of the blur that all frames share and that is not motion: the lens's; 0 where none was found.
    pub lens_px: f32,
    /// What TSFs were fitted to at the second level, or on the one that there is, the least residual first; none where frames in doubt stood still.
    pub ways: Vec<Way>,
}

impl Joint {
    /// Whether it explains pixels that no part of it has seen so much better than what is known without it, in the mean and of the frame `first` by itself, that it is believed.
    pub fn is_believed(&self, first: Option<usize>) -> bool {
        explains_better(&self.held_out, &self.held_out_merge, first, EXPLAINED)
    }
}

/// Whether the squared residuals `of` are below `part` of those `than` in the geometric mean, and of the frame `first` by itself.
fn explains_better(of: &[f64], than: &[f64], first: Option<usize>, part: f64) -> bool {
    geometric_mean(of) < part * geometric_mean(than) && first.is_none_or(|k| of[k] < part * than[k])
}

/// What is known without a joint estimate.
pub struct Known<'a> {
    /// Irradiance: a merge, unblurred, or what frames that were taken for stationary show.
    pub scene: &'a Plane,
    /// Where each frame lies, and its blur if one is known.
    pub tsfs: &'a [Tsf],
    /// The first frame that was taken for stationary, which itself has to be explained better.
    pub first: Option<usize>,
}

/// What TSFs are fitted to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FittedTo {
    /// The best scene under the TSFs so far.
    Best,
    /// A scene drawn around it.
    Drawn,
    /// Pixels that the scene was not solved from.
    Unseen,
}

/// A way to the TSFs of the second level, and how it did there.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Way {
    /// What they were fitted to at the end.
    pub fitted_to: FittedTo,
    /// Geometric mean over the frames of the squared residual over noise variance on pixels that no part of the estimate has seen.
    pub held_out: f64,
}

/// A way to begin.
pub struct Start {
    /// Frame whose TSF is the identity at the start, and whose mean pose is the identity at the end.
    pub reference: usize,
    /// Irradiance at the start.
    pub luminance: Plane,
}

/// Side in pixels down to which the coarsest level shrinks the frame's longer side: there a blur is a few pixels long. Coarser, the blur of
/// the shortest frame is less than a pixel and cannot be told.
const COARSEST: usize = 250;
/// Rounds of luminance and TSFs at the coarsest level, at the next, and at finer ones, where little is left to be found and a round is dear.
const ROUNDS: (usize, usize, usize) = (12, 5, 2);
/// Parts of the pixels that are held out in turn where TSFs are cross-validated.
const FOLDS: usize = 5;
/// Steps of that at the second level, and beside sharp frames; iterations of the solves of each.
const STEPS: (usize, usize) = (30, 15);
const SOLVED: usize = 15;
/// Steps after which pixels that none of them sees are asked.
const CHECKED: usize = 5;
/// Growth of the residuals of a frame beside sharp ones from which the steps are not believed.
const WORSE: f64 = 1.1;
/// Part of the mean over the last steps that an older one keeps: each sees a part of the pixels alone.
const OLDER: f64 = 0.8;
/// Growth of the residuals of a part from which the last step was too long: since it was last held out, and the first time, over the least of the others.
const ROSE: f64 = 1.1;
const FIRST_ROSE: f64 = 1.5;
/// Pixels above which a level is not worked on: what is found at the finest below serves the frame.
const LARGEST: usize = 500_000;
/// Rounds with drawn scenes at the coarsest level and at the next.
const DRAWN_ROUNDS: (usize, usize) = (5, 5);
/// Residuals of TSFs fitted to drawn scenes, over those of TSFs fitted to the best one, below which they are gone on with: too long a blur costs more than
/// one that is too short.
const CLEARLY: f64 = 0.95;
/// Rounds of luminance and TSFs at the coarsest level before smoothness falls.
const SEARCH: usize = 4;
/// λ at the end; at the coarsest level it starts six times higher, at finer ones twice.
const LAMBDA: f32 = 3.0;
/// Smoothness at the start of the coarsest level and of a finer one, in units of λ.
const SMOOTHNESS: (f32, f32) = (4.0, 2.0);
/// Error of the operators at the first and last round of a level, as a part of the mean absolute gradient around a pixel.
const MODEL_ERROR: (f32, f32) = (0.1, 0.04);
/// The largest translation of the pose grid is the frame's longer side over this.
const SEARCHED: usize = 20;
/// Largest roll of the pose grid, degrees.
const DEGREES: f64 = 2.0;
/// Poses of a weight below this part of the largest are dropped.
const FAINT: f64 = 0.02;
/// Iterations for a scene that TSFs are fitted to, drawn around the best one, and its deviation in units of what the data leave open: so few
/// iterations do not reach all of that, and a normal distribution does not hold it.
const DRAWN: (usize, f32) = (15, 1.5);
/// Iterations by which the TSFs of a round are refined, at the coarsest level and at finer ones. More at the coarsest follow what the luminance of that
/// round still lacks, and are lost on it: with eight the estimate takes twice as long and ends no better.
const REFINED: (usize, usize) = (4, 8);
/// Standard deviations of the lens's blur that are tried at the second level, in pixels of it, and the residuals over those behind the sharper one below which
/// a softer one is gone on with.
const LENSES: [f32; 3] = [0.7, 1.0, 1.4];
const SHARPER: f64 = 0.9;
/// Seed of the draws.
const SEED: u64 = 2013;
/// One pixel of so many is held out.
const HELD: usize = 29;

/// `frame` at 1/`scale` (a power of two) of its size, masked where any pixel that is seen is.
pub fn shrink(frame: &Frame, scale: usize) -> Frame {
    if scale == 1 {
        return frame.clone();
    }
    // White noise falls by the sum of the filter's squared weights.
    let kept = (20.0f32 / 64.0).powi(2);
    let masked = frame.mask.map(|m| if m > 0.0 { 0.0 } else { 1.0 });
    let lost = masked.halved();
    let (w, h) = lost.size();
    let least = |x: usize, y: usize| (0..4).map(|k| frame.mask.at(2 * x + k % 2, 2 * y + k / 2)).fold(1.0, f32::min);
    let half = Frame {
        blurred: frame.blurred.halved(),
        variance: frame.variance.halved().map(|v| v * kept),
        mask: Plane::from_fn(w, h, |x, y| if lost.at(x, y) > 0.0 { 0.0 } else { least(x, y) }),
        clipped: (0..w * h).map(|p| (0..4).all(|k| frame.clipped[(p / w * 2 + k / 2) * frame.blurred.width + p % w * 2 + k % 2])).collect(),
    };
    shrink(&half, scale / 2)
}

/// `plane` at 1/`scale` (a power of two) of its size.
fn shrunk(plane: &Plane, scale: usize) -> Plane {
    if scale == 1 { plane.clone() } else { shrunk(&plane.halved(), scale / 2) }
}

/// Poses of a level `ratio` times coarser on the finer one, each spread over the pixels that its own pixel covers: over none but itself where both are one.
fn spread(tsf: &Tsf, ratio: f64) -> Tsf {
    if ratio == 1.0 {
        return tsf.clone();
    }
    let d = 0.25 * ratio;
    let corners = [(-d, -d), (d, -d), (-d, d), (d, d)];
    let finer = |p: &Pose, (x, y): (f64, f64)| Pose { t_x: p.t_x * ratio + x, t_y: p.t_y * ratio + y, weight: 0.25 * p.weight, ..*p };
    Tsf { focal_px: tsf.focal_px * ratio, poses: tsf.poses.iter().flat_map(|p| corners.map(|c| finer(p, c))).collect(), base: tsf.base }
}

/// The poses of at least [`FAINT`] times the largest weight.
fn without_faint(tsf: &Tsf) -> Option<Tsf> {
    let most = tsf.poses.iter().map(|p| p.weight).fold(0.0, f64::max);
    Tsf::new(tsf.focal_px, tsf.poses.iter().copied().filter(|p| p.weight >= FAINT * most).collect()).ok().map(|t| t.about(tsf.base))
}

/// Γ ∘ M⁻¹ for all poses, M the mean pose of the frame `reference`: the TSFs of the scene warped by M, which is returned. Roll and
/// translation only, for TSFs about the identity; the base of another takes M⁻¹.
pub fn fix_warp(tsfs: &mut [Tsf], reference: usize) -> Pose {
    let m = tsfs[reference].mean();
    let back = m.homography(tsfs[reference].focal_px).inverse();
    let (displaced, in_place): (Vec<&mut Tsf>, Vec<&mut Tsf>) = tsfs.iter_mut().partition(|t| t.base != DMat3::IDENTITY);
    for tsf in displaced {
        tsf.base *= back;
    }
    for p in in_place.into_iter().flat_map(|t| &mut t.poses) {
        let theta = p.theta_z_deg - m.theta_z_deg;
        let (s, c) = theta.to_radians().sin_cos();
        // T(t) R(θ) R(-θm) T(-m) = T(t - R(θ-θm) m) R(θ-θm)
        *p = Pose { t_x: p.t_x - (c * m.t_x - s * m.t_y), t_y: p.t_y - (s * m.t_x + c * m.t_y), theta_z_deg: theta, ..*p };
    }
    m
}

/// `latent` warped by the planar pose `m` about its centre.
fn warp(latent: &Plane, m: &Pose) -> Plane {
    let (cx, cy) = ((latent.width as f64 - 1.0) / 2.0, (latent.height as f64 - 1.0) / 2.0);
    let (s, c) = m.theta_z_deg.to_radians().sin_cos();
    Plane::from_fn(latent.width, latent.height, |x, y| {
        let (u, v) = (x as f64 - cx - m.t_x, y as f64 - cy - m.t_y);
        bilinear(latent, DVec2::new(c * u + s * v + cx, -s * u + c * v + cy))
    })
}

/// Pixels farther than `radius` from those of which no frame has a measurement: nearer, what is clipped everywhere adds an unknown
/// amount of light.
fn known(frames: &[Frame], radius: usize) -> Vec<bool> {
    let (w, h) = frames[0].blurred.size();
    let lost: Vec<bool> = (0..w * h).map(|p| frames.iter().all(|f| f.mask.data[p] == 0.0)).collect();
    mask::apart(&lost, (w, h), radius)
}

/// One level of the pyramid.
#[derive(Clone)]
struct Level {
    scale: usize,
    frames: Vec<Frame>,
    size: (usize, usize),
    pad: usize,
    grid: PoseGrid,
    /// Whether a coarser level told where the poses are: they are looked for near there alone.
    near: bool,
    /// Pixels that count for TSFs and for the judgement.
    known: Vec<bool>,
    held: Vec<bool>,
    /// Standard deviation of the lens's blur in pixels of the level.
    lens_px: f32,
}

/// Luminance and TSFs on a level.
#[derive(Clone)]
struct State {
    reference: usize,
    latent: Plane,
    tsfs: Vec<Tsf>,
}

impl State {
    /// Takes the TSFs that were found.
    fn replace(&mut self, fits: Vec<Option<Tsf>>) {
        for (tsf, fit) in self.tsfs.iter_mut().zip(fits) {
            if let Some(fit) = fit {
                *tsf = fit;
            }
        }
    }

    /// The same, and fixes the free warp.
    fn take(&mut self, fits: Vec<Option<Tsf>>) {
        self.replace(fits);
        let m = fix_warp(&mut self.tsfs, self.reference);
        self.latent = warp(&self.latent, &m);
    }
}

impl Level {
    fn new(frames: &[Frame], scale: usize, near: bool) -> Self {
        let longer = frames[0].blurred.width.max(frames[0].blurred.height);
        let frames: Vec<Frame> = frames.iter().map(|f| shrink(f, scale)).collect();
        let size = frames[0].blurred.size();
        let radius = (longer / SEARCHED).max(8).div_ceil(scale) + 1;
        let grid = PoseGrid::new(size.0, size.1, radius, DEGREES, 1.0);
        let known = known(&frames, mask::UNKNOWN / scale + 1);
        // A fixed scatter over rows and columns.
        let held = (0..size.0 * size.1).map(|p| (p % size.0 * 12 + p / size.0 * 5).is_multiple_of(HELD)).collect();
        Self { scale, pad: radius + 6, frames, size, grid, near, known, held, lens_px: 0.0 }
    }

    /// The luminance as the frames see it.
    fn seen<'a>(&self, latent: &'a Plane) -> Cow<'a, Plane> {
        let (width, height) = latent.size();
        match behind_lens(&latent.data, (width, height), self.lens_px) {
            Cow::Borrowed(_) => Cow::Borrowed(latent),
            Cow::Owned(data) => Cow::Owned(Plane { width, height, data }),
        }
    }

    /// The start explains its frame; the other TSFs follow from it.
    fn begin(&self, start: &Start) -> State {
        let latent = shrunk(&start.luminance, self.scale).padded(self.pad);
        let mut tsfs: Vec<Tsf> =
            self.frames.par_iter().map(|f| self.fit(f, &latent, None, MODEL_ERROR.0).unwrap_or_else(Tsf::identity)).collect();
        tsfs[start.reference] = Tsf { focal_px: tsfs[start.reference].focal_px, ..Tsf::identity() };
        let mut state = State { reference: start.reference, latent, tsfs };
        self.solve(&mut state, SMOOTHNESS.0, MODEL_ERROR.0, 4);
        state
    }

    /// Luminance under the TSFs, whose operators are returned.
    fn solve(&self, state: &mut State, smoothness: f32, model_error: f32, outer: usize) -> Vec<Operator> {
        let operators = operators(&state.tsfs, self.size, self.pad);
        let effort = Effort { lambda: LAMBDA * smoothness, outer, inner: 12, model_error, lens_px: self.lens_px };
        state.latent = luminance::solve(&self.frames, &operators, &state.latent, &self.held, &effort);
        operators
    }

    /// The luminance as it is judged, of the TSFs that the last round left.
    fn settle(&self, state: &mut State) {
        self.solve(state, 1.0, MODEL_ERROR.1, 3);
    }

    /// One round: luminance, then all TSFs, then the free warp. With `draws` the TSFs are fitted to one of the scenes that the data allow, not to the
    /// smoothest, which is the best luminance: it is blurred, and TSFs that make up for that are too short, round by round.
    /// The frame `still` does not move.
    fn round(&self, state: &mut State, smoothness: f32, model_error: f32, draws: Option<&mut Random>, still: Option<usize>) {
        let operators = self.solve(state, smoothness, model_error, 2);
        let drawn = draws.map(|random| {
            let effort = Effort { lambda: LAMBDA * smoothness, outer: 1, inner: DRAWN.0, model_error, lens_px: self.lens_px };
            luminance::drawn(&self.frames, &operators, &state.latent, &self.held, &effort, DRAWN.1, random)
        });
        let latent = &self.seen(drawn.as_ref().unwrap_or(&state.latent));
        let fits = self.frames.par_iter().zip(&state.tsfs).map(|(f, t)| self.fit(f, latent, Some(t), model_error));
        let mut fits: Vec<Option<Tsf>> = fits.collect();
        if let Some(k) = still {
            fits[k] = None;
        }
        state.take(fits);
    }

    /// `state` after at most so many `steps` of cross-validation: pixels held out in turn are explained better and better by the luminance that is solved
    /// from the others. In time the TSFs follow the noise of those as well: what explains pixels best that no step has seen is kept. The frames `still` do
    /// not move. `None` as for [`at_coarsest`].
    fn validated(&self, state: &State, still: &[usize], steps: usize, going: &mut dyn FnMut() -> bool) -> Option<State> {
        let (w, n) = (self.size.0, self.held.len());
        let effort = Effort { lambda: LAMBDA, outer: 1, inner: SOLVED, model_error: MODEL_ERROR.1, lens_px: self.lens_px };
        let moves: Vec<bool> = (0..state.tsfs.len()).map(|k| !still.contains(&k)).collect();
        let mut now = state.clone();
        for (tsf, _) in now.tsfs.iter_mut().zip(&moves).filter(|(_, moves)| **moves) {
            *tsf = tsf::divided(tsf, self.size);
        }
        let mut strides = self.strides();
        let mut mean = now.tsfs.clone();
        let mut best = (geometric_mean(&self.judge(state)), state.clone());
        // Where the last step began, the residuals of each part when it was last held out, and the least of all.
        let mut left = (now.clone(), mean.clone());
        let (mut last, mut least) = ([None; FOLDS], f64::INFINITY);
        for k in 0..steps {
            if !going() {
                return None;
            }
            let fold: Vec<bool> = (0..n).map(|p| (p % w * 2 + p / w) % FOLDS == k % FOLDS && self.known[p] && !self.held[p]).collect();
            let held: Vec<bool> = fold.iter().zip(&self.held).map(|(f, h)| *f || *h).collect();
            let operators = operators(&now.tsfs, self.size, self.pad);
            now.latent = luminance::solve(&self.frames, &operators, &now.latent, &held, &effort);
            let found = luminance::cross_validated(&self.frames, &operators, &now.latent, (&held, &fold), &effort);
            // What one part has left says little about another.
            let most = last[k % FOLDS].map_or(FIRST_ROSE * least, |before| ROSE * before);
            if found.misfit > most {
                (now, mean) = left.clone();
                strides.iter_mut().for_each(Stride::shorten);
                continue;
            }
            last[k % FOLDS] = Some(found.misfit);
            least = least.min(found.misfit);
            left = (now.clone(), mean.clone());
            let latent = Latent { irradiance: &self.seen(&now.latent), sensitivity: &found.sensitivity, pad: self.pad };
            let frames = found.unseen.iter().zip(&now.tsfs).zip(&mut strides).zip(&moves);
            let stepped = frames.map(|(((unseen, tsf), stride), moves)| moves.then(|| unseen.step(&latent, tsf, stride)));
            let stepped = stepped.collect();
            if still.is_empty() {
                now.take(stepped);
            } else {
                // Those that do not move say where the scene is.
                now.replace(stepped);
            }
            for (mean, tsf) in mean.iter_mut().zip(&now.tsfs) {
                mean.move_towards(tsf, 1.0 - OLDER);
            }
            if (k + 1).is_multiple_of(CHECKED) {
                let mut settled = State { tsfs: mean.clone(), ..now.clone() };
                self.settle(&mut settled);
                best = better(Some(best), (geometric_mean(&self.judge(&settled)), settled));
            }
        }
        Some(best.1)
    }

    /// First strides: a Hessian of one frame alone knows nothing of how the luminance follows it, and with that the residuals of all others. The part that a
    /// frame has of all that is measured is how much of the luminance follows it at most.
    fn strides(&self) -> Vec<Stride> {
        let energy = |f: &Frame| -> f64 {
            let local = gradient_level(&f.blurred, 4);
            self.weight(f, MODEL_ERROR.1).data.iter().zip(&local.data).map(|(w, g)| f64::from(w * g * g)).sum()
        };
        let energies: Vec<f64> = self.frames.iter().map(energy).collect();
        let all: f64 = energies.iter().sum();
        energies.iter().map(|e| Stride::new(if all > 0.0 { e / all } else { 1.0 })).collect()
    }

    /// How much the pixels of `frame` count for its TSF where operators err by `model_error`.
    fn weight(&self, frame: &Frame, model_error: f32) -> Plane {
        let local = gradient_level(&frame.blurred, 4);
        let weight = |p: usize| {
            let m = if self.known[p] && !self.held[p] { frame.mask.data[p] } else { 0.0 };
            m * m / (frame.variance.data[p] + (model_error * local.data[p]).powi(2))
        };
        Plane { data: (0..local.data.len()).map(weight).collect(), ..local }
    }

    fn fit(&self, frame: &Frame, latent: &Plane, start: Option<&Tsf>, model_error: f32) -> Option<Tsf> {
        let weight = self.weight(frame, model_error);
        let base = start.map_or(DMat3::IDENTITY, |t| t.base);
        let whole = WholeFrame { latent, pad: self.pad, blurred: &frame.blurred, weight: &weight, base };
        // Faint poses are the fit's answer to noise and to what the luminance still lacks; unchecked, they widen the TSF round by round.
        let rough = match start {
            Some(start) if self.near => whole.fit_around(start)?,
            _ => whole.fit_grid(&self.grid, start)?,
        };
        without_faint(&whole.refine(&rough, if self.near { REFINED.1 } else { REFINED.0 }))
    }

    /// Mean squared residual over variance of each frame on the held-out pixels.
    fn judge(&self, state: &State) -> Vec<f64> {
        let chosen: Vec<bool> = self.held.iter().zip(&self.known).map(|(h, k)| *h && *k).collect();
        let operators = operators(&state.tsfs, self.size, self.pad);
        let seen = self.seen(&state.latent);
        self.frames.iter().zip(&operators).map(|(f, o)| chi_squared(f, o, &seen, &chosen)).collect()
    }

    /// `state` of the coarser level `from`.
    fn refine(&self, state: State, from: &Level) -> State {
        let ratio = from.scale / self.scale;
        State {
            reference: state.reference,
            latent: from.enlarged(&state.latent, ratio, self.size, self.pad),
            tsfs: state.tsfs.iter().map(|t| spread(t, ratio as f64)).collect(),
        }
    }

    /// `scene` at this level, its TSFs given.
    fn placed(&self, scene: &Plane, tsfs: &[Tsf], reference: usize) -> State {
        State {
            reference,
            latent: shrunk(scene, self.scale).padded(self.pad),
            tsfs: tsfs.iter().map(|t| t.scaled(1.0 / self.scale as f64)).collect(),
        }
    }

    /// TSFs and luminance of `state` on frames of `size`, the whole one.
    fn on_frame(&self, state: &State, size: (usize, usize)) -> (Vec<Tsf>, Plane) {
        let tsfs = state.tsfs.iter().map(|t| tsf::filled(t, self.scale as f64)).collect();
        (tsfs, self.enlarged(&self.seen(&state.latent), self.scale, size, 0))
    }

    /// `latent` of this level on a grid of `size` plus `pad` pixels on every side, `ratio` of them to one of its own.
    fn enlarged(&self, latent: &Plane, ratio: usize, size: (usize, usize), pad: usize) -> Plane {
        let at = |v: usize| (v as f64 - pad as f64 + 0.5) / ratio as f64 - 0.5 + self.pad as f64;
        Plane::from_fn(size.0 + 2 * pad, size.1 + 2 * pad, |x, y| bilinear(latent, DVec2::new(at(x), at(y))))
    }
}

/// exp of the mean logarithm: no frame buys its fit with another's.
pub fn geometric_mean(chi: &[f64]) -> f64 {
    let logs: Vec<f64> = chi.iter().filter(|c| c.is_finite()).map(|c| c.max(1e-6).ln()).collect();
    if logs.is_empty() { f64::INFINITY } else { (logs.iter().sum::<f64>() / logs.len() as f64).exp() }
}

/// Value at part `t` of the way from `range.0` to `range.1`, geometrically.
fn between(range: (f32, f32), t: f32) -> f32 {
    range.0 * (range.1 / range.0).powf(t)
}

/// The level at which a blur is a few pixels long: pixels of the frame per pixel of it.
fn coarsest(frames: &[Frame]) -> usize {
    let longer = frames[0].blurred.width.max(frames[0].blurred.height);
    let mut scale = 1;
    while longer / scale > COARSEST {
        scale *= 2;
    }
    scale
}

/// The finest level that is worked on: pixels of the frame per pixel of it.
fn finest(frames: &[Frame]) -> usize {
    let (w, h) = frames[0].blurred.size();
    let mut scale = 1;
    while !fits((w / scale, h / scale)) && scale < coarsest(frames) {
        scale *= 2;
    }
    scale
}

/// The one of `best` and `other` whose value is lower.
fn better<T>(best: Option<(f64, T)>, other: (f64, T)) -> (f64, T) {
    match best {
        Some(best) if best.0 <= other.0 => best,
        _ => other,
    }
}

/// Luminance and TSFs at the coarsest `level`, smoothness and trust in the operators falling: from each of `starts`, and the better one. Half
/// way does not tell: a start from a more blurred frame, which it explains by standing still, leads at first. `begun`: what is known already of one of them. `None` when `going` returns
/// `false`, which it is asked after each round.
fn at_coarsest(level: &Level, starts: &[Start], begun: Option<&Begun>, going: &mut dyn FnMut() -> bool) -> Option<State> {
    let mut best = None;
    for start in starts {
        let state = match begun.filter(|b| b.state.reference == start.reference) {
            Some(begun) => begun.state.clone(),
            None => from_start(level, start, None, going)?,
        };
        best = Some(better(best, (geometric_mean(&level.judge(&state)), state)));
    }
    best.map(|b| b.1)
}

/// What the coarsest level made of a start.
#[derive(Clone)]
pub struct Begun {
    state: State,
}

/// [`at_coarsest`] from one start; the frame `still` does not move.
fn from_start(level: &Level, start: &Start, still: Option<usize>, going: &mut dyn FnMut() -> bool) -> Option<State> {
    let mut state = level.begin(start);
    search(level, &mut state, still, going)?;
    sharpen(level, &mut state, still, going)?;
    Some(state)
}

/// The rounds of [`from_start`] before smoothness falls.
fn search(level: &Level, state: &mut State, still: Option<usize>, going: &mut dyn FnMut() -> bool) -> Option<()> {
    for _ in 0..SEARCH {
        level.round(state, SMOOTHNESS.0, MODEL_ERROR.0, None, still);
        going().then_some(())?;
    }
    Some(())
}

/// Those in which smoothness and trust in the operators' errors fall.
fn sharpen(level: &Level, state: &mut State, still: Option<usize>, going: &mut dyn FnMut() -> bool) -> Option<()> {
    let rounds = ROUNDS.0 - SEARCH;
    for k in 1..=rounds {
        let t = k as f32 / rounds as f32;
        level.round(state, between((SMOOTHNESS.0, 1.0), t), between(MODEL_ERROR, t), None, still);
        going().then_some(())?;
    }
    level.settle(state);
    Some(())
}

/// What speaks for it that a frame moved that was taken for stationary.
#[derive(Clone, Debug, PartialEq)]
pub struct Doubt {
    /// Its blur where all frames may move, in pixels: length of an even stroke of the standard deviation along the blur beyond that across it. A soft lens has none.
    pub stroke_px: f64,
    /// The same from which it may have moved.
    pub line_px: f64,
    /// ln of the squared residual where it did not move over that where it did, on pixels that no part of the estimate has seen: of the frame itself and the mean of all; 0 where it has
    /// no stroke.
    pub explained: (f64, f64),
}

/// Stroke, in pixels of the coarsest level, from which a frame that was taken for stationary may have moved: behind soft lenses, sharp frames beside ones that moved had up to 0.55 in random
/// brackets, frames blurred by 3 to 4 pixels of twice the size from 0.75.
const STROKE: f64 = 0.625;

/// Part of [`STROKE`] below which a frame's stroke does not come to more once smoothness falls.
const BEGUN: f64 = 0.5;

/// Squared residual where all frames moved over that of what is known without it, on pixels that no part of the estimate has seen, below which it is believed that they did.
pub const EXPLAINED: f64 = 0.8;

impl Doubt {
    /// Whether it is worth to estimate all blurs together: the stroke is longer than the line and the residual falls below [`EXPLAINED`] of what it was, of the frame itself and in the mean.
    pub fn is_founded(&self) -> bool {
        self.stroke_px > self.line_px && self.explained.0.min(self.explained.1) > -EXPLAINED.ln()
    }
}

/// Whether the frame of `start` may have moved as well as all others, as the coarsest level tells, and what [`estimate`] can go on from, where it has a stroke. `None` when `going` returns `false`, which
/// it is asked after each round.
pub fn doubt(frames: &[Frame], start: &Start, going: &mut dyn FnMut() -> bool) -> Option<(Doubt, Option<Begun>)> {
    let level = Level::new(frames, coarsest(frames), false);
    let line_px = STROKE * level.scale as f64;
    let stroke = |state: &State| {
        let c = state.tsfs[start.reference].covariance();
        let beyond = (c.x_axis.x - c.y_axis.y).hypot(2.0 * c.x_axis.y);
        (12.0 * beyond).sqrt() * level.scale as f64
    };
    let unfounded = |stroke_px: f64| Some((Doubt { stroke_px, line_px, explained: (0.0, 0.0) }, None));
    let mut moved = level.begin(start);
    search(&level, &mut moved, None, going)?;
    if stroke(&moved) <= BEGUN * line_px {
        return unfounded(stroke(&moved));
    }
    sharpen(&level, &mut moved, None, going)?;
    let stroke_px = stroke(&moved);
    if stroke_px <= line_px {
        return unfounded(stroke_px);
    }
    let still = from_start(&level, start, Some(start.reference), going)?;
    let begun = Begun { state: moved };
    let (still, moved) = (level.judge(&still), level.judge(&begun.state));
    let ln = |still: f64, moved: f64| (still.max(1e-6) / moved.max(1e-6)).ln();
    let own = ln(still[start.reference], moved[start.reference]);
    Some((Doubt { stroke_px, line_px, explained: (own, ln(geometric_mean(&still), geometric_mean(&moved))) }, Some(begun)))
}

/// `state` of the level `from` on the next finer one, `level`, and `rounds` on from there. `None` as for [`at_coarsest`].
fn at_finer(
    level: &Level,
    state: State,
    from: &Level,
    rounds: usize,
    mut draws: Option<&mut Random>,
    going: &mut dyn FnMut() -> bool,
) -> Option<State> {
    let mut state = level.refine(state, from);
    for k in 0..rounds {
        let t = k as f32 / (rounds - 1) as f32;
        level.round(&mut state, between((SMOOTHNESS.1, 1.0), t), between(MODEL_ERROR, t), draws.as_deref_mut(), None);
        if !going() {
            return None;
        }
    }
    level.settle(&mut state);
    Some(state)
}

/// What the coarsest level tells.
struct Look {
    level: Level,
    state: State,
}

impl Look {
    /// At `frames` from the better of `starts`. `None` as for [`estimate`].
    fn at(frames: &[Frame], starts: &[Start], begun: Option<&Begun>, progress: &mut dyn FnMut(Stage) -> bool) -> Option<Self> {
        let scale = coarsest(frames);
        let (mut done, total) = (0, ROUNDS.0 * starts.len());
        let level = Level::new(frames, scale, false);
        let state = at_coarsest(&level, starts, begun, &mut || {
            done += 1;
            progress(Stage { scale, fraction: done as f32 / total as f32 })
        })?;
        Some(Self { level, state })
    }
}

/// What rounds with drawn scenes at the coarsest level make of what `look` saw there. `None` as for [`at_coarsest`].
fn drawn_at_coarsest(look: &Look, random: &mut Random, going: &mut dyn FnMut() -> bool) -> Option<State> {
    let (level, mut state) = (&look.level, look.state.clone());
    for _ in 0..DRAWN_ROUNDS.0 {
        level.round(&mut state, 1.0, MODEL_ERROR.1, Some(random), None);
        if !going() {
            return None;
        }
    }
    level.settle(&mut state);
    Some(state)
}

/// `state` of `level` at the level `last`, which it is or a finer one, and that level. `None` as for [`at_coarsest`].
fn at_last(
    frames: &[Frame],
    mut level: Level,
    mut state: State,
    last: usize,
    mut draws: Option<Random>,
    advance: &mut dyn FnMut(usize) -> bool,
) -> Option<(Level, State)> {
    while level.scale > last {
        let finer = Level { lens_px: 2.0 * level.lens_px, ..Level::new(frames, level.scale / 2, true) };
        state = at_finer(&finer, state, &level, ROUNDS.2, draws.as_mut(), &mut || advance(finer.scale))?;
        level = finer;
    }
    Some((level, state))
}

/// TSFs and luminance of `frames` (two or more, of one size), from the best of `starts`, of one of which [`doubt`] may
/// have `begun`. With `known.first`, the second level's first answer is the last one where it explains that frame or all
/// frames no better than what is known: it will not be believed. `progress` returning `false` ends the work: `None`, as
/// for no start.
pub fn estimate(
    frames: &[Frame],
    starts: &[Start],
    begun: Option<&Begun>,
    known: &Known,
    progress: &mut dyn FnMut(Stage) -> bool,
) -> Option<Joint> {
    let (first, last) = (coarsest(frames), finest(frames));
    let cost = |scale: usize, rounds: usize| rounds as f32 / (scale * scale) as f32;
    // Small frames have one level, on which the second's work is done as well.
    let scale = (first / 2).max(last);
    let mut total = cost(first, ROUNDS.0 * starts.len())
        + cost(first, DRAWN_ROUNDS.0)
        + cost(scale, ROUNDS.1 * (1 + LENSES.len()) + DRAWN_ROUNDS.1 + STEPS.0);
    let mut s = scale;
    while s > last {
        s /= 2;
        total += cost(s, ROUNDS.2);
    }
    let (mut done, total) = (0.0, Cell::new(total));
    let mut advance = |scale: usize| {
        done += cost(scale, 1);
        progress(Stage { scale, fraction: done / total.get() })
    };

    let look = Look::at(frames, starts, begun, &mut |s| advance(s.scale))?;
    // Solved alike, held-out pixels left out: a merge that has seen them would fit their noise.
    let otherwise = |level: &Level, reference: usize| {
        let mut still = level.placed(known.scene, known.tsfs, reference);
        level.settle(&mut still);
        level.judge(&still)
    };
    let (level, state, ways) = 'found: {
        let mut level = Level::new(frames, scale, true);
        let fitted_to_best = |level: &Level, advance: &mut dyn FnMut(usize) -> bool| {
            at_finer(level, look.state.clone(), &look.level, ROUNDS.1, None, &mut || advance(scale))
        };
        // Which way is the better one tells this level, not the first. Fitted to the best scene, which is blurred, TSFs are too short; to drawn ones, where a
        // blur is not much longer than a pixel of the first level or the scene is not what the smoothness takes it for, too long.
        let mut random = Random::new(SEED, 1);
        let drawn = drawn_at_coarsest(&look, &mut random, &mut || advance(first))?;
        let best = fitted_to_best(&level, &mut advance)?;
        let held_out = level.judge(&best);
        if known.first.is_some() && !explains_better(&held_out, &otherwise(&level, best.reference), known.first, 1.0) {
            break 'found (level, best, vec![Way { fitted_to: FittedTo::Best, held_out: geometric_mean(&held_out) }]);
        }
        // A soft scene makes for TSFs that are too thick, all by the same: these explain the frames less well than a lens does.
        let mut best = (geometric_mean(&held_out), best);
        for (tried, lens_px) in LENSES.into_iter().enumerate() {
            let behind = Level { lens_px, ..level.clone() };
            let fitted = fitted_to_best(&behind, &mut advance)?;
            let held_out = geometric_mean(&behind.judge(&fitted));
            if held_out >= SHARPER * best.0 {
                total.set(total.get() - cost(scale, ROUNDS.1 * (LENSES.len() - 1 - tried)));
                break;
            }
            (level, best) = (behind, (held_out, fitted));
        }
        let best = best.1;
        let drawn = at_finer(&level, drawn, &look.level, DRAWN_ROUNDS.1, Some(&mut random), &mut || advance(scale))?;
        let mut ways = Vec::new();
        let mut judged = |fitted_to: FittedTo, state: &State| {
            let held_out = geometric_mean(&level.judge(state));
            ways.push(Way { fitted_to, held_out });
            held_out
        };
        let (with_best, with_drawn) = (judged(FittedTo::Best, &best), judged(FittedTo::Drawn, &drawn));
        let fitted = if with_drawn < CLEARLY * with_best { (with_drawn, (drawn, Some(random))) } else { (with_best, (best, None)) };
        let unseen = level.validated(&fitted.1.0, &[], STEPS.0, &mut || advance(scale))?;
        let (_, (state, draws)) = better(Some(fitted), (judged(FittedTo::Unseen, &unseen), (unseen, Some(Random::new(SEED, 3)))));
        ways.sort_by(|a, b| a.held_out.total_cmp(&b.held_out));
        let (level, state) = at_last(frames, level, state, last, draws, &mut advance)?;
        (level, state, ways)
    };
    let (held_out, held_out_merge) = (level.judge(&state), otherwise(&level, state.reference));
    let (tsfs, luminance) = level.on_frame(&state, frames[0].blurred.size());
    let lens_px = level.lens_px * level.scale as f32;
    Some(Joint { luminance, tsfs, lens_px, scale: level.scale, reference: state.reference, held_out, held_out_merge, ways })
}

/// Whether frames of this size are worked on as they are, not at a smaller one.
pub fn fits(size: (usize, usize)) -> bool {
    size.0 * size.1 <= LARGEST
}

/// TSFs of `frames`, one each, from those that were found, `tsfs`, and the scene under these, `latent`, so that pixels held out in turn are explained better; as they
/// were where none are. The frames `still` keep theirs. `None` where `progress` returns `false`.
pub fn cross_validated(
    frames: &[Frame],
    latent: &Plane,
    tsfs: &[Tsf],
    still: &[usize],
    reference: usize,
    progress: &mut dyn FnMut(Stage) -> bool,
) -> Option<Vec<Tsf>> {
    let level = Level::new(frames, 1, true);
    let mut state = level.placed(latent, tsfs, reference);
    level.settle(&mut state);
    let mut done = 0;
    let found = level.validated(&state, still, STEPS.1, &mut || {
        done += 1;
        progress(Stage { scale: 1, fraction: done as f32 / STEPS.1 as f32 })
    })?;
    let (before, after) = (level.judge(&state), level.judge(&found));
    // No frame at another's expense.
    let worse = before.iter().zip(&after).any(|(before, after)| *after > WORSE * before);
    Some(if !worse && geometric_mean(&after) < geometric_mean(&before) { found.tsfs } else { tsfs.to_vec() })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (72, 60);
    const PAD: usize = 12;
    const NOISE: f32 = 0.02;

    fn path(x: f64, y: f64, roll: f64) -> Tsf {
        let at = |t: f64| Pose::planar(x * t, y * t - 0.8 * (t * t - 0.4), roll * t, 1.0);
        Tsf::new(90.0, (0..9).map(|i| at(f64::from(i) / 4.0 - 1.0)).collect()).unwrap()
    }

    /// A scene with [`PAD`] pixels around it.
    fn scene(random: &mut Random) -> Plane {
        let levels: Vec<f32> = (0..256).map(|_| (0.6 * random.normal() as f32).exp()).collect();
        Plane::from_fn(SIZE.0 + 2 * PAD, SIZE.1 + 2 * PAD, |x, y| levels[((x + y / 3) / 9 * 61 + (y + 100 - x / 5) / 7 * 17) % 256])
    }

    /// What a frame shows of it.
    fn frame(scene: &Plane, tsf: &Tsf, random: &mut Random) -> Frame {
        let (w, h) = SIZE;
        let clean = Operator::new(tsf, w, h, PAD).blur(scene);
        let blurred = Plane::in_order(w, h, |x, y| clean.at(x, y) + NOISE * random.normal() as f32);
        Frame { variance: clean.map(|_| NOISE * NOISE), mask: clean.map(|_| 1.0), clipped: vec![false; w * h], blurred }
    }

    /// From TSFs that are too short the steps lead to others that explain more; from the true ones only to the noise of the pixels held out in turn, which
    /// is not kept.
    #[test]
    fn cross_validation_keeps_what_explains_unseen_pixels_best() {
        let tsfs = |length: f64| [path(1.5 * length, 0.5, 0.3), path(-1.0, 2.5 * length, -0.3), path(3.5 * length, 1.5, 0.5)];
        let mut random = Random::new(7, 0);
        let scene = scene(&mut random);
        let frames: Vec<Frame> = tsfs(1.0).iter().map(|t| frame(&scene, t, &mut random)).collect();
        let level = Level::new(&frames, 1, true);
        let residuals = |length: f64| {
            let mut state = level.placed(&scene.crop(PAD, PAD, SIZE.0, SIZE.1), &tsfs(length), 0);
            level.settle(&mut state);
            let found = level.validated(&state, &[], STEPS.0, &mut || true).unwrap();
            [state, found].map(|s| geometric_mean(&level.judge(&s)))
        };
        let [before, after] = residuals(1.0);
        assert!(after <= before, "from the true TSFs: {before:.3}, then {after:.3}");
        let [before, after] = residuals(0.6);
        assert!(after < 0.7 * before, "from short ones: {before:.3}, then {after:.3}");
    }

    #[test]
    fn a_frame_that_stood_still_is_soon_beyond_doubt_and_one_that_moved_is_not() {
        let mut random = Random::new(9, 0);
        let scene = scene(&mut random);
        let asked = |first: &Tsf, random: &mut Random| {
            let frames = [frame(&scene, first, random), frame(&scene, &path(-1.0, 3.5, -0.3), random)];
            let start = Start { reference: 0, luminance: frames[0].blurred.clone() };
            let mut rounds = 0;
            let (doubt, begun) = doubt(&frames, &start, &mut || {
                rounds += 1;
                true
            })
            .unwrap();
            (doubt.is_founded(), begun.is_some(), rounds, doubt.stroke_px)
        };
        let (founded, begun, rounds, stroke) = asked(&Tsf::identity(), &mut random);
        assert!(!founded && !begun && rounds == SEARCH, "{founded} after {rounds} rounds, {stroke:.2} px");
        let (founded, begun, rounds, stroke) = asked(&path(2.5, 0.5, 0.3), &mut random);
        assert!(founded && begun && rounds == 2 * ROUNDS.0, "{founded} after {rounds} rounds, {stroke:.2} px");
    }

    #[test]
    fn a_doubt_needs_a_stroke_and_a_frame_that_is_explained_itself() {
        let founded = |stroke_px: f64, own: f64, all: f64| Doubt { stroke_px, line_px: 1.25, explained: (own, all) }.is_founded();
        assert!(founded(2.0, 0.7, 0.3));
        assert!(!founded(0.8, 0.7, 0.3), "a soft lens");
        assert!(!founded(2.0, 0.03, 1.0), "the others are explained better, not the frame that is in doubt");
        assert!(!founded(2.0, 0.7, 0.1), "at the others' expense");
    }
}
