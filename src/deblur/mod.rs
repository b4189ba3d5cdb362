//! Irradiance E from all frames and their TSFs: eq. (9)-(10) in log irradiance u, half-quadratic total variation, damped
//! Gauss-Newton steps solved by preconditioned conjugate gradients on the GPU. No image leaves the GPU inside the loop.
//!
//! Each outer iteration computes the data weights W of every frame at the present estimate (mask² over the noise variance of
//! the *predicted* exposure, less where a blurred frame's residuals exceed what noise explains), the edge weights
//! w = λ/√(Σ_c|∇u_c|² + ε²), and solves
//!
//! `[E Σ_i K_iᵀ W_i K_i E + Dᵀ w D] δu = E Σ_i K_iᵀ W_i (B_i - K_i E) - Dᵀ w D u`
//!
//! with K roughly in the matrix and exactly on the right ([`TapSet::rougher`]), then tries E·(1 + s·δu) where δu > 0 and E·exp(s·δu)
//! elsewhere (at most fourfold, at least 1/e) for s = 1, 1/2, 1/4, ... until
//! the objective `½ Σ W (B - K E)² + λ Σ √(|∇u|² + ε²)` (with these weights) does not rise. The data term is quadratic in E: with
//! the first form a bracket without a sharp frame needs half the outer iterations that exp(s·δu) in both directions needs.
//! λ is a pure number: the data term counts in units of the noise, u in natural logarithms. With [`Prior::Collaborative`] total variation
//! has a part of it only, and what noise that leaves is filtered from the result.
//!
//! Residuals far from the solution speak of the start and not of a frame's TSF, so the residual-driven weights begin once
//! an outer step lowers the objective by less than `settled` of it; at once where sharp frames start from their own merge and
//! still leave far more than the noise, since they then do not agree about the scene. The conjugate gradients of a step end when
//! ⟨r, z⟩ has fallen to the part `reduction`, or after `inner` iterations. The iteration stops when a step under the
//! residual-driven weights lowers the objective by less than `tolerance` of it, or at `outer` steps.

mod aliasing;
mod in_place;
mod memory;
mod prior;

pub use aliasing::{TILE, aliasing};
pub use in_place::on_own_pixels;
pub use memory::Memory;
pub use prior::Prior;

use crate::error::{Error, Result};
use crate::gpu::{self, Gpu, Step};
use crate::image::{Plane, Rgb};
use crate::kernels::{
    Blur, DeviceRgb, HALO, Kernels, Misfit, MisfitSource, REACH, SCALARS, SLOT_CURVATURE, SLOT_DATA, SLOT_ENERGY, SLOT_SMOOTHNESS, SLOTS,
    STILL, Scratch, ScratchSize, WeightTarget, channels, partials_1d, partials_2d,
};
use crate::tsf::{Interpolation, TapSet, Tsf};
use glam::DMat3;
use memory::{Need, Plan};
use serde::Serialize;
use std::ops::Range;
use std::sync::Arc;

/// One frame as the solver sees it.
pub struct Observation {
    /// Exposure f⁻¹(Z), 1 = white, three channels; [`crate::kernels::UNSEEN`] where a channel is clipped and others are not.
    pub exposure: Rgb,
    /// Mask of eq. (8), 0..=1, of all channels that are not unseen.
    pub mask: Plane,
    /// Exposure time in seconds.
    pub exposure_time: f64,
    /// Standard deviation of the exposure at equal steps of √exposure from 0 to 1, per channel
    /// ([`crate::kernels::NOISE_STEPS`] values).
    pub noise: [Vec<f32>; 3],
    /// Whether the file's noise is clipped at black (every 8-bit file's is).
    pub black_clipped: bool,
    /// The frame's TSF.
    pub tsf: Tsf,
}

/// What can be set about the solver.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Weight λ of total variation per unit of log irradiance, for three channels together; the strength of the filter follows it.
    pub lambda: f32,
    /// What irradiance is taken to look like.
    pub prior: Prior,
    /// Differences of log irradiance below ε are smoothed quadratically.
    pub epsilon: f32,
    /// Outer iterations (weights, Gauss-Newton) at most.
    pub outer: usize,
    /// Conjugate-gradient iterations of each outer one at most.
    pub inner: usize,
    /// Part of its start to which ⟨r, z⟩ of the conjugate gradients has to fall: the weights of the next outer iteration change more than what is left.
    pub reduction: f64,
    /// Relative fall of the objective below which the iteration stops.
    pub tolerance: f64,
    /// Strength of the residual-driven weights of blurred frames; 0: none.
    pub robust: f32,
    /// Relative fall of the objective in an outer step below which the residual-driven weights begin; infinity: from the first.
    pub settled: f64,
    /// Whether data weights follow the estimate; `false` freezes those of the start.
    pub reweight: bool,
    /// Interpolation of the blurred frames' warps. Bilinear warps blur by themselves, which the result makes up for by edges too steep.
    pub interpolation: Interpolation,
    /// Most bytes of device memory; `None`: as many as there are.
    pub memory_limit: Option<u64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            lambda: 2.5,
            prior: Prior::default(),
            epsilon: 0.01,
            outer: 8,
            inner: 16,
            reduction: 1e-2,
            tolerance: 2e-2,
            robust: 1.0,
            settled: 0.5,
            reweight: true,
            interpolation: Interpolation::Bicubic,
            memory_limit: None,
        }
    }
}

/// Why the solver stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum Stop {
    /// The objective no longer fell.
    Converged,
    /// All outer iterations were used.
    IterationLimit,
    /// No step lowered the objective.
    Breakdown,
}

/// One outer iteration.
#[derive(Clone, Debug, Serialize)]
pub struct Iteration {
    /// Objective before the step, with the weights of this iteration.
    pub before: f64,
    /// Objective after it, with the same weights.
    pub after: f64,
    /// Damping s of the step; 0 when none lowered the objective.
    pub step: f32,
    /// Conjugate-gradient iterations.
    pub inner: usize,
    /// ⟨r, z⟩ of the conjugate gradients at the end over that at the start.
    pub reduction: f64,
}

/// How a solve went.
#[derive(Clone, Debug, Serialize)]
pub struct SolveReport {
    /// Why it stopped.
    pub stop: Stop,
    /// The outer iterations.
    pub history: Vec<Iteration>,
    /// Mean squared residual over variance of each frame, where it is not masked, before the result is filtered: 1 is what noise explains.
    pub chi_squared: Vec<f64>,
    /// Device memory that it took.
    pub memory: Memory,
}

/// Irradiance and how it was reached.
#[derive(Clone)]
pub struct Solution {
    /// Irradiance on the frame's grid plus the pad on every side.
    pub irradiance: Rgb,
    /// Pad in pixels.
    pub pad: usize,
    /// Local χ² of each frame before the result is filtered (Gaussian of 2 px, frame's grid).
    pub misfit: Vec<Plane>,
    /// History and residuals.
    pub report: SolveReport,
}

impl Solution {
    /// Irradiance on the frame's grid alone.
    pub fn cropped(&self) -> Rgb {
        let (w, h) = self.irradiance.size();
        self.irradiance.crop(self.pad, self.pad, w - 2 * self.pad, h - 2 * self.pad)
    }
}

/// Pixels by which the latent grid must surround the frame so that no pose of `tsfs` looks beyond it, at most `limit`.
///
/// A frame that is displaced as a whole counts by how far its poses spread: what it shows beyond the reference no other frame confirms, and
/// an estimate of it from two steps would be wrong by more than the frame's noise. Its pixels that look there are masked.
pub fn pad_for(tsfs: &[&Tsf], width: usize, height: usize, limit: usize) -> usize {
    let (x, y) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(i, j)| glam::DVec2::new(i * x, j * y));
    let mut worst = 0.0f64;
    for tsf in tsfs.iter().filter(|t| !t.is_identity()) {
        let centre = tsf.centre();
        let displaced = corners.iter().any(|&c| (crate::pose::project(&centre, c) - c).length() > DISPLACED);
        for pose in &tsf.poses {
            let mut back = (pose.homography(tsf.focal_px) * tsf.base).inverse();
            if displaced || tsf.poses.len() == 1 {
                back = centre * back;
            }
            for corner in corners {
                let p = crate::pose::project(&back, corner);
                worst = worst.max(p.x.abs() - x).max(p.y.abs() - y);
            }
        }
    }
    if worst < 1e-6 { 0 } else { (worst.ceil() as usize + 3).min(limit) }
}

/// Part of the strength of the residual-driven weights that a displaced sharp frame gets: what its samples between the grid's pixels differ
/// by is no wrong TSF, and it is the best frame there is on its own pixels.
const STILL_ROBUST: f32 = 0.3;
/// Mean squared residual over variance from which sharp frames, at the merge of themselves, do not agree about the scene: what their pixels alias makes some
/// times the noise, flare and what moved in a photographed night some thousand.
const DISAGREE: f64 = 300.0;
/// Least irradiance: the logarithm needs one above 0.
const DARKEST: f32 = 1e-30;
/// Part of the time that the iteration takes.
const ITERATING: f32 = 0.95;
/// Displacement in pixels from which a frame counts as displaced rather than shaken.
const DISPLACED: f64 = 4.0;

/// K of a frame that is not in place.
struct Operator {
    blur: Blur,
    /// About the same for less, in the matrix of a step; `None` where nothing costs less.
    rough: Option<Blur>,
    interpolation: Interpolation,
    /// Where a frame of one pose lies, centred pixels.
    still: Option<DMat3>,
    energy: f32,
    /// (x, y, weight) near the frame's centre.
    psf: Vec<(f64, f64, f64)>,
}

struct Moving {
    operator: Operator,
    weight: DeviceRgb,
    observation: DeviceRgb,
}

impl Moving {
    /// Steps of `frame = K latent`.
    fn forward(&self, solver: &Solver, latent: &[wgpu::Buffer], frame: &[wgpu::Buffer]) -> Vec<Step> {
        let kernels = solver.kernels.blur(self.operator.interpolation);
        self.operator.blur.forward(solver.gpu, kernels, &solver.state.scratch, latent, frame)
    }

    /// Steps of `latent += Kᵀ W K of`, roughly, for channels `group`; `between` receives W K of.
    fn curvature(
        &self,
        solver: &Solver,
        group: &Range<usize>,
        of: &[wgpu::Buffer],
        between: &[wgpu::Buffer],
        latent: &[wgpu::Buffer],
    ) -> Vec<Step> {
        let Solver { gpu, kernels, state, .. } = solver;
        let blur = self.operator.rough.as_ref().unwrap_or(&self.operator.blur);
        let own = kernels.blur(self.operator.interpolation);
        let mut steps = blur.forward(gpu, own, &state.scratch, of, between);
        for (weight, values) in self.weight[group.clone()].iter().zip(between) {
            steps.extend(kernels.linear.multiply(gpu, weight, values, solver.counts().1));
        }
        steps.extend(blur.adjoint(gpu, own, &state.scratch, between, latent, 1.0));
        steps
    }

    /// Steps of `latent += factor Kᵀ frame`.
    fn adjoint(&self, solver: &Solver, frame: &[wgpu::Buffer], latent: &[wgpu::Buffer], factor: f32) -> Vec<Step> {
        let kernels = solver.kernels.blur(self.operator.interpolation);
        self.operator.blur.adjoint(solver.gpu, kernels, &solver.state.scratch, frame, latent, factor)
    }
}

/// Exposure and mask of a frame.
enum Kept {
    /// In buffers of their own.
    Device { exposure: DeviceRgb, mask: wgpu::Buffer },
    /// On the host, to fill buffers that are shared before they are read: red, green, blue, mask.
    Host([Arc<Vec<f32>>; 4]),
}

struct Observed {
    kept: Kept,
    moving: Option<Moving>,
}

struct State {
    irradiance: DeviceRgb,
    /// Before the step that is tried.
    old: DeviceRgb,
    solution: DeviceRgb,
    weight: DeviceRgb,
    observation: DeviceRgb,
    edge: wgpu::Buffer,
    /// Of the channels that are solved together: one, or three.
    residual: Vec<wgpu::Buffer>,
    direction: Vec<wgpu::Buffer>,
    product: Vec<wgpu::Buffer>,
    back: Vec<wgpu::Buffer>,
    diagonal: Vec<wgpu::Buffer>,
    predicted: Vec<wgpu::Buffer>,
    misfit: Misfit,
    misfit_scratch: Misfit,
    partials: wgpu::Buffer,
    scalars: wgpu::Buffer,
    scratch: Scratch,
}

/// Everything on the GPU for one bracket and one set of TSFs.
struct Solver<'a> {
    gpu: &'a Gpu,
    kernels: &'a Kernels,
    settings: &'a Settings,
    observations: &'a [Observation],
    observed: Vec<Observed>,
    state: State,
    frame: (usize, usize),
    latent: (usize, usize),
    pad: usize,
    memory: Memory,
}

fn upload_rgb(gpu: &Gpu, label: &str, image: &Rgb) -> Result<DeviceRgb> {
    let [r, g, b] = &image.0;
    Ok([gpu.upload(label, &r.data)?, gpu.upload(label, &g.data)?, gpu.upload(label, &b.data)?])
}

/// Refuses what no upload sees: the start is clamped first, noise and exposure times travel as parameters.
fn check(observations: &[Observation], initial: &Rgb) -> Result<()> {
    if initial.0.iter().any(|p| p.data.iter().any(|v| !v.is_finite())) {
        return Err(Error::Input("the start of the solver holds NaN or infinity".into()));
    }
    for (i, o) in observations.iter().enumerate() {
        if !(o.exposure_time.is_finite() && o.exposure_time > 0.0) {
            return Err(Error::Input(format!("frame {}: exposure time {} s is not a positive number", i + 1, o.exposure_time)));
        }
        if o.noise.iter().any(|n| n.len() != crate::kernels::NOISE_STEPS || n.iter().any(|v| !(v.is_finite() && *v > 0.0))) {
            return Err(Error::Input(format!("frame {}: a noise curve is not {} positive numbers", i + 1, crate::kernels::NOISE_STEPS)));
        }
    }
    Ok(())
}

/// The scalar `slot` of each channel.
fn each_channel(scalars: &[f64], slot: usize) -> [f64; 3] {
    std::array::from_fn(|c| scalars[SLOTS * c + slot])
}

/// The operators of a bracket and what they and the iteration keep.
struct Layout {
    frame: (usize, usize),
    /// None for a frame in place.
    operators: Vec<Option<Operator>>,
    need: Need,
}

impl Layout {
    fn new(gpu: &Gpu, kernels: &Kernels, tsfs: &[&Tsf], latent: (usize, usize), pad: usize, interpolation: Interpolation) -> Result<Self> {
        let frame = (latent.0 - 2 * pad, latent.1 - 2 * pad);
        let (n, m) = (latent.0 * latent.1, frame.0 * frame.1);
        let operator = |tsf: &Tsf| {
            let still = tsf.single();
            let interpolation = if still.is_some() { STILL } else { interpolation };
            let taps = TapSet::new(tsf, frame.0, frame.1, interpolation);
            let about = |taps: &TapSet| Blur::new(gpu, kernels.blur(interpolation), taps, frame, pad);
            let blur = about(&taps);
            let rough = taps.rougher(tsf, frame.0, frame.1, interpolation).map(|rough| about(&rough));
            Operator { blur, rough, interpolation, still, energy: taps.energy() as f32, psf: taps.psf() }
        };
        let operators: Vec<Option<Operator>> = tsfs.iter().map(|t| (!t.is_identity()).then(|| operator(t))).collect();
        let blurs = || operators.iter().flatten().flat_map(|o| std::iter::once(&o.blur).chain(&o.rough));
        let rows = blurs().map(Blur::rows_at_once).fold(1 + 2 * HALO.max(REACH), usize::max);
        if !gpu.rows_fit(rows, latent) {
            return Err(Error::Adapter(format!(
                "frames of {} x {} pixels: {} allows {} KiB per binding, less than {rows} of their rows need; reduce them with --scale, \
                 or use another adapter",
                frame.0,
                frame.1,
                gpu.description,
                gpu.max_binding() >> 8
            )));
        }
        let scratch = |size: fn(&Blur) -> ScratchSize| blurs().map(size).fold(ScratchSize::default(), ScratchSize::max);
        let (wanted, needed) = (scratch(Blur::scratch_wanted), scratch(Blur::scratch_needed));
        // All bases at once while they are small (fewer dispatches), half a gigabyte at most.
        let most = (1 << 25).min(gpu.max_texels());
        let shaken = operators.iter().flatten().count();
        let need = Need {
            latent: n,
            frame: m,
            frames: tsfs.len(),
            shaken,
            partials: (partials_1d(gpu, n) + shaken * partials_1d(gpu, m)).max(partials_2d(gpu, latent)),
            scratch_wanted: wanted.min(ScratchSize { planes: most, copy: most }.max(needed)),
            scratch_needed: needed,
        };
        Ok(Self { frame, operators, need })
    }
}

/// Device memory of a solve of frames of `frame` = (width, height) pixels under `tsfs`, with a latent grid that surrounds them by `pad`.
///
/// # Errors
/// [`Error::OutOfMemory`], with what it needs at least, when that is beyond [`Settings::memory_limit`]; [`Error::Adapter`] when the rows are too
/// long for the adapter.
pub fn memory(gpu: &Gpu, kernels: &Kernels, tsfs: &[&Tsf], frame: (usize, usize), pad: usize, settings: &Settings) -> Result<Memory> {
    let latent = (frame.0 + 2 * pad, frame.1 + 2 * pad);
    let layout = Layout::new(gpu, kernels, tsfs, latent, pad, settings.interpolation)?;
    Ok(layout.need.plan(settings.memory_limit.unwrap_or(u64::MAX))?.memory)
}

/// Irradiance that explains `observations`, from the start `initial` (irradiance, positive; grid of the frame plus `pad` on
/// every side). `progress` receives the fraction done; returning `false` cancels.
///
/// # Errors
/// `Cancelled`; out of memory and lost device; [`Error::Input`] for NaN or infinity in the input, exposure times and noise
/// curves that are not positive.
pub fn solve(
    gpu: &Gpu,
    kernels: &Kernels,
    observations: &[Observation],
    initial: &Rgb,
    pad: usize,
    settings: &Settings,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Solution> {
    solve_watched(gpu, kernels, observations, initial, pad, settings, &mut |_| (), progress)
}

/// [`solve`] that shows the estimate while it works: `watch` receives the irradiance's buffers (of the size of `initial`) once, before the
/// first iteration; every iteration writes them anew.
///
/// # Errors
/// As [`solve`].
pub fn solve_watched(
    gpu: &Gpu,
    kernels: &Kernels,
    observations: &[Observation],
    initial: &Rgb,
    pad: usize,
    settings: &Settings,
    watch: &mut dyn FnMut(&DeviceRgb),
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Solution> {
    let (mut limit, mut reduced) = (settings.memory_limit.unwrap_or(u64::MAX), false);
    loop {
        match Solver::new(gpu, kernels, observations, initial, pad, settings, limit) {
            // The device has less room than was planned with: a smaller plan, until none is left.
            Err(Error::OutOfMemory(_)) if gpu.counted() > 0 => {
                limit = gpu.counted().min(limit) / 16 * 15;
                reduced = true;
            }
            solver => {
                let mut solver = solver?;
                solver.memory.reduced = reduced;
                watch(&solver.state.irradiance);
                return solver.run(progress);
            }
        }
    }
}

impl<'a> Solver<'a> {
    fn new(
        gpu: &'a Gpu,
        kernels: &'a Kernels,
        observations: &'a [Observation],
        initial: &Rgb,
        pad: usize,
        settings: &'a Settings,
        limit: u64,
    ) -> Result<Self> {
        gpu.start_count();
        let latent = initial.size();
        check(observations, initial)?;
        let tsfs: Vec<&Tsf> = observations.iter().map(|o| &o.tsf).collect();
        let Layout { frame, operators, need } = Layout::new(gpu, kernels, &tsfs, latent, pad, settings.interpolation)?;
        let (n, m, shaken) = (need.latent, need.frame, need.shaken);
        let Plan { memory, scratch } = need.plan(limit)?;
        let together = memory.channels_together;
        let scratch = Scratch::new(gpu, scratch, together)?;
        let ch = |label, count| channels(gpu, label, count);
        let some = |label, count| (0..together).map(|_| gpu.plane(label, count)).collect::<Result<Vec<_>>>();
        let (residual, direction, product) = (some("residual of the step", n)?, some("search direction", n)?, some("product", n)?);
        let diagonal = some("preconditioner", n)?;
        // Vectors that are never alive together share buffers: see the order of the steps in `run`.
        let old = match together {
            3 => std::array::from_fn(|c| residual[c].clone()),
            _ => [&residual, &product, &diagonal].map(|v| v[0].clone()),
        };
        let misfit = |sum: &[wgpu::Buffer], counted: &[wgpu::Buffer]| Misfit { sum: sum[0].clone(), counted: counted[0].clone() };
        let state = State {
            irradiance: upload_rgb(gpu, "irradiance", &initial.map_planes(|p| p.map(|v| v.max(DARKEST))))?,
            old,
            solution: ch("step", n)?,
            weight: ch("weights of sharp frames", n)?,
            observation: ch("observations of sharp frames", n)?,
            edge: gpu.plane("edge weights", n)?,
            back: some("back-projection", n)?,
            predicted: some("prediction", if shaken > 0 { m } else { 1 })?,
            misfit: misfit(&residual, &direction),
            misfit_scratch: misfit(&product, &diagonal),
            residual,
            direction,
            product,
            diagonal,
            partials: gpu.plane("partial sums", together * need.partials)?,
            scalars: gpu.plane("scalars", SCALARS)?,
            scratch,
        };
        let mut observed = Vec::new();
        for (i, (o, operator)) in observations.iter().zip(operators).enumerate() {
            let moving = match operator {
                None => None,
                Some(operator) => Some(Moving { operator, weight: ch("weights", m)?, observation: ch("observations", m)? }),
            };
            let kept = if memory.streamed {
                let planes = o.exposure.0.iter().chain(std::iter::once(&o.mask));
                let mut host = planes.map(|p| gpu::finite(&format!("frame {}", i + 1), &p.data).map(|()| Arc::new(p.data.clone())));
                let mut next = || host.next().expect("four planes");
                Kept::Host([next()?, next()?, next()?, next()?])
            } else {
                Kept::Device { exposure: upload_rgb(gpu, "exposure", &o.exposure)?, mask: gpu.upload("mask", &o.mask.data)? }
            };
            observed.push(Observed { kept, moving });
        }
        let mut solver = Self { gpu, kernels, settings, observations, observed, state, frame, latent, pad, memory };
        solver.mask_beyond()?;
        Ok(solver)
    }

    /// Takes the pixels of blurred frames out of the masks that see beyond the latent grid: K of ones is less than 1 there.
    fn mask_beyond(&mut self) -> Result<()> {
        let (n, m) = self.counts();
        // There is no search direction yet.
        let ones = &self.state.direction[0];
        self.gpu.submit(&[Step::Upload(Arc::new(vec![1.0; n]), ones.clone())]);
        let ones = vec![ones.clone(); self.state.direction.len()];
        for (i, o) in self.observations.iter().enumerate() {
            if let Some(moving) = &self.observed[i].moving {
                self.gpu.submit(&moving.forward(self, &ones, &self.state.predicted));
                let seen = gpu::read(self.gpu, &self.state.predicted[0], m)?;
                let inside: Vec<f32> = o.mask.data.iter().zip(&seen).map(|(&k, &s)| if (s - 1.0).abs() < 1e-3 { k } else { 0.0 }).collect();
                match &mut self.observed[i].kept {
                    Kept::Host(host) => host[3] = Arc::new(inside),
                    Kept::Device { mask, .. } => self.gpu.submit(&[Step::Upload(Arc::new(inside), mask.clone())]),
                }
            }
        }
        Ok(())
    }

    /// Pixels of the latent grid and of the frame.
    fn counts(&self) -> (usize, usize) {
        (self.latent.0 * self.latent.1, self.frame.0 * self.frame.1)
    }

    /// The channels that are solved together, one group after another. Given the weights they are independent: one after another takes
    /// less memory, and comes to the same.
    fn groups(&self) -> impl Iterator<Item = Range<usize>> + use<> {
        let together = self.memory.channels_together;
        (0..3).step_by(together).map(move |c| c..c + together)
    }

    fn moving(&self) -> impl Iterator<Item = &Moving> {
        self.observed.iter().filter_map(|o| o.moving.as_ref())
    }

    /// Channel `c` of frame `i` once [`Solver::predict`] has run for its group.
    fn source<'b>(&'b self, i: usize, c: usize) -> MisfitSource<'b> {
        let (o, observed, s) = (&self.observations[i], &self.observed[i], &self.state);
        let at = c % self.memory.channels_together;
        let moving = observed.moving.is_some();
        let (exposure, mask) = match &observed.kept {
            Kept::Device { exposure, mask } => (&exposure[c], mask),
            // Weights are made when there is neither a step nor a back-projection.
            Kept::Host(_) => (&s.solution[at], &s.back[0]),
        };
        MisfitSource {
            size: self.frame,
            predicted: if moving { &s.predicted[at] } else { &s.irradiance[c] },
            predicted_offset: if moving { 0 } else { self.pad },
            predicted_size: if moving { self.frame } else { self.latent },
            exposure,
            mask,
            exposure_time: o.exposure_time as f32,
            black_clipped: o.black_clipped,
            noise: &o.noise[c],
        }
    }

    /// Steps after which exposure, mask and prediction of some channels of frame `i` are on the device.
    fn predict(&self, i: usize, group: &Range<usize>) -> Vec<Step> {
        let s = &self.state;
        let mut steps = Vec::new();
        if let Kept::Host(host) = &self.observed[i].kept {
            steps.extend(group.clone().zip(&s.solution).map(|(c, to)| Step::Upload(host[c].clone(), to.clone())));
            steps.push(Step::Upload(host[3].clone(), s.back[0].clone()));
        }
        if let Some(moving) = &self.observed[i].moving {
            steps.extend(moving.forward(self, &s.irradiance[group.clone()], &s.predicted));
        }
        steps
    }

    /// Steps of the misfit of each pixel of frame `i`.
    fn misfit(&self, i: usize) -> Vec<Step> {
        let mut steps = Vec::new();
        for group in self.groups() {
            steps.extend(self.predict(i, &group));
            for c in group {
                steps.extend(self.kernels.data.misfit(self.gpu, &self.source(i, c), &self.state.misfit, c > 0));
            }
        }
        steps
    }

    /// Steps that make the misfit local.
    fn local(&self) -> Vec<Step> {
        self.kernels.data.local(self.gpu, &self.state.misfit, &self.state.misfit_scratch, self.frame)
    }

    /// Weights and weighted observations of all frames at the present estimate.
    fn weigh(&self, robust: f32) -> Vec<Step> {
        let (s, data) = (&self.state, &self.kernels.data);
        let mut steps = Vec::new();
        let mut first = true;
        for (i, observed) in self.observed.iter().enumerate() {
            let robust = match &observed.moving {
                None => 0.0,
                Some(moving) if moving.operator.still.is_some() => STILL_ROBUST * robust,
                Some(_) => robust,
            };
            if robust > 0.0 {
                steps.extend(self.misfit(i));
                steps.extend(self.local());
            } else {
                steps.extend([&s.misfit.sum, &s.misfit.counted].map(|b| Step::Clear(b.clone())));
            }
            for group in self.groups() {
                // That of the only group is there already, for the misfit.
                if robust == 0.0 || group.len() < 3 {
                    steps.extend(self.predict(i, &group));
                }
                for c in group {
                    let to = match &observed.moving {
                        None => WeightTarget {
                            weight: &s.weight[c],
                            observation: &s.observation[c],
                            offset: self.pad,
                            size: self.latent,
                            accumulate: !first,
                        },
                        Some(moving) => WeightTarget {
                            weight: &moving.weight[c],
                            observation: &moving.observation[c],
                            offset: 0,
                            size: self.frame,
                            accumulate: false,
                        },
                    };
                    steps.extend(data.weights(self.gpu, &self.source(i, c), &s.misfit, robust, &to));
                }
            }
            first &= observed.moving.is_some();
        }
        steps
    }

    /// Σ K^T W (B - K E) of some channels into `back`, their data terms into their scalars.
    fn residuals(&self, group: &Range<usize>, project_back: bool) -> Vec<Step> {
        let (s, data) = (&self.state, &self.kernels.data);
        let (n, m) = self.counts();
        let (in_place, displaced) = (partials_1d(self.gpu, n), partials_1d(self.gpu, m));
        let each = in_place + self.moving().count() * displaced;
        let mut steps = Vec::new();
        for (k, c) in group.clone().enumerate() {
            let (w, o) = (&s.weight[c], &s.observation[c]);
            steps.extend(data.residual(self.gpu, &s.irradiance[c], w, o, &s.back[k], &s.partials, k * each, n));
        }
        for (i, moving) in self.moving().enumerate() {
            steps.extend(moving.forward(self, &s.irradiance[group.clone()], &s.predicted));
            for (k, c) in group.clone().enumerate() {
                let (w, o, partial) = (&moving.weight[c], &moving.observation[c], k * each + in_place + i * displaced);
                // There is no search direction yet.
                steps.extend(data.residual(self.gpu, &s.predicted[k], w, o, &s.direction[k], &s.partials, partial, m));
            }
            if project_back {
                steps.extend(moving.adjoint(self, &s.direction, &s.back, 1.0));
            }
        }
        steps.push(self.kernels.linear.sum(self.gpu, &s.partials, &s.scalars, group.clone(), each, SLOT_DATA, false));
        steps
    }

    fn edges(&self) -> Vec<Step> {
        let (s, set, linear) = (&self.state, self.settings, &self.kernels.linear);
        let lambda = set.prior.smoothness(set.lambda);
        let mut steps = linear.edge_weight(self.gpu, &s.irradiance, &s.edge, &s.partials, lambda, set.epsilon, self.latent);
        let partials = partials_2d(self.gpu, self.latent);
        steps.push(linear.sum(self.gpu, &s.partials, &s.scalars, 0..1, partials, SLOT_SMOOTHNESS, false));
        steps
    }

    /// Steps of the diagonal of Σ Kᵀ W K of some channels, roughly; into `product`.
    fn diagonal(&self, group: &Range<usize>) -> Vec<Step> {
        let s = &self.state;
        let mut steps: Vec<Step> = group.clone().zip(&s.product).map(|(c, to)| Step::Copy(s.weight[c].clone(), to.clone())).collect();
        for moving in self.moving() {
            steps.extend(moving.adjoint(self, &moving.weight[group.clone()], &s.product, moving.operator.energy));
        }
        steps
    }

    /// Right-hand side, preconditioner and the start of the conjugate gradients of some channels.
    fn start(&self, group: &Range<usize>) -> Vec<Step> {
        let (s, linear) = (&self.state, &self.kernels.linear);
        let n = self.counts().0;
        let partials = partials_1d(self.gpu, n);
        let mut steps = self.diagonal(group);
        for (k, c) in group.clone().enumerate() {
            let (r, d) = (&s.residual[k], &s.diagonal[k]);
            steps.extend(linear.right_side(self.gpu, &s.irradiance[c], &s.back[k], &s.edge, &s.product[k], r, d, self.latent));
            steps.extend(linear.cg_start(self.gpu, r, d, &s.solution[c], &s.direction[k], &s.partials, k * partials, n));
        }
        steps.push(linear.sum(self.gpu, &s.partials, &s.scalars, group.clone(), partials, SLOT_ENERGY, true));
        steps
    }

    /// One iteration of the conjugate gradients of some channels.
    fn iteration(&self, group: &Range<usize>) -> Vec<Step> {
        let (s, linear) = (&self.state, &self.kernels.linear);
        let n = self.counts().0;
        let (flat, square) = (partials_1d(self.gpu, n), partials_2d(self.gpu, self.latent));
        let sum = |count, slot, shift| linear.sum(self.gpu, &s.partials, &s.scalars, group.clone(), count, slot, shift);
        let mut steps = Vec::new();
        for (k, c) in group.clone().enumerate() {
            // The product is written after the scaled direction was projected.
            steps.extend(linear.scale(self.gpu, &s.irradiance[c], &s.direction[k], &s.weight[c], &s.product[k], &s.back[k], n));
        }
        for moving in self.moving() {
            steps.extend(moving.curvature(self, group, &s.product, &s.predicted, &s.back));
        }
        for (k, c) in group.clone().enumerate() {
            let (e, b, p, q) = (&s.irradiance[c], &s.back[k], &s.direction[k], &s.product[k]);
            steps.extend(linear.normal(self.gpu, e, b, &s.edge, p, q, &s.partials, k * square, self.latent));
        }
        steps.push(sum(square, SLOT_CURVATURE, false));
        for (k, c) in group.clone().enumerate() {
            let (p, q, d, x, r) = (&s.direction[k], &s.product[k], &s.diagonal[k], &s.solution[c], &s.residual[k]);
            steps.extend(linear.cg_step(self.gpu, &s.scalars, c, p, q, d, x, r, &s.partials, k * flat, n));
        }
        steps.push(sum(flat, SLOT_ENERGY, true));
        for (k, c) in group.clone().enumerate() {
            steps.extend(linear.cg_direction(self.gpu, &s.scalars, c, &s.residual[k], &s.diagonal[k], &s.direction[k], n));
        }
        steps
    }

    fn scalars(&self) -> Result<Vec<f64>> {
        Ok(gpu::read(self.gpu, &self.state.scalars, SCALARS)?.into_iter().map(f64::from).collect())
    }

    /// ⟨r, z⟩ of each channel.
    fn energies(&self) -> Result<[f64; 3]> {
        Ok(each_channel(&self.scalars()?, SLOT_ENERGY))
    }

    fn objective(&self) -> Result<f64> {
        let scalars = self.scalars()?;
        Ok(each_channel(&scalars, SLOT_DATA).iter().sum::<f64>() + scalars[SLOT_SMOOTHNESS])
    }

    fn run(&self, progress: &mut dyn FnMut(f32) -> bool) -> Result<Solution> {
        let (s, set) = (&self.state, self.settings);
        let n = self.counts().0;
        let (weigh, trusting, edges) = (self.weigh(set.robust), self.weigh(0.0), self.edges());
        let systems: Vec<(Range<usize>, Vec<Step>, Vec<Step>)> =
            self.groups().map(|g| (g.clone(), [self.residuals(&g, true), self.start(&g)].concat(), self.iteration(&g))).collect();
        let evaluate: Vec<Step> = self.groups().flat_map(|g| self.residuals(&g, false)).chain(self.edges()).collect();
        let update = |step: f32| -> Vec<Step> {
            let one = |c: usize| self.kernels.linear.update(self.gpu, &s.old[c], &s.solution[c], &s.irradiance[c], step, DARKEST, n);
            (0..3).flat_map(one).collect()
        };
        let keep: Vec<Step> = s.irradiance.iter().zip(&s.old).map(|(from, to)| Step::Copy(from.clone(), to.clone())).collect();
        let mut history = Vec::new();
        let mut stop = Stop::IterationLimit;
        let mut settled = set.robust == 0.0 || set.settled == f64::INFINITY || self.sharp_frames_disagree(&trusting, &evaluate)?;
        for outer in 0..set.outer {
            if outer == 0 || set.reweight {
                self.gpu.submit(if settled { &weigh } else { &trusting });
            }
            self.gpu.submit(&edges);
            let (mut energy, mut left) = (0.0, 0.0);
            // The first channel decides, so that it does not matter how many are solved together.
            let mut inner = set.inner;
            for (number, (group, start, iteration)) in systems.iter().enumerate() {
                self.gpu.submit(start);
                let first = self.energies()?;
                let mut now = first;
                let mut i = 0;
                while i < inner {
                    self.gpu.submit(iteration);
                    i += 1;
                    // Waiting now and then keeps the queue short and the progress honest.
                    if i % 5 == 0 || i == inner {
                        now = self.energies()?;
                        let done = (number as f32 + i as f32 / inner as f32) / systems.len() as f32;
                        if !progress(ITERATING * (outer as f32 + done) / set.outer as f32) {
                            return Err(Error::Cancelled);
                        }
                        if number == 0 && now[0] <= set.reduction * first[0] {
                            inner = i;
                        }
                    }
                }
                energy += first[group.clone()].iter().sum::<f64>();
                left += now[group.clone()].iter().sum::<f64>();
            }
            let reduction = left / energy.max(f64::MIN_POSITIVE);
            let before = self.objective()?;
            self.gpu.submit(&keep);
            let mut step = 1.0f32;
            let mut after;
            loop {
                self.gpu.submit(&update(step));
                self.gpu.submit(&evaluate);
                after = self.objective()?;
                if after <= before || step == 0.0 {
                    break;
                }
                step = if step > 1e-3 { step * 0.5 } else { 0.0 };
            }
            history.push(Iteration { before, after, step, inner, reduction });
            if step == 0.0 {
                stop = Stop::Breakdown;
                break;
            }
            if settled && before - after < set.tolerance * before.abs() {
                stop = Stop::Converged;
                break;
            }
            settled |= before - after < set.settled * before.abs();
        }
        // How well the TSFs explain the frames is not for the prior to say.
        let (chi_squared, misfit) = self.judge()?;
        if set.prior == Prior::Collaborative {
            self.filter(&mut |f| progress(ITERATING + (1.0 - ITERATING) * f))?;
        }
        let irradiance = self.read(&s.irradiance)?;
        Ok(Solution { irradiance, pad: self.pad, misfit, report: SolveReport { stop, history, chi_squared, memory: self.memory } })
    }

    /// Whether all frames are sharp, and what they leave unexplained at the start, under the weights `trusting`, is far more than their noise and their pixels
    /// make; `evaluate`: steps of the objective.
    fn sharp_frames_disagree(&self, trusting: &[Step], evaluate: &[Step]) -> Result<bool> {
        if self.moving().count() == 0 || self.moving().any(|m| m.operator.still.is_none()) {
            return Ok(false);
        }
        self.gpu.submit(trusting);
        self.gpu.submit(evaluate);
        let data: f64 = each_channel(&self.scalars()?, SLOT_DATA).iter().sum();
        Ok(2.0 * data > DISAGREE * (3 * self.observed.len() * self.counts().1) as f64)
    }

    /// χ² of each frame at the present estimate, as a whole and locally.
    fn judge(&self) -> Result<(Vec<f64>, Vec<Plane>)> {
        let m = self.counts().1;
        let (mut chi_squared, mut misfit) = (Vec::new(), Vec::new());
        let read =
            || Ok::<_, Error>((gpu::read(self.gpu, &self.state.misfit.sum, m)?, gpu::read(self.gpu, &self.state.misfit.counted, m)?));
        for i in 0..self.observed.len() {
            self.gpu.submit(&self.misfit(i));
            let (sum, counted) = read()?;
            let total = |v: &[f32]| v.iter().map(|&v| f64::from(v)).sum::<f64>();
            let (chi, count) = (total(&sum), total(&counted));
            chi_squared.push(if count > 0.0 { chi / count } else { f64::NAN });
            self.gpu.submit(&self.local());
            let (sum, counted) = read()?;
            let local = sum.iter().zip(&counted).map(|(s, n)| if *n > 1e-3 { s / n } else { 0.0 }).collect();
            misfit.push(Plane::from_vec(self.frame.0, self.frame.1, local)?);
        }
        Ok((chi_squared, misfit))
    }
}
