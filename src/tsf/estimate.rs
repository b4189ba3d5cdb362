//! TSF of a frame from nothing: coarse-to-fine over a pyramid, then the motion model that the frame asks for.
//!
//! At the coarsest level any blur is a few pixels, and a grid of poses is searched whole. Each finer level looks only around the poses of
//! the level before: first which poses of a lattice of one pixel (eq. 6, against the frame itself), then their continuous positions.

use super::Tsf;
use super::continuous::{Evidence, mean_square};
use super::from_psfs::nominal_focal;
use super::held_out::{Filters, HeldOut, Worse};
use super::model::{Chart, Coordinates, Model};
use super::whole_frame::{Row, WholeFrame};
use crate::image::Plane;
use crate::pose::{Pose, PoseGrid, project};
use glam::{DMat3, DVec2, DVec3};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// What is asked of [`WholeFrame::estimate`].
#[derive(Clone, Debug, Default)]
pub struct Search {
    /// How the camera may move.
    pub model: Model,
    /// Focal length in pixels; `None`: found where pitch and yaw show it, else 1.2 times the longer side.
    pub focal_px: Option<f64>,
    /// Once this is set the estimate is not wanted any more, and what comes back is of no use.
    pub stop: Option<Arc<AtomicBool>>,
}

impl Search {
    /// Focal length in pixels of a frame of `w` x `h` pixels, and the model to begin with: pitch and yaw show only at the finest level.
    fn start(&self, w: usize, h: usize) -> (f64, Model) {
        let planar = if self.model == Model::Translation { Model::Translation } else { Model::Rigid };
        (self.focal_px.unwrap_or_else(|| nominal_focal(w, h)), planar)
    }

    fn is_stopped(&self) -> bool {
        self.stop.as_ref().is_some_and(|s| s.load(Ordering::Relaxed))
    }
}

/// A model that was tried.
#[derive(Clone, Debug, Serialize)]
pub struct Trial {
    /// The model.
    pub model: Model,
    /// Focal length in pixels under which it was tried.
    pub focal_px: f64,
    /// Mean squared residual over variance (noise and expected operator error) of the differences that it was not fitted to.
    pub held_out: f64,
    /// How much worse than the best trial: mean logarithm of the ratio of squared residuals over blocks of the frame.
    pub worse_by: f64,
}

/// What was found about one frame.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// The TSF.
    pub tsf: Tsf,
    /// The model it lies in.
    pub model: Model,
    /// Whether the focal length was given, found or held at its default: `given`, `found`, `default`.
    pub focal: &'static str,
    /// The models that were tried against held-out differences; empty where the model was given.
    pub trials: Vec<Trial>,
    /// How much worse than the best of them it explains the frame that it did not move while it was exposed, in the same measure.
    pub still_worse_by: f64,
    /// Standard error of that.
    pub still_error: f64,
    /// The same of the frame showing nothing at all, no structure: of a frame of another scene about 0, as no blur explains parts that it was not fitted to.
    pub blank_worse_by: f64,
    /// Frame pixels per pixel of the finest level that the blur needed: 1, 2, 4, ...
    pub scale: usize,
    /// Mean squared residual over variance of the differences that count.
    pub residual: f64,
    /// By how much the TSF lowers the squared residual, in units of the noise, per number that it has: about 1 where it explains noise alone.
    pub evidence: f64,
}

impl Estimate {
    /// Whether the frame has enough texture, seen well enough, to tell its blur.
    pub fn is_sound(&self) -> bool {
        self.evidence > EVIDENCE
    }

    /// That of a level on the pixels of the frame 2^`size` times as large that is asked about, of which the level is 2^-`below` in size: what lies between its poses there is filled.
    fn on_frame(self, size: usize, below: usize, base: &DMat3) -> Self {
        let tsf = filled(&self.tsf, f64::from(1u32 << below)).scaled(f64::from(1u32 << size)).about(*base);
        Self { tsf, scale: 1 << (size + below), ..self }
    }
}

/// Least [`Estimate::evidence`] of a TSF that says something: noise alone reaches 1 to 2.
const EVIDENCE: f64 = 6.0;

/// Differences that the continuous poses are fitted to.
const ROWS: usize = 14_000;
/// Shorter side in pixels below which a level holds too little to see.
const SMALLEST: usize = 56;
/// Largest translation of the coarsest grid in its pixels.
const RADIUS: usize = 16;
/// Largest roll searched, degrees.
const DEGREES: f64 = 2.5;
/// Extent of the blur in pixels beyond which a coarser level tells all that can be told.
const FINEST_EXTENT: f64 = 48.0;
/// Focal lengths tried, times the longer side: from a wide lens to a short telephoto lens.
const FOCALS: [f64; 4] = [0.6, 0.85, 1.7, 2.4];
/// Iterations of a trial: the start is near.
const TRIAL: usize = 4;

/// A level of the pyramid.
struct Level {
    latent: Plane,
    pad: usize,
    blurred: Plane,
    weight: Plane,
    base: DMat3,
}

impl Level {
    fn frame(&self) -> WholeFrame<'_> {
        WholeFrame { latent: &self.latent, pad: self.pad, blurred: &self.blurred, weight: &self.weight, base: self.base }
    }

    /// Half the size.
    fn half(frame: &WholeFrame) -> Self {
        // An odd pad would put the frame between the pixels of the halved latent image.
        let cut = frame.pad % 2;
        let cropped = (cut > 0).then(|| frame.latent.crop(cut, cut, frame.latent.width - 2 * cut, frame.latent.height - 2 * cut));
        let s = DMat3::from_diagonal(DVec3::new(0.5, 0.5, 1.0));
        let variance = frame.weight.map(|w| if w > 0.0 { 1.0 / w } else { f32::INFINITY });
        Self {
            latent: cropped.as_ref().unwrap_or(frame.latent).halved(),
            pad: frame.pad / 2,
            blurred: frame.blurred.halved(),
            // Squared weights of the filter sum to (20/64)² instead of 1: white noise falls, a masked pixel masks all it touches.
            weight: variance.halved().map(|v| if v.is_finite() { 1.0 / (v * (20.0f32 / 64.0).powi(2)) } else { 0.0 }),
            base: s * frame.base * s.inverse(),
        }
    }
}

/// Extent in pixels, the largest over corners and centre, of what the TSF does to a point: all but the outermost hundredth of its time on
/// either side, since a stray pose of next to no weight is not blur.
pub fn extent(tsf: &Tsf, width: usize, height: usize) -> f64 {
    let span = |along: &mut Vec<(f64, f64)>| {
        along.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut before = 0.0;
        let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
        for &(v, w) in along.iter() {
            if before + w > 0.01 && before < 0.99 {
                (lo, hi) = (lo.min(v), hi.max(v));
            }
            before += w;
        }
        (hi - lo).max(0.0)
    };
    widest(tsf, (width, height), span)
}

/// Length in pixels of an even stroke whose standard deviation, the largest over corners and centre, is that of what the TSF does to a point: a few per
/// cent of its time far away count for less than in [`extent`].
pub fn stroke(tsf: &Tsf, width: usize, height: usize) -> f64 {
    let deviation = |along: &mut Vec<(f64, f64)>| {
        let moment = |f: &dyn Fn(f64) -> f64| along.iter().map(|&(v, w)| f(v) * w).sum::<f64>();
        let mean = moment(&|v| v);
        moment(&|v| (v - mean).powi(2)).sqrt()
    };
    12f64.sqrt() * widest(tsf, (width, height), deviation)
}

/// The largest of what `measure` makes of where the poses take the corners and the centre, along x or y, and their weights.
fn widest(tsf: &Tsf, size: (usize, usize), mut measure: impl FnMut(&mut Vec<(f64, f64)>) -> f64) -> f64 {
    let mut worst = 0.0f64;
    for p in landmarks(size) {
        let moved: Vec<(DVec2, f64)> = tsf.poses.iter().map(|pose| (pose.apply(tsf.focal_px, p), pose.weight)).collect();
        worst = worst
            .max(measure(&mut moved.iter().map(|m| (m.0.x, m.1)).collect()))
            .max(measure(&mut moved.iter().map(|m| (m.0.y, m.1)).collect()));
    }
    worst
}

/// Centre and corners, from the centre.
fn landmarks(size: (usize, usize)) -> [DVec2; 5] {
    let corner = 0.5 * DVec2::new(size.0 as f64 - 1.0, size.1 as f64 - 1.0);
    [(0.0, 0.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(i, j)| DVec2::new(i, j) * corner)
}

/// Whole pixels u = p - Γ⁻¹ p near which the PSF at the frame's pixel `p` of a `size` frame has its values.
pub fn path_at(tsf: &Tsf, p: (f64, f64), size: (usize, usize)) -> Vec<(isize, isize)> {
    let p = DVec2::new(p.0 - (size.0 as f64 - 1.0) / 2.0, p.1 - (size.1 as f64 - 1.0) / 2.0);
    let mut path: Vec<(isize, isize)> = tsf
        .poses
        .iter()
        .map(|pose| {
            let u = p - project(&pose.homography(tsf.focal_px).inverse(), p);
            (u.x.round() as isize, u.y.round() as isize)
        })
        .collect();
    path.sort_unstable();
    path.dedup();
    path
}

/// Farthest that any pose takes a corner or the centre, pixels.
fn reach(tsf: &Tsf, size: (usize, usize)) -> f64 {
    let farthest =
        |pose: &Pose| landmarks(size).map(|p| (pose.apply(tsf.focal_px, p) - p).abs().max_element()).into_iter().fold(0.0, f64::max);
    tsf.poses.iter().map(farthest).fold(0.0, f64::max)
}

/// Particles that stand for one continuous pose together: the heaviest take in those within `radius` pixels.
pub(super) fn gather(particles: &mut Vec<(Coordinates, f64)>, radius: f64, most: usize) {
    particles.sort_by(|a, b| b.1.total_cmp(&a.1));
    // (coordinates, weight, where it was when it took its place)
    let mut out: Vec<(Coordinates, f64, Coordinates)> = Vec::new();
    for (c, w) in particles.iter() {
        let distance = |home: &Coordinates| home.iter().zip(c).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        let near = out.iter_mut().map(|q| (distance(&q.2), q)).min_by(|a, b| a.0.total_cmp(&b.0));
        match near {
            Some((d, q)) if d <= radius => {
                let s = q.1 + w;
                for (a, b) in q.0.iter_mut().zip(c) {
                    *a = (*a * q.1 + b * w) / s;
                }
                q.1 = s;
            }
            _ => out.push((*c, *w, *c)),
        }
    }
    let total: f64 = out.iter().map(|p| p.1).sum();
    out.sort_by(|a, b| b.1.total_cmp(&a.1));
    out.retain(|p| p.1 > 1e-3 * total);
    out.truncate(most);
    *particles = out.into_iter().map(|(c, w, _)| (c, w)).collect();
}

/// The lattice poses within a step of those of `tsf`.
fn around(tsf: &Tsf, chart: &Chart, step: f64) -> Vec<Pose> {
    let mut seen: BTreeMap<[i64; 3], Coordinates> = BTreeMap::new();
    let roll = if chart.free() > 2 { 1 } else { 0 };
    for pose in &tsf.poses {
        let c = chart.coordinates(pose);
        let at: [i64; 3] = std::array::from_fn(|k| (c[k] / step).round() as i64);
        for dz in -roll..=roll {
            for dy in -1..=1 {
                for dx in -1..=1 {
                    let key = [at[0] + dx, at[1] + dy, at[2] + dz];
                    seen.entry(key).or_insert([key[0] as f64 * step, key[1] as f64 * step, key[2] as f64 * step, c[3], c[4]]);
                }
            }
        }
    }
    seen.values().map(|c| chart.pose(c, 1.0)).collect()
}

/// Continuous poses for the lattice poses of `tsf`: as close together as their number allows.
pub(super) fn gathered(tsf: &Tsf, chart: &Chart) -> Option<Tsf> {
    let mut particles = Vec::new();
    for radius in GATHER {
        particles = tsf.poses.iter().map(|p| (chart.coordinates(p), p.weight)).collect();
        gather(&mut particles, radius, MOST);
        if particles.len() <= FEW {
            break;
        }
    }
    Tsf::new(chart.focal, particles.iter().map(|(c, w)| chart.pose(c, *w)).collect()).ok()
}

/// Distances in pixels within which lattice poses become one continuous pose: the first that leaves few, else the last.
const GATHER: [f64; 3] = [0.7, 0.9, 1.2];
/// So few continuous poses are refined in no time.
const FEW: usize = 50;
/// Continuous poses at most.
const MOST: usize = 250;

/// What [`thinned`] tries, the least sparse first: sparsity as a part of the standard deviation that the TSF leaves, and whether only what hangs
/// together stays.
const THINNED: [(f64, bool); 8] =
    [(0.0, false), (0.25, false), (0.5, false), (1.0, false), (2.0, false), (0.25, true), (0.5, true), (1.0, true)];
/// Pixels from where the frame lies up to which poses are near.
const NEAR: usize = 3;
/// Distance in pixels up to which two poses of a camera's path hang together.
const LINK: f64 = 3.0;

/// `tsf` without the poses that only answer to noise and to what the latent irradiance lacks: the sparsest that explains those of `rows` that it
/// was not fitted to not clearly worse than the best. Beside a chain of lamps such poses may lie far from the blur, and everything after counts
/// on its extent.
fn thinned(frame: &WholeFrame, tsf: &Tsf, rows: &[Row], chart: &Chart) -> Tsf {
    let held = HeldOut::of(rows, frame.size());
    let fitted = |evidence: &Evidence, noise: f64, (sparsity, connected): (f64, bool)| {
        let found = evidence.weigh(&tsf.poses, chart.focal, sparsity * noise)?;
        if connected { main_path(&found, chart) } else { Some(found) }
    };
    let (inside, judge) = (Evidence::new(frame, &held.inside), Evidence::new(frame, &held.outside));
    let noise = inside.misfit(tsf).sqrt();
    let attempt = |&how: &(f64, bool)| {
        let found = gathered(&fitted(&inside, noise, how)?, chart)?;
        Some((how, held.blocks(&judge.residual(&inside.refine(&found, chart, 3)))))
    };
    let tried: Vec<_> = THINNED.iter().filter_map(attempt).collect();
    let best = tried.iter().min_by(|a, b| Worse::than(&a.1, &b.1).by.total_cmp(&0.0));
    let sparsest = best.and_then(|best| tried.iter().rev().find(|t| Worse::than(&t.1, &best.1).forgivable()));
    let all = Evidence::new(frame, rows);
    sparsest.and_then(|t| fitted(&all, all.misfit(tsf).sqrt(), t.0)).unwrap_or_else(|| tsf.clone())
}

/// A short blur about where the frame lies, if it explains what it is not fitted to not clearly worse than `long`, which a coarser level found: beside
/// lamps, far poses answer there to what the latent irradiance lacks.
fn short(frame: &WholeFrame, long: &Tsf, model: Model) -> Option<Tsf> {
    let size = frame.size();
    let chart = Chart::new(model, long.focal_px, size.0, size.1);
    let held = HeldOut::of(&frame.rows(ROWS, margin(long, size)), size);
    let (inside, judge) = (Evidence::new(frame, &held.inside), Evidence::new(frame, &held.outside));
    let blocks = |tsf: &Tsf| held.blocks(&judge.residual(tsf));
    let long = inside.refine(&gathered(long, &chart)?, &chart, 5);
    let short = near(&inside, &chart, inside.misfit(&long).sqrt())?;
    Worse::than(&blocks(&short), &blocks(&long)).forgivable().then_some(short)
}

/// A blur of poses up to [`NEAR`] pixels from where the frame lies, where so much `noise` is left.
fn near(evidence: &Evidence, chart: &Chart, noise: f64) -> Option<Tsf> {
    let lattice = (0..NEAR).try_fold(Tsf::identity(), |t, _| Tsf::new(chart.focal, around(&t, chart, 1.0))).ok()?;
    let few = gathered(&evidence.weigh(&lattice.poses, chart.focal, noise)?, chart)?;
    Some(evidence.refine(&few, chart, 5))
}

/// The poses of `tsf` that hang together and weigh most.
fn main_path(tsf: &Tsf, chart: &Chart) -> Option<Tsf> {
    let mut left: Vec<(Coordinates, &Pose)> = tsf.poses.iter().map(|p| (chart.coordinates(p), p)).collect();
    let mut heaviest: (f64, Vec<Pose>) = (0.0, Vec::new());
    while let Some(first) = left.pop() {
        let mut path = vec![first];
        let mut next = 0;
        while next < path.len() {
            let here = path[next].0;
            let near = |c: &Coordinates| here.iter().zip(c).map(|(a, b)| (a - b).powi(2)).sum::<f64>() <= LINK * LINK;
            path.extend(left.extract_if(.., |p| near(&p.0)));
            next += 1;
        }
        let weight = path.iter().map(|p| p.1.weight).sum();
        if weight > heaviest.0 {
            heaviest = (weight, path.into_iter().map(|p| *p.1).collect());
        }
    }
    Tsf::new(tsf.focal_px, heaviest.1).ok()
}

impl WholeFrame<'_> {
    /// What this frame, and it at 1/2, 1/4, ... of its size, `sizes` in all as far as they show anything, say of its blur: where the latent irradiance is noisy, coarse
    /// structure tells more of one than fine. The TSFs are on this frame's pixels.
    pub fn estimates(&self, search: &Search, sizes: usize) -> Vec<Option<Estimate>> {
        let (w, h) = self.size();
        let fits = |l: &usize| *l == 0 || w.min(h) >> l >= SMALLEST;
        let mut found: Vec<Option<Estimate>> = vec![None; (0..sizes).filter(fits).count().max(1)];
        self.descend(search, &mut |frame, l, tsf, last| {
            // Where a blur is so long that no finer size tells more, those tell nothing of their own.
            let at = l.min(found.len() - 1);
            if last || l == at {
                found[at] = Some(choose(frame, l, tsf, search).on_frame(at, l - at, &self.base));
            }
        });
        found
    }

    /// TSF of this frame from nothing; `None` when no pose explains it better than none.
    pub fn estimate(&self, search: &Search) -> Option<Estimate> {
        let mut found = None;
        self.descend(search, &mut |frame, l, tsf, last| {
            if last {
                found = Some(choose(frame, l, tsf, search).on_frame(0, l, &self.base));
            }
        });
        found
    }

    /// The TSF from the coarsest level to the finest, or to that at which the blur is so long that finer ones tell nothing more. `visit` is told each level's frame, its
    /// number, the TSF on this frame's pixels, and whether it is the last; where no pose explains one better than none it is not told of that and of finer ones.
    fn descend(&self, search: &Search, visit: &mut dyn FnMut(&WholeFrame, usize, &Tsf, bool)) -> Option<()> {
        let (w, h) = self.size();
        let mut count = 0;
        while w.min(h) >> (count + 1) >= SMALLEST {
            count += 1;
        }
        let levels = self.levels(count);
        let level = |l: usize| if l == 0 { WholeFrame { ..*self } } else { levels[l - 1].frame() };

        let (focal, planar) = search.start(w, h);
        let coarse = level(count);
        let (cw, ch) = coarse.size();
        let grid = PoseGrid::new(cw, ch, RADIUS.min(cw.min(ch) / 5), DEGREES, 1.0);
        let mut tsf = coarse.fit_grid(&grid, None)?.scaled((1 << count) as f64);
        tsf.focal_px = focal;
        for l in (0..=count).rev() {
            if search.is_stopped() {
                return None;
            }
            let scale = (1 << l) as f64;
            let frame = level(l);
            let (fw, fh) = frame.size();
            let chart = Chart::new(planar, focal / scale, fw, fh);
            let mut here = tsf.scaled(1.0 / scale);
            let margin = margin(&here, (fw, fh));
            let rows = frame.rows(ROWS / 2, margin);
            if l < count {
                here = Evidence::new(&frame, &rows).weigh(&around(&here, &chart, 1.0), chart.focal, 1.0)?;
            }
            here = thinned(&frame, &here, &rows, &chart);
            here = gathered(&here, &chart)?;
            let rows = frame.rows(ROWS, margin);
            here = Evidence::new(&frame, &rows).refine(&here, &chart, if l == 0 { 10 } else { 5 });
            tsf = here.scaled(scale);
            let long = l > 0 && extent(&here, fw, fh) * 2.0 > FINEST_EXTENT;
            let short = if long { short(&level(l - 1), &here.scaled(2.0), planar) } else { None };
            let last = l == 0 || long && short.is_none();
            visit(&frame, l, &tsf, last);
            if last {
                break;
            }
            if let Some(short) = short {
                tsf = short.scaled(0.5 * scale);
            }
        }
        Some(())
    }

    /// TSF of this frame, if that is a slight blur, of a few pixels about where the frame lies; `None` when no such pose explains it better than none.
    pub fn estimate_slight(&self, search: &Search) -> Option<Estimate> {
        let (w, h) = self.size();
        let (focal, planar) = search.start(w, h);
        let (rows, chart) = (self.rows(ROWS, NEAR + 3), Chart::new(planar, focal, w, h));
        let evidence = Evidence::new(self, &rows);
        // What is left without any blur is more than noise: the second time counts what the first leaves.
        let first = near(&evidence, &chart, evidence.misfit(&Tsf::identity()).sqrt())?;
        let found = near(&evidence, &chart, evidence.misfit(&first).sqrt())?;
        Some(choose(self, 0, &found, search).on_frame(0, 0, &self.base))
    }

    /// `tsf` against a better latent irradiance: its poses and weights, moved within their own model, for at most so many `iterations`.
    pub fn refine(&self, tsf: &Tsf, iterations: usize) -> Tsf {
        let (w, h) = self.size();
        let mut l = 0;
        while extent(tsf, w, h) > FINEST_EXTENT * f64::from(1 << l) && w.min(h) >> (l + 1) >= SMALLEST {
            l += 1;
        }
        let levels = self.levels(l);
        let frame = if l == 0 { WholeFrame { ..*self } } else { levels[l - 1].frame() };
        let scale = f64::from(1 << l);
        let size = frame.size();
        let chart = Chart::new(model_of(tsf), tsf.focal_px / scale, size.0, size.1);
        let Some(start) = gathered(&tsf.scaled(1.0 / scale), &chart) else { return tsf.clone() };
        let rows = frame.rows(ROWS, margin(&start, size));
        filled(&Evidence::new(&frame, &rows).refine(&start, &chart, iterations), scale).about(self.base)
    }

    /// Sparse poses within a pixel's step of those of `start`, in roll and translation, where that is already near; `None` when nothing
    /// fits. λ follows what `start` leaves unexplained: while the latent irradiance is not yet right, that is more than noise, and poses that
    /// answer to it widen the TSF.
    pub fn fit_around(&self, start: &Tsf) -> Option<Tsf> {
        let (w, h) = self.size();
        let chart = Chart::new(Model::Rigid, start.focal_px, w, h);
        let rows = self.rows(ROWS / 2, margin(start, (w, h)));
        let evidence = Evidence::new(self, &rows);
        evidence.weigh(&around(start, &chart, 1.0), chart.focal, 2.0 * evidence.misfit(start).sqrt())
    }

    /// The coarser levels of the pyramid: 1/2, 1/4, ...
    fn levels(&self, count: usize) -> Vec<Level> {
        let mut levels: Vec<Level> = Vec::new();
        for _ in 0..count {
            let next = Level::half(&levels.last().map_or(WholeFrame { ..*self }, Level::frame));
            levels.push(next);
        }
        levels
    }
}

/// The model of the TSF, and the TSF within it on the pixels of `frame`, from the planar `tsf` on those of a frame 2^`l` times as large.
fn choose(frame: &WholeFrame, l: usize, tsf: &Tsf, search: &Search) -> Estimate {
    let (scale, focal) = ((1 << l) as f64, tsf.focal_px);
    let (w, h) = frame.size();
    let start = tsf.scaled(1.0 / scale);
    let all = frame.rows(ROWS, margin(&start, (w, h)));
    let fit = |rows: &[Row], model: Model, focal: f64, from: &Tsf, iterations: usize| {
        let iterations = if search.is_stopped() { 0 } else { iterations };
        Evidence::new(frame, rows).refine(from, &Chart::new(model, focal / scale, w, h), iterations)
    };
    let mut trials = Vec::new();
    let (mut model, mut chosen_focal, mut source) = (search.model, focal, if search.focal_px.is_some() { "given" } else { "default" });
    let held = HeldOut::of(&all, (w, h));
    let judge = Evidence::new(frame, &held.outside);
    // Model, focal length, and the residual of each block of held-out differences.
    type Tried = (Model, f64, Vec<(usize, f64)>);
    let mut tried: Vec<Tried> = Vec::new();
    let mut attempt = |model: Model, focal: f64| {
        let t = fit(&held.inside, model, focal, &start, TRIAL);
        let blocks = held.blocks(&judge.residual(&t));
        tried.push((model, focal, blocks.clone()));
        blocks
    };
    if search.model == Model::Auto {
        attempt(Model::Translation, focal);
        let rigid = attempt(Model::Rigid, focal);
        let turned = attempt(Model::Rotation, focal);
        let full = attempt(Model::Full, focal);
        // Other focal lengths only where perspective shows at all: otherwise none can be told from another.
        let seen = !Worse::than(&rigid, &turned).forgivable() || !Worse::than(&rigid, &full).forgivable();
        if search.focal_px.is_none() && seen {
            for f in FOCALS {
                attempt(Model::Rotation, f * w.max(h) as f64 * scale);
            }
        }
        let mean = |t: &[(usize, f64)]| t.iter().map(|v| v.1).sum::<f64>() / t.len().max(1) as f64;
        let better = |a: &[(usize, f64)], b: &[(usize, f64)]| Worse::than(a, b).by.total_cmp(&0.0);
        let best = tried.iter().min_by(|a, b| better(&a.2, &b.2)).expect("several models are tried").clone();
        let mut forgiven: Vec<(Model, f64)> = Vec::new();
        for (m, f, r) in &tried {
            let worse = Worse::than(r, &best.2);
            trials.push(Trial { model: *m, focal_px: *f, held_out: mean(r), worse_by: worse.by });
            if worse.forgivable() {
                forgiven.push((*m, *f));
            }
        }
        // The simplest that is not clearly worse; among focal lengths the default, unless another is clearly better.
        let order = [Model::Translation, Model::Rigid, Model::Rotation, Model::Full];
        model = order.into_iter().find(|m| forgiven.iter().any(|t| t.0 == *m)).unwrap_or(best.0);
        if model == Model::Rotation && !forgiven.contains(&(Model::Rotation, focal)) {
            let rotations = trials.iter().filter(|t| t.model == Model::Rotation);
            chosen_focal = rotations.min_by(|a, b| a.worse_by.total_cmp(&b.worse_by)).map_or(focal, |t| t.focal_px);
            source = "found";
        }
    }
    // Where the frame lies as it was placed, or in the middle of the motion, which may be far from it: what explains it better.
    let evidence = Evidence::new(frame, &all);
    let poses = [Tsf { focal_px: start.focal_px, ..Tsf::identity() }, Tsf::new(start.focal_px, vec![start.mean()]).expect("one pose")];
    let one = poses.into_iter().min_by(|a, b| evidence.misfit(a).total_cmp(&evidence.misfit(b))).expect("two poses");
    let filters = Filters::of(frame);
    let halves = HeldOut::halves(&all, (w, h));
    let judged = |half: &HeldOut, model: Model, focal: f64, from: &Tsf| {
        let residual = filters.residual(frame, half, &fit(&half.inside, model, focal, from, TRIAL));
        (half.blocks_with_gains(&frame.targets(&half.outside), &residual), half.blocks(&residual))
    };
    let of_both = |model: Model, focal: f64, from: &Tsf| {
        let (mut first, second) = rayon::join(|| judged(&halves[0], model, focal, from), || judged(&halves[1], model, focal, from));
        first.0.extend(second.0);
        first.1.extend(second.1);
        first
    };
    let (in_place, moving) = rayon::join(|| of_both(Model::Rigid, focal, &one), || of_both(model, chosen_focal, &start));
    let nothing: Vec<_> = halves.iter().flat_map(|half| half.blocks(&frame.targets(&half.outside))).collect();
    let than_still = Worse::than(&in_place.0, &moving.0);
    // A gain of its own explains a part of any block.
    let blank_worse_by = Worse::than(&nothing, &moving.1).by;
    let (still_worse_by, still_error) = (than_still.by, than_still.error());
    let here = fit(&all, model, chosen_focal, &start, 10);
    let residual = evidence.misfit(&here);
    let numbers = here.poses.len() * (Chart::new(model, focal, w, h).free() + 1);
    let evidence = (mean_square(evidence.targets()) - residual) * all.len() as f64 / numbers as f64;
    Estimate { tsf: here, model, focal: source, trials, still_worse_by, still_error, blank_worse_by, scale: 1, residual, evidence }
}

/// `tsf` of a level on frame pixels, `factor` to one of the level's: gaps between poses, which grow with the pixels, are filled by a tent.
pub fn filled(tsf: &Tsf, factor: f64) -> Tsf {
    let mut out = tsf.scaled(factor);
    let n = factor as i32;
    if n > 1 {
        let tent = |k: i32| f64::from(n - k.abs()) / f64::from(n * n);
        let spread = |p: &Pose| {
            let p = *p;
            (1 - n..n).flat_map(move |j| {
                (1 - n..n).map(move |i| Pose {
                    t_x: p.t_x + f64::from(i),
                    t_y: p.t_y + f64::from(j),
                    weight: p.weight * tent(i) * tent(j),
                    ..p
                })
            })
        };
        out.poses = out.poses.iter().flat_map(spread).collect();
    }
    out
}

/// The narrowest model that holds all poses of `tsf`.
pub(super) fn model_of(tsf: &Tsf) -> Model {
    let any = |f: fn(&Pose) -> f64| tsf.poses.iter().any(|p| f(p).abs() > 1e-9);
    match (any(|p| p.theta_x_deg) || any(|p| p.theta_y_deg), any(|p| p.t_x) || any(|p| p.t_y)) {
        (true, true) => Model::Full,
        (true, false) => Model::Rotation,
        (false, _) if any(|p| p.theta_z_deg) => Model::Rigid,
        (false, _) => Model::Translation,
    }
}

/// Pixels from the border within which a pose looks beyond the frame, at most a fifth of the shorter side.
fn margin(tsf: &Tsf, size: (usize, usize)) -> usize {
    (reach(tsf, size).ceil() as usize + 3).min(size.0.min(size.1) / 5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tsf::held_out::tests::scattered;

    /// A coarse level may find a motion whose middle is far from where the frame lies: one pose there explains nothing, and that is no evidence for the motion.
    #[test]
    fn a_frame_in_place_is_compared_with_where_it_was_placed() {
        let (w, h) = (150, 120);
        let levels: Vec<f32> = (0..256).map(|i| (0.6 * scattered(11, i)).exp()).collect();
        let scene = Plane::from_fn(w, h, |x, y| levels[((x + y / 3) / 7 * 61 + (y + 100 - x / 5) / 6 * 17) % 256]);
        let blurred = Plane::from_fn(w, h, |x, y| scene.at(x, y) + 0.01 * scattered(12, y * w + x));
        let weight = scene.map(|_| 1e4);
        let frame = WholeFrame { latent: &scene, pad: 0, blurred: &blurred, weight: &weight, base: DMat3::IDENTITY };
        let far = Tsf::new(180.0, vec![Pose::planar(0.0, 0.0, 0.0, 0.6), Pose::planar(24.0, -9.0, 0.0, 0.4)]).unwrap();
        let found = choose(&frame, 0, &far, &Search { model: Model::Rigid, ..Search::default() });
        assert!(found.still_worse_by < 0.05, "one pose is worse by {:.2}", found.still_worse_by);
    }
}
