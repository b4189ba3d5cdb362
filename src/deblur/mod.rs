//! Irradiance E from all frames and their TSFs: eq. (9)-(10) in log irradiance u, half-quadratic total variation, damped
//! Gauss-Newton steps solved by preconditioned conjugate gradients on the GPU. No image leaves the GPU inside the loop.
//!
//! Each outer iteration computes the data weights W of every frame at the present estimate (mask² over the noise variance of
//! the *predicted* exposure, less where a blurred frame's residuals exceed what noise explains), the edge weights
//! w = λ/√(Σ_c|∇u_c|² + ε²), and solves
//!
//! `[E Σ_i K_iᵀ W_i K_i E + Dᵀ w D] δu = E Σ_i K_iᵀ W_i (B_i - K_i E) - Dᵀ w D u`
//!
//! then tries E·(1 + s·δu) where δu > 0 and E·exp(s·δu) elsewhere (at most fourfold, at least 1/e) for s = 1, 1/2, 1/4, ... until
//! the objective `½ Σ W (B - K E)² + λ Σ √(|∇u|² + ε²)` (with these weights) does not rise. The data term is quadratic in E: with
//! the first form a bracket without a sharp frame needs half the outer iterations that exp(s·δu) in both directions needs.
//! λ is a pure number: the data term counts in units of the noise, u in natural logarithms. With [`Prior::Collaborative`] total variation
//! has a part of it only, and what noise that leaves is filtered from the result.
//!
//! Residuals far from the solution speak of the start and not of a frame's TSF, so the residual-driven weights begin once
//! an outer step lowers the objective by less than `settled` of it. The iteration stops when a step under these weights lowers
//! it by less than `tolerance` of it, or at `outer` steps.

mod memory;
mod prior;

pub use memory::Memory;
pub use prior::Prior;

use crate::error::{Error, Result};
use crate::gpu::{self, Gpu, Step};
use crate::image::{Plane, Rgb};
use crate::kernels::{
    Blur, Channels, Kernels, MisfitSource, SLOT_CURVATURE, SLOT_DATA, SLOT_ENERGY, SLOT_SMOOTHNESS, STILL, Scratch, ScratchSize,
    WeightTarget, channels, partials_1d, partials_2d,
};
use crate::tsf::{Interpolation, TapSet, Tsf};
use memory::{Need, Plan};
use serde::Serialize;
use std::sync::Arc;

/// One frame as the solver sees it.
pub struct Observation {
    /// Exposure f⁻¹(Z), 1 = white, three channels.
    pub exposure: Rgb,
    /// Mask of eq. (8), 0..=1, the same for all channels; 0 where any channel is clipped.
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
    /// Conjugate-gradient iterations of each outer one.
    pub inner: usize,
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
            tolerance: 5e-3,
            robust: 1.0,
            settled: 0.3,
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
        self.irradiance.map_planes(|p| p.crop(self.pad, self.pad, w - 2 * self.pad, h - 2 * self.pad))
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
/// Part of the time that the iteration takes.
const ITERATING: f32 = 0.95;
/// Displacement in pixels from which a frame counts as displaced rather than shaken.
const DISPLACED: f64 = 4.0;

/// K of a frame that is not in place.
struct Operator {
    blur: Blur,
    interpolation: Interpolation,
    still: bool,
    energy: f32,
    /// (x, y, weight) near the frame's centre.
    psf: Vec<(f64, f64, f64)>,
}

struct Moving {
    operator: Operator,
    weight: Channels,
    observation: Channels,
}

impl Moving {
    /// Steps of `frame = K latent`.
    fn forward(&self, solver: &Solver, latent: &Channels, frame: &Channels) -> Vec<Step> {
        let compiled = solver.kernels.blur(solver.gpu, self.operator.interpolation);
        self.operator.blur.forward(solver.gpu, compiled, &solver.state.scratch, latent, frame)
    }

    /// Steps of `latent += factor Kᵀ frame`.
    fn adjoint(&self, solver: &Solver, frame: &Channels, latent: &Channels, factor: f32) -> Vec<Step> {
        let compiled = solver.kernels.blur(solver.gpu, self.operator.interpolation);
        self.operator.blur.adjoint(solver.gpu, compiled, &solver.state.scratch, frame, latent, factor)
    }
}

struct Observed {
    exposure: Channels,
    mask: wgpu::Buffer,
    misfit: wgpu::Buffer,
    moving: Option<Moving>,
    /// Exposure and mask, when their buffers are shared and have to be filled before use.
    host: Option<[Arc<Vec<f32>>; 4]>,
}

impl Observed {
    /// Steps after which exposure and mask are on the device.
    fn uploads(&self) -> Vec<Step> {
        let to = self.exposure.iter().chain(std::iter::once(&self.mask));
        self.host.iter().flatten().zip(to).map(|(values, buffer)| Step::Upload(values.clone(), buffer.clone())).collect()
    }
}

struct State {
    irradiance: Channels,
    log: Channels,
    old: Channels,
    solution: Channels,
    residual: Channels,
    direction: Channels,
    product: Channels,
    scaled: Channels,
    back: Channels,
    diagonal: Channels,
    data_diagonal: Channels,
    weight: Channels,
    observation: Channels,
    edge: wgpu::Buffer,
    predicted: Channels,
    frame: Channels,
    misfit_scratch: wgpu::Buffer,
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

fn upload_rgb(gpu: &Gpu, label: &str, image: &Rgb) -> Result<Channels> {
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
    watch: &mut dyn FnMut(&Channels),
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
        let frame = (latent.0 - 2 * pad, latent.1 - 2 * pad);
        let (n, m) = (latent.0 * latent.1, frame.0 * frame.1);
        let blurs: Vec<Option<Operator>> = observations
            .iter()
            .map(|o| {
                (!o.tsf.is_identity()).then(|| {
                    let still = o.tsf.single().is_some();
                    let interpolation = if still { STILL } else { settings.interpolation };
                    let taps = TapSet::new(&o.tsf, frame.0, frame.1, interpolation);
                    let blur = Blur::new(gpu, kernels.blur(gpu, interpolation), &taps, frame, pad);
                    Operator { blur, interpolation, still, energy: taps.energy() as f32, psf: taps.psf() }
                })
            })
            .collect();
        let shaken = blurs.iter().flatten().count();
        if n.max(2 * m) > gpu.max_binding() {
            return Err(Error::Adapter(format!(
                "frames of {} x {} pixels: {} allows {} MiB per binding, less than they need; reduce them with --scale, or use another adapter",
                frame.0,
                frame.1,
                gpu.description,
                gpu.max_binding() >> 18
            )));
        }
        let scratch =
            |size: fn(&Blur) -> ScratchSize| blurs.iter().flatten().map(|b| size(&b.blur)).fold(ScratchSize::default(), ScratchSize::max);
        let (wanted, needed) = (scratch(Blur::scratch_wanted), scratch(Blur::scratch_needed));
        // All bases at once while they are small (fewer dispatches), one 128 MiB binding at most.
        let most = (1 << 25).min(gpu.max_binding());
        let partials = 3 * (observations.len() + 1) * partials_1d(n).max(partials_2d(latent));
        let need = Need {
            latent: n,
            frame: m,
            frames: observations.len(),
            shaken,
            partials,
            scratch_wanted: wanted.min(ScratchSize { planes: most, copy: most }.max(needed)),
            scratch_needed: needed,
        };
        let Plan { memory, scratch } = need.plan(limit)?;
        let scratch = Scratch::new(gpu, scratch)?;
        let log = initial.map_planes(|p| p.map(|v| v.max(f32::MIN_POSITIVE).ln()));
        let ch = |label, count| channels(gpu, label, count);
        // Vectors that are never alive together share a buffer: see the order of the steps in `run`.
        let (residual, scaled) = (ch("residual of the step", n)?, ch("scaled direction, product", n)?);
        let (solution, direction, back) = (ch("step", n)?, ch("search direction", n)?, ch("back-projection", n)?);
        let any_moving = shaken > 0;
        let state = State {
            irradiance: upload_rgb(gpu, "irradiance", &initial.map_planes(|p| p.map(|v| v.max(f32::MIN_POSITIVE))))?,
            log: upload_rgb(gpu, "log irradiance", &log)?,
            // The log irradiance before the step is kept when the residual of the step is no longer needed.
            old: residual.clone(),
            solution,
            residual,
            // The product is written after the scaled direction was projected, the data diagonal read before there is one.
            product: scaled.clone(),
            data_diagonal: scaled.clone(),
            scaled,
            back,
            diagonal: ch("preconditioner", n)?,
            weight: ch("weights of sharp frames", n)?,
            observation: ch("observations of sharp frames", n)?,
            edge: gpu.plane("edge weights", n)?,
            predicted: ch("prediction", if any_moving { m } else { 1 })?,
            // Residuals of frames are back-projected before there is a search direction.
            frame: direction.clone(),
            direction,
            misfit_scratch: gpu.plane("misfit", 2 * m)?,
            partials: gpu.plane("partial sums", partials)?,
            scalars: gpu.plane("scalars", 8)?,
            scratch,
        };
        let misfit = gpu.plane("misfit", 2 * m)?;
        let mut observed = Vec::new();
        for (i, (o, blur)) in observations.iter().zip(blurs).enumerate() {
            let moving = match blur {
                None => None,
                Some(operator) => Some(Moving { operator, weight: ch("weights", m)?, observation: ch("observations", m)? }),
            };
            let misfit = misfit.clone();
            if memory.streamed {
                // Weights are made when there is neither a step nor a back-projection.
                let planes = o.exposure.0.iter().chain(std::iter::once(&o.mask));
                let mut host = planes.map(|p| gpu::finite(&format!("frame {}", i + 1), &p.data).map(|()| Arc::new(p.data.clone())));
                let mut next = || host.next().expect("four planes");
                let host = Some([next()?, next()?, next()?, next()?]);
                observed.push(Observed { exposure: state.solution.clone(), mask: state.back[0].clone(), misfit, moving, host });
            } else {
                let (exposure, mask) = (upload_rgb(gpu, "exposure", &o.exposure)?, gpu.upload("mask", &o.mask.data)?);
                observed.push(Observed { exposure, mask, misfit, moving, host: None });
            }
        }
        let mut solver = Self { gpu, kernels, settings, observations, observed, state, frame, latent, pad, memory };
        solver.mask_beyond()?;
        Ok(solver)
    }

    /// Takes the pixels of blurred frames out of the masks that see beyond the latent grid: K of ones is less than 1 there.
    fn mask_beyond(&mut self) -> Result<()> {
        let (n, m) = (self.latent.0 * self.latent.1, self.frame.0 * self.frame.1);
        // There is no search direction yet.
        let ones: Channels = std::array::from_fn(|_| self.state.direction[0].clone());
        self.gpu.submit(&[Step::Upload(Arc::new(vec![1.0; n]), ones[0].clone())]);
        for (i, o) in self.observations.iter().enumerate() {
            if let Some(moving) = &self.observed[i].moving {
                self.gpu.submit(&moving.forward(self, &ones, &self.state.predicted));
                let seen = gpu::read(self.gpu, &self.state.predicted[0], m)?;
                let mask: Vec<f32> = o.mask.data.iter().zip(&seen).map(|(&k, &s)| if (s - 1.0).abs() < 1e-3 { k } else { 0.0 }).collect();
                match &mut self.observed[i].host {
                    Some(host) => host[3] = Arc::new(mask),
                    None => self.gpu.submit(&[Step::Upload(Arc::new(mask), self.observed[i].mask.clone())]),
                }
            }
        }
        Ok(())
    }

    fn source<'b>(&'b self, i: usize) -> MisfitSource<'b> {
        let (o, observed) = (&self.observations[i], &self.observed[i]);
        let moving = observed.moving.is_some();
        MisfitSource {
            size: self.frame,
            predicted: if moving { &self.state.predicted } else { &self.state.irradiance },
            predicted_offset: if moving { 0 } else { self.pad },
            predicted_stride: if moving { self.frame.0 } else { self.latent.0 },
            exposure: &observed.exposure,
            mask: &observed.mask,
            exposure_time: o.exposure_time as f32,
            black_clipped: o.black_clipped,
            noise: &o.noise,
        }
    }

    /// Weights and weighted observations of all frames at the present estimate.
    fn weigh(&self, robust: f32) -> Vec<Step> {
        let (s, data) = (&self.state, &self.kernels.data);
        let mut steps = Vec::new();
        let mut first = true;
        for (i, observed) in self.observed.iter().enumerate() {
            steps.extend(observed.uploads());
            match &observed.moving {
                None => {
                    steps.push(Step::Clear(observed.misfit.clone()));
                    let to = WeightTarget {
                        weight: &s.weight,
                        observation: &s.observation,
                        offset: self.pad,
                        stride: self.latent.0,
                        accumulate: !first,
                    };
                    steps.extend(data.weights(self.gpu, &self.source(i), &observed.misfit, 0.0, &to));
                    first = false;
                }
                Some(moving) => {
                    steps.extend(moving.forward(self, &s.irradiance, &s.predicted));
                    steps.extend(data.misfit(self.gpu, &self.source(i), &observed.misfit, &s.misfit_scratch));
                    let to = WeightTarget {
                        weight: &moving.weight,
                        observation: &moving.observation,
                        offset: 0,
                        stride: self.frame.0,
                        accumulate: false,
                    };
                    let robust = if moving.operator.still { STILL_ROBUST * robust } else { robust };
                    steps.extend(data.weights(self.gpu, &self.source(i), &observed.misfit, robust, &to));
                }
            }
        }
        steps
    }

    /// Σ K^T W (B - K E) into `back`, the data term into its scalar.
    fn residuals(&self, project_back: bool) -> Vec<Step> {
        let (s, k) = (&self.state, self.kernels);
        let (n, m) = (self.latent.0 * self.latent.1, self.frame.0 * self.frame.1);
        let mut steps = Vec::new();
        let mut partial = 0;
        for c in 0..3 {
            steps.push(k.data.residual(self.gpu, &s.irradiance[c], &s.weight[c], &s.observation[c], &s.back[c], &s.partials, partial, n));
            partial += partials_1d(n);
        }
        for moving in self.observed.iter().filter_map(|o| o.moving.as_ref()) {
            steps.extend(moving.forward(self, &s.irradiance, &s.predicted));
            for c in 0..3 {
                let (w, o) = (&moving.weight[c], &moving.observation[c]);
                steps.push(k.data.residual(self.gpu, &s.predicted[c], w, o, &s.frame[c], &s.partials, partial, m));
                partial += partials_1d(m);
            }
            if project_back {
                steps.extend(moving.adjoint(self, &s.frame, &s.back, 1.0));
            }
        }
        steps.push(k.linear.sum(self.gpu, &s.partials, &s.scalars, partial, SLOT_DATA, false));
        steps
    }

    fn edges(&self) -> Vec<Step> {
        let (s, set) = (&self.state, self.settings);
        let linear = &self.kernels.linear;
        vec![
            linear.edge_weight(self.gpu, &s.log, &s.edge, &s.partials, set.prior.smoothness(set.lambda), set.epsilon, self.latent),
            linear.sum(self.gpu, &s.partials, &s.scalars, partials_2d(self.latent), SLOT_SMOOTHNESS, false),
        ]
    }

    /// Steps of the diagonal of Σ Kᵀ W K, roughly, over the frames in place and those that `counts` holds for.
    fn diagonal(&self, counts: fn(&Moving) -> bool) -> Vec<Step> {
        let s = &self.state;
        let mut steps: Vec<Step> = (0..3).map(|c| Step::Copy(s.weight[c].clone(), s.data_diagonal[c].clone())).collect();
        for moving in self.observed.iter().filter_map(|o| o.moving.as_ref()).filter(|m| counts(m)) {
            steps.extend(moving.adjoint(self, &moving.weight, &s.data_diagonal, moving.operator.energy));
        }
        steps
    }

    /// Right-hand side, preconditioner and the start of the conjugate gradients.
    fn start(&self) -> Vec<Step> {
        let (s, k) = (&self.state, self.kernels);
        let n = self.latent.0 * self.latent.1;
        let mut steps = self.diagonal(|_| true);
        for c in 0..3 {
            steps.push(k.linear.right_side(
                self.gpu,
                &s.irradiance[c],
                &s.back[c],
                &s.edge,
                &s.log[c],
                &s.data_diagonal[c],
                &s.residual[c],
                &s.diagonal[c],
                self.latent,
            ));
            let partial = c * partials_1d(n);
            steps.push(k.linear.cg_start(
                self.gpu,
                &s.residual[c],
                &s.diagonal[c],
                &s.solution[c],
                &s.direction[c],
                &s.partials,
                partial,
                n,
            ));
        }
        steps.push(k.linear.sum(self.gpu, &s.partials, &s.scalars, 3 * partials_1d(n), SLOT_ENERGY, true));
        steps
    }

    /// One iteration of the conjugate gradients.
    fn iteration(&self) -> Vec<Step> {
        let (s, k) = (&self.state, self.kernels);
        let n = self.latent.0 * self.latent.1;
        let mut steps = Vec::new();
        for c in 0..3 {
            steps.push(k.linear.scale(self.gpu, &s.irradiance[c], &s.direction[c], &s.weight[c], &s.scaled[c], &s.back[c], n));
        }
        for moving in self.observed.iter().filter_map(|o| o.moving.as_ref()) {
            steps.extend(moving.forward(self, &s.scaled, &s.predicted));
            for c in 0..3 {
                steps.push(k.linear.multiply(self.gpu, &moving.weight[c], &s.predicted[c], self.frame.0 * self.frame.1));
            }
            steps.extend(moving.adjoint(self, &s.predicted, &s.back, 1.0));
        }
        for c in 0..3 {
            let partial = c * partials_2d(self.latent);
            steps.push(k.linear.normal(
                self.gpu,
                &s.irradiance[c],
                &s.back[c],
                &s.edge,
                &s.direction[c],
                &s.product[c],
                &s.partials,
                partial,
                self.latent,
            ));
        }
        steps.push(k.linear.sum(self.gpu, &s.partials, &s.scalars, 3 * partials_2d(self.latent), SLOT_CURVATURE, false));
        for c in 0..3 {
            steps.push(k.linear.cg_step(
                self.gpu,
                &s.scalars,
                &s.direction[c],
                &s.product[c],
                &s.diagonal[c],
                &s.solution[c],
                &s.residual[c],
                &s.partials,
                c * partials_1d(n),
                n,
            ));
        }
        steps.push(k.linear.sum(self.gpu, &s.partials, &s.scalars, 3 * partials_1d(n), SLOT_ENERGY, true));
        for c in 0..3 {
            steps.push(k.linear.cg_direction(self.gpu, &s.scalars, &s.residual[c], &s.diagonal[c], &s.direction[c], n));
        }
        steps
    }

    fn scalar(&self, slot: u32) -> Result<f64> {
        Ok(f64::from(gpu::read(self.gpu, &self.state.scalars, 8)?[slot as usize]))
    }

    fn objective(&self) -> Result<f64> {
        let s = gpu::read(self.gpu, &self.state.scalars, 8)?;
        Ok(f64::from(s[SLOT_DATA as usize]) + f64::from(s[SLOT_SMOOTHNESS as usize]))
    }

    fn run(&self, progress: &mut dyn FnMut(f32) -> bool) -> Result<Solution> {
        let (s, set) = (&self.state, self.settings);
        let n = self.latent.0 * self.latent.1;
        let (weigh, residuals, edges, start, iteration) =
            (self.weigh(set.robust), self.residuals(true), self.edges(), self.start(), self.iteration());
        let trusting = self.weigh(0.0);
        let evaluate = [self.residuals(false), self.edges()].concat();
        let update = |step: f32| -> Vec<Step> {
            (0..3).map(|c| self.kernels.linear.update(self.gpu, &s.old[c], &s.solution[c], &s.log[c], &s.irradiance[c], step, n)).collect()
        };
        let keep: Vec<Step> = (0..3).map(|c| Step::Copy(s.log[c].clone(), s.old[c].clone())).collect();
        let mut history = Vec::new();
        let mut stop = Stop::IterationLimit;
        let mut settled = set.robust == 0.0 || set.settled == f64::INFINITY;
        for outer in 0..set.outer {
            if outer == 0 || set.reweight {
                self.gpu.submit(if settled { &weigh } else { &trusting });
            }
            self.gpu.submit(&residuals);
            self.gpu.submit(&edges);
            self.gpu.submit(&start);
            let before = self.objective()?;
            let energy = self.scalar(SLOT_ENERGY)?;
            for i in 0..set.inner {
                self.gpu.submit(&iteration);
                // Waiting now and then keeps the queue short and the progress honest; the last one waits below anyway.
                if i % 5 == 4 || i + 1 == set.inner {
                    self.scalar(SLOT_ENERGY)?;
                    if !progress(ITERATING * (outer as f32 + (i + 1) as f32 / set.inner as f32) / set.outer as f32) {
                        return Err(Error::Cancelled);
                    }
                }
            }
            let reduction = self.scalar(SLOT_ENERGY)? / energy.max(f64::MIN_POSITIVE);
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
            history.push(Iteration { before, after, step, reduction });
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

    /// χ² of each frame at the present estimate, as a whole and locally.
    fn judge(&self) -> Result<(Vec<f64>, Vec<Plane>)> {
        let (s, m) = (&self.state, self.frame.0 * self.frame.1);
        let (mut chi_squared, mut misfit) = (Vec::new(), Vec::new());
        for (i, observed) in self.observed.iter().enumerate() {
            if let Some(moving) = &observed.moving {
                self.gpu.submit(&moving.forward(self, &s.irradiance, &s.predicted));
            }
            self.gpu.submit(&observed.uploads());
            let steps = self.kernels.data.misfit(self.gpu, &self.source(i), &observed.misfit, &s.misfit_scratch);
            self.gpu.submit(&steps[..1]);
            let pairs = gpu::read(self.gpu, &observed.misfit, 2 * m)?;
            let (chi, count) = pairs.chunks_exact(2).fold((0.0, 0.0), |(a, b), p| (a + f64::from(p[0]), b + f64::from(p[1])));
            chi_squared.push(if count > 0.0 { chi / count } else { f64::NAN });
            self.gpu.submit(&steps[1..]);
            let pairs = gpu::read(self.gpu, &observed.misfit, 2 * m)?;
            let local = pairs.chunks_exact(2).map(|p| if p[1] > 1e-3 { p[0] / p[1] } else { 0.0 }).collect();
            misfit.push(Plane::from_vec(self.frame.0, self.frame.1, local)?);
        }
        Ok((chi_squared, misfit))
    }
}
