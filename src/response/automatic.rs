//! The response from the bracket that is to be merged, blurred frames included, and whether its exposure times can be true.

use super::Response;
use super::calibrate::make_monotone;
use super::displacement::displacements;
use super::posterior::{Curve, posterior};
use super::prior::{CurvePrior, basis};
use super::shades::{self, Motion, Shade};
use crate::error::{Error, Result};
use crate::exposure::{Bracket, Frame};
use crate::image::Rgb;
use crate::noise::{self, FrameNoise};
use nalgebra::{Cholesky, DMatrix, DVector};
use rayon::prelude::*;

/// A response estimated from the frames that it is to serve.
#[derive(Clone, Debug)]
pub struct Automatic {
    /// The curve.
    pub response: Response,
    /// How it was found, in words: which curve, from how many shades.
    pub method: String,
    /// Why it is less than a full curve, in words; `None` when it is one.
    pub poor: Option<String>,
    /// Standard deviation of the exposure at half of white's code, EV.
    pub deviation_ev: f64,
}

/// A response measured from frames that show one scene without motion or blur.
#[derive(Clone, Debug)]
pub struct OfStillFrames {
    /// The curve.
    pub response: Response,
    /// How it was found, in words.
    pub method: String,
    /// Why it is less than a full curve, in words; `None` when it is one.
    pub poor: Option<String>,
    /// What the pixels say of the exposure times.
    pub exposures: ExposureCheck,
}

/// Exposure times as the pixels have them beside those that were given.
#[derive(Clone, Debug, PartialEq)]
pub struct ExposureCheck {
    /// Per frame: by how many EV (factors of two) the pixels' exposure time is longer than the given one. `None` where no frame
    /// shares enough shades with it.
    pub difference_ev: Vec<Option<f64>>,
    /// Standard deviation of each difference, EV: jackknife over the quarters of the frame.
    pub deviation_ev: Vec<f64>,
    /// Whether the curve was known beforehand. Where it was not, times that are all wrong by one power are not seen.
    pub curve_known: bool,
}

/// A difference of exposure times is spoken of from here: 0.15 EV (11 %). Cameras' nominal times (1/30 for 1/32) are off by up to
/// 0.1 EV, which a merge hardly feels.
pub const DISAGREEMENT_EV: f64 = 0.15;
/// The same where the curve is given: one that was measured on other pictures bends by so much at its dark end that the times of
/// correct brackets seem off by up to 0.32 EV.
pub const DISAGREEMENT_OF_KNOWN_CURVE_EV: f64 = 0.4;
/// And only when it is that many of its standard deviations.
const SIGNIFICANT: f64 = 4.0;
/// Fewer shades that two frames of different exposure time share do not tell even an exponent.
const FEWEST: usize = 12;
/// From so many on a curve is tried, not only an exponent.
const ENOUGH_FOR_CURVE: usize = 120;
/// Highest power of the intensity in ln f⁻¹.
const MOST_POWERS: usize = 5;
/// A curve with more unknowns, or three curves instead of one, must lower the held-out residual by this part.
const WORTH_IT: f64 = 0.02;
/// Prior of the unknowns of ln f⁻¹: exponent 2.2 ± 2, coefficients 0 ± 4. Only directions that no shade determines feel it.
const PRIOR: (f64, f64, f64) = (2.2, 2.0, 4.0);
/// Smallest standard deviation of ln f⁻¹ of a shade: what lens and light change from frame to frame.
const FLOOR: f64 = 0.01;
/// By how much more likely a camera's curve has to be, natural logarithm of the density, for a bracket's files to be taken to note exposures that are off by far.
const OTHERWISE: f64 = 4.0;
/// Reweighting rounds against what moves.
const ROUNDS: usize = 6;
/// Standard deviation of the prior of ln Δt while exposure times are free: three EV.
const FREE: f64 = 2.0;
/// The one that holds them.
const HELD: f64 = 1e-5;

/// The response that the frames of `bracket` themselves show, blurred and shifted by a few pixels or not.
///
/// Blur and small shifts do not change the mean exposure of a block of pixels (1/45 of the frame's longer side, at least 8 px) whose neighbours
/// are as bright. Block means z of all frames obey ln f⁻¹(z) = ln E + ln Δt, and with
///
/// ln f⁻¹(z) = s ln sRGB⁻¹(z) + a ln z + Σ_k c_k (z^k − 1), k = 1..=5
///
/// that is linear in the unknowns. One curve serves all channels; its prior is that of cameras' curves, exposures and white balance may differ from
/// what the files note by what cameras' do, with a heavy tail. A curve to a power with all exposure ratios to the same power explains
/// the frames as well (M. Grossberg and S. Nayar, "Determining the Camera Response from Images: What Is Knowable?", PAMI 2003): the priors decide. Where
/// the frames tell nothing the prior's curve stands, and [`Automatic::deviation_ev`] says how wide it is.
pub fn automatic(bracket: &Bracket) -> Automatic {
    let frames = bracket.frames();
    let times: Vec<f64> = frames.iter().map(|f| f.exposure_time.ln()).collect();
    let motion = Motion::Shaken(displacements(frames));
    let prior = CurvePrior::of_cameras();
    let mut curve = prior.middle();
    let mut chosen = None;
    // Means of exposures need the curve: begin with the prior's, then with the curve itself.
    for _ in 0..2 {
        let shades = shades::collect(frames, &motion, &|c, z| curve.inverse(c, z));
        let telling = shades.iter().filter(|s| tells_ratio(s, &times)).count();
        let noise = noise_under(frames, &curve);
        // As the files note the exposures, and as the pixels have them under the curve as it is known: a file that notes something else bends the curve in vain.
        let free = posterior(&shades, &times, &noise, &Curve::Known(&curve), None).map(|p| p.exposures);
        let starts = [(None, 0.0), (free.as_deref(), OTHERWISE)];
        let found = starts.into_iter().filter_map(|(start, more)| {
            let found = posterior(&shades, &times, &noise, &Curve::Unknown(&prior), start)?;
            Some((found.unlikely + more, found))
        });
        if let Some((_, found)) = found.min_by(|a, b| a.0.total_cmp(&b.0)) {
            curve = super::prior::response(&found.coefficients);
            chosen = Some((found.deviation, telling));
        }
    }
    let (deviation, telling) = chosen.unwrap_or((f64::INFINITY, 0));
    let deviation_ev = deviation / std::f64::consts::LN_2;
    let method = format!("one curve for all channels under the prior of cameras' curves, from {telling} block means");
    let poor = (telling < FEWEST).then(|| {
        format!(
            "{}: only {telling} blocks are well exposed in two frames of different exposure time: the curve is that of an average camera, its middle \
             known to {deviation_ev:.1} EV",
            frames[0].name
        )
    });
    Automatic { response: curve, method, poor, deviation_ev }
}

/// Each frame's noise under the curve `response`.
fn noise_under(frames: &[Frame], response: &Response) -> Vec<FrameNoise> {
    let exposures: Vec<Rgb> = frames.iter().map(|f| noise::exposure(f, response)).collect();
    noise::estimate(frames, &exposures, response)
}

/// By how many EV each frame of `bracket` was exposed more than its time says, and the standard deviation of that, as its pixels have it under a `response`
/// that is known: aperture and ISO speed that changed, gain that a file does not note. Small next to the deviation where frames share too few shades.
/// `noise`: each frame's under that response.
pub fn exposure_errors(bracket: &Bracket, response: &Response, noise: &[FrameNoise]) -> Vec<(f64, f64)> {
    let frames = bracket.frames();
    let times: Vec<f64> = frames.iter().map(|f| f.exposure_time.ln()).collect();
    let shades = shades::collect(frames, &Motion::Shaken(displacements(frames)), &|c, z| response.inverse(c, z));
    let ev = |v: &f64| v / std::f64::consts::LN_2;
    match posterior(&shades, &times, noise, &Curve::Known(response), None) {
        Some(found) => found.exposures.iter().map(ev).zip(found.deviations.iter().map(ev)).collect(),
        None => vec![(0.0, f64::INFINITY); frames.len()],
    }
}

/// The same from frames that show one scene without motion or blur, as a tripod gives them. Blocks down to 4 px count, beside clipped ones and beside
/// edges as well: there are more shades, and nearer to white. What is not a power law in the deepest shadows (sRGB below code 20) is not seen.
///
/// # Errors
/// [`Error::Bracket`] when fewer than 12 blocks are well exposed in two frames of different exposure time, or no exponent from 0.4 to 6 explains
/// them.
pub fn of_still_frames(bracket: &Bracket) -> Result<OfStillFrames> {
    let motion = &Motion::None;
    let frames = bracket.frames();
    let times: Vec<f64> = frames.iter().map(|f| f.exposure_time.ln()).collect();
    let refuse = |why: String| {
        Error::Bracket(format!(
            "{}: the response cannot be estimated from these frames ({why}); give --response FILE.json from 'unshaken calibrate', or srgb",
            frames[0].name
        ))
    };
    let mut curves = Curves::gamma(2.2);
    let mut chosen = None;
    // Means of exposures need the curve: begin with a gamma, then with the curve itself.
    for _ in 0..2 {
        let shades = shades::collect(frames, motion, &|c, z| curves.inverse(c, z));
        let telling = shades.iter().filter(|s| tells_ratio(s, &times)).count();
        if telling < FEWEST {
            return Err(refuse(format!("only {telling} of their blocks are well exposed in two frames of different exposure time")));
        }
        let problem = Problem { shades: &shades, times: &times, held: true };
        let shape = if telling < ENOUGH_FOR_CURVE { Shape { powers: 0, shared: true } } else { problem.choose() };
        let fit = problem.believable(shape).ok_or_else(|| refuse("no curve that a camera could have explains them".into()))?;
        curves = fit.curves.clone();
        chosen = Some((fit, telling));
    }
    let (fit, telling) = chosen.expect("two rounds ran");
    let shades = shades::collect(frames, motion, &|c, z| curves.inverse(c, z));
    let exposures = Problem { shades: &shades, times: &times, held: false }.check(fit.curves.shape, None);
    // With times that are wrong, the curve that held to them is wrong too.
    let fit = if exposures.suspects().is_empty() {
        fit
    } else {
        Problem { shades: &shades, times: &times, held: false }.believable(fit.curves.shape).unwrap_or(fit)
    };
    let shape = fit.curves.shape;
    let method = match (shape.powers, shape.shared) {
        (0, true) => format!("gamma {:.2} for all channels, from {telling} block means", fit.curves.coefficients[0][0]),
        (0, false) => format!("one gamma per channel, from {telling} block means"),
        (k, shared) => format!(
            "power law times exp of a polynomial of degree {k}, {}, from {telling} block means",
            if shared { "one curve for all channels" } else { "one curve per channel" }
        ),
    };
    let poor = (telling < ENOUGH_FOR_CURVE).then(|| {
        format!(
            "only {telling} blocks are well exposed in two frames: the response is taken as a gamma of {:.2}",
            fit.curves.coefficients[0][0]
        )
    });
    Ok(OfStillFrames { response: fit.curves.response(), method, poor, exposures })
}

/// Compares the exposure times of `bracket` with its pixels under a `response` that is known.
pub fn check_exposures(bracket: &Bracket, response: &Response) -> ExposureCheck {
    let frames = bracket.frames();
    let times: Vec<f64> = frames.iter().map(|f| f.exposure_time.ln()).collect();
    let shades = shades::collect(frames, &Motion::Shaken(displacements(frames)), &|c, z| response.inverse(c, z));
    Problem { shades: &shades, times: &times, held: false }.check(Shape { powers: 0, shared: true }, Some(response))
}

impl ExposureCheck {
    /// Frames (0-based) whose exposure time the pixels contradict: by at least [`DISAGREEMENT_EV`] ([`DISAGREEMENT_OF_KNOWN_CURVE_EV`]) and four standard deviations.
    pub fn suspects(&self) -> Vec<usize> {
        let least = if self.curve_known { DISAGREEMENT_OF_KNOWN_CURVE_EV } else { DISAGREEMENT_EV };
        (0..self.difference_ev.len())
            .filter(|&i| self.difference_ev[i].is_some_and(|d| d.abs() >= least && d.abs() >= SIGNIFICANT * self.deviation_ev[i]))
            .collect()
    }

    /// What to tell the user about the frames of `bracket`; `None` when pixels and times agree.
    pub fn warning(&self, bracket: &Bracket) -> Option<String> {
        let suspects = self.suspects();
        if suspects.is_empty() {
            return None;
        }
        let frames = bracket.frames();
        let each: Vec<String> = suspects
            .iter()
            .map(|&i| {
                let d = self.difference_ev[i].unwrap_or(0.0);
                let t = frames[i].exposure_time;
                format!("{} {d:+.2} EV ({t:.4} s given, {:.4} s by its pixels)", frames[i].name, t * d.exp2())
            })
            .collect();
        let all: Vec<String> =
            frames.iter().zip(&self.difference_ev).map(|(f, d)| format!("{:.4}", f.exposure_time * d.unwrap_or(0.0).exp2())).collect();
        let other = if self.curve_known { ", or the response is not this camera's" } else { "" };
        Some(format!(
            "exposure times and pixels disagree: {}; the times are wrong, aperture or ISO changed between the frames{other} (pixels' times: --exposures {})",
            each.join(", "),
            all.join(",")
        ))
    }
}

/// Which curves are allowed.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shape {
    powers: usize,
    shared: bool,
}

/// ln f⁻¹ of the three channels.
#[derive(Clone, Debug)]
struct Curves {
    shape: Shape,
    coefficients: [Vec<f64>; 3],
}

impl Curves {
    fn gamma(exponent: f64) -> Self {
        Self { shape: Shape { powers: 0, shared: true }, coefficients: std::array::from_fn(|_| vec![exponent]) }
    }

    /// ln f⁻¹.
    fn log(&self, channel: usize, z: f64) -> f64 {
        basis(z, self.shape.powers).iter().zip(&self.coefficients[channel]).map(|(b, c)| b * c).sum()
    }

    fn inverse(&self, channel: usize, z: f64) -> f64 {
        if z <= 0.0 { 0.0 } else { self.log(channel, z).exp() }
    }

    fn slope(&self, channel: usize, z: f64) -> f64 {
        let c = &self.coefficients[channel];
        c[0] / z + c[1..].iter().enumerate().map(|(k, c)| c * (k + 1) as f64 * z.powi(k as i32)).sum::<f64>()
    }

    fn response(&self) -> Response {
        Response::Table(std::array::from_fn(|c| {
            let mut g: Vec<f64> = (0..256).map(|z| self.log(c, f64::from(z.max(1)) / 255.0)).collect();
            make_monotone(&mut g[1..]);
            let white = g[255];
            let mut x: Vec<f64> = g.iter().map(|v| (v - white).exp()).collect();
            x[0] = 0.0;
            x
        }))
    }

    /// Whether a camera could have them: rising everywhere, and at mid-grey as steep as between an exponent of 0.4 and one of 6.
    fn believable(&self) -> bool {
        (0..3).all(|c| {
            let middle = self.log(c, 0.5) / 0.5f64.ln();
            let rises = (4..=255).all(|k| self.slope(c, f64::from(k) / 255.0) > 0.05);
            rises && (0.4..=6.0).contains(&middle) && (0.3..=8.0).contains(&self.coefficients[c][0])
        })
    }
}

fn tells_ratio(shade: &Shade, times: &[f64]) -> bool {
    shade.seen.iter().any(|s| (times[s.frame] - times[shade.seen[0].frame]).abs() > 0.01)
}

struct Fit {
    curves: Curves,
    /// ln Δt of each frame.
    times: Vec<f64>,
    /// Variances of `times`.
    variances: Vec<f64>,
}

struct Problem<'a> {
    shades: &'a [Shade],
    times: &'a [f64],
    /// Whether the given exposure times are exact.
    held: bool,
}

impl Problem<'_> {
    /// The simplest shape whose held-out residual is near the least.
    fn choose(&self) -> Shape {
        let score = |shape: Shape| -> f64 {
            let folds = [0, 1].map(|fold| {
                let kept = |s: &Shade| (s.block.0 / 4 + s.block.1 / 4) % 2 == fold;
                self.fit(shape, &kept, None).map_or(f64::INFINITY, |fit| self.residual(&fit.curves, &|s| !kept(s)))
            });
            folds.iter().sum()
        };
        let shapes: Vec<Shape> = (0..=MOST_POWERS).map(|powers| Shape { powers, shared: true }).collect();
        let scores: Vec<f64> = shapes.par_iter().map(|&s| score(s)).collect();
        let mut best = (f64::INFINITY, shapes[0]);
        for (shape, score) in shapes.into_iter().zip(scores) {
            if score < (1.0 - WORTH_IT) * best.0 {
                best = (score, shape);
            }
        }
        let apart = Shape { shared: false, ..best.1 };
        if score(apart) < (1.0 - WORTH_IT) * best.0 {
            best.1 = apart;
        }
        best.1
    }

    /// The fit of `shape`, or of a simpler one where a camera could not have its curves.
    fn believable(&self, shape: Shape) -> Option<Fit> {
        (0..=shape.powers)
            .rev()
            .flat_map(|powers| [shape.shared, true].map(|shared| Shape { powers, shared }))
            .find_map(|s| self.fit(s, &|_| true, None).filter(|f| f.curves.believable()))
    }

    /// Mean of r²/(1 + r²/9) over the shades that `kept` keeps, r the residual over its deviation.
    fn residual(&self, curves: &Curves, kept: &dyn Fn(&Shade) -> bool) -> f64 {
        let (mut sum, mut n) = (0.0, 0.0);
        let log = |c: usize, z: f64| (curves.log(c, z), curves.slope(c, z));
        for shade in self.shades.iter().filter(|s| kept(s)) {
            for (r, deviation) in residuals(shade, &log, self.times) {
                let q = (r / deviation).powi(2);
                sum += shade.weight * q / (1.0 + q / 9.0);
                n += shade.weight;
            }
        }
        if n > 0.0 { sum / n } else { f64::INFINITY }
    }

    /// Weighted least squares, reweighted against outliers. With `known`, only the exposure times are unknown.
    fn fit(&self, shape: Shape, kept: &dyn Fn(&Shade) -> bool, known: Option<&Response>) -> Option<Fit> {
        let per_curve = if known.is_some() { 0 } else { shape.powers + 1 };
        let curves = if shape.shared { 1 } else { 3 };
        let first_time = per_curve * curves;
        let n = first_time + self.times.len();
        let mut found = Fit { curves: Curves::gamma(2.2), times: self.times.to_vec(), variances: Vec::new() };
        found.curves.shape = shape;
        for c in &mut found.curves.coefficients {
            c.resize(shape.powers + 1, 0.0);
        }
        let mut scale = f64::INFINITY;
        for _ in 0..ROUNDS {
            let current = |c: usize, z: f64| match known {
                Some(r) => known_log(r, c, z),
                None => (found.curves.log(c, z), found.curves.slope(c, z)),
            };
            let mut matrix = DMatrix::<f64>::zeros(n, n);
            let mut right = DVector::<f64>::zeros(n);
            let mut ratios = Vec::new();
            for shade in self.shades.iter().filter(|s| kept(s)) {
                let first = if shape.shared { 0 } else { shade.channel * per_curve };
                let (mut total, mut mean, mut mean_y) = (0.0, vec![0.0; n], 0.0);
                for (seen, (r, deviation)) in shade.seen.iter().zip(residuals(shade, &current, &found.times)) {
                    ratios.push((r / deviation).abs());
                    let outlier = if scale.is_finite() { 1.0 + (r / (2.4 * scale * deviation)).powi(2) } else { 1.0 };
                    let w = shade.weight / (deviation * deviation * outlier);
                    // Row: ln f⁻¹(z) − ln Δt − ln E = 0, of which a known ln f⁻¹ is the right-hand side.
                    let mut row = vec![0.0; n];
                    if per_curve > 0 {
                        row[first..first + per_curve].copy_from_slice(&basis(seen.z, shape.powers));
                    }
                    row[first_time + seen.frame] = -1.0;
                    let y = if known.is_some() { -current(shade.channel, seen.z).0 } else { 0.0 };
                    let filled = (first..first + per_curve).chain([first_time + seen.frame]);
                    for i in filled.clone() {
                        for j in filled.clone() {
                            matrix[(i, j)] += w * row[i] * row[j];
                        }
                        right[i] += w * row[i] * y;
                        mean[i] += w * row[i];
                    }
                    mean_y += w * y;
                    total += w;
                }
                // Minimised over ln E.
                for i in (0..n).filter(|&i| mean[i] != 0.0) {
                    for j in 0..n {
                        matrix[(i, j)] -= mean[i] * mean[j] / total;
                    }
                    right[i] -= mean[i] * mean_y / total;
                }
            }
            if ratios.is_empty() {
                return None;
            }
            let middle = ratios.len() / 2;
            scale = (1.4826 * *ratios.select_nth_unstable_by(middle, f64::total_cmp).1).max(0.1);
            // The residuals' own scale makes the weights inverse variances.
            matrix /= scale * scale;
            right /= scale * scale;
            for curve in 0..if per_curve > 0 { curves } else { 0 } {
                for k in 0..per_curve {
                    let (mean, deviation) = if k == 0 { (PRIOR.0, PRIOR.1) } else { (0.0, PRIOR.2) };
                    matrix[(curve * per_curve + k, curve * per_curve + k)] += deviation.powi(-2);
                    right[curve * per_curve + k] += mean * deviation.powi(-2);
                }
            }
            let w = if self.held { HELD } else { FREE }.powi(-2);
            for (i, &given) in self.times.iter().enumerate() {
                matrix[(first_time + i, first_time + i)] += w;
                right[first_time + i] += w * given;
            }
            if !self.held {
                // Neither their mean nor, where the curve is unknown, their spread can be seen: both are held.
                let mean = self.times.iter().sum::<f64>() / self.times.len() as f64;
                let spread: Vec<f64> = self.times.iter().map(|t| t - mean).collect();
                for direction in [Some(vec![1.0; spread.len()]), (per_curve > 0).then_some(spread)].into_iter().flatten() {
                    let held: f64 = direction.iter().zip(self.times).map(|(v, t)| v * t).sum();
                    for (i, a) in direction.iter().enumerate() {
                        for (j, b) in direction.iter().enumerate() {
                            matrix[(first_time + i, first_time + j)] += HELD.powi(-2) * a * b;
                        }
                        right[first_time + i] += HELD.powi(-2) * a * held;
                    }
                }
            }
            let inverse = Cholesky::new(matrix)?;
            let solution = inverse.solve(&right);
            if per_curve > 0 {
                for c in 0..3 {
                    let first = if shape.shared { 0 } else { c * per_curve };
                    found.curves.coefficients[c].copy_from_slice(&solution.as_slice()[first..first + per_curve]);
                }
            }
            found.times = solution.as_slice()[first_time..].to_vec();
            let inverse = inverse.inverse();
            found.variances = (first_time..n).map(|i| inverse[(i, i)]).collect();
        }
        if !self.held {
            self.anchor(&mut found, known.is_some());
        }
        Some(found)
    }

    /// Scales and shifts ln Δt (only shifts where the curve is known) towards the given ones; the curve is raised to the same power.
    fn anchor(&self, found: &mut Fit, curve_known: bool) {
        let (u, s) = best_line(&found.times, self.times, curve_known);
        found.times.iter_mut().for_each(|t| *t = u * *t + s);
        found.curves.coefficients.iter_mut().flatten().for_each(|c| *c *= u);
    }

    fn check(&self, shape: Shape, known: Option<&Response>) -> ExposureCheck {
        let n = self.times.len();
        let nothing = ExposureCheck { difference_ev: vec![None; n], deviation_ev: vec![0.0; n], curve_known: known.is_some() };
        let Some(fit) = self.fit(shape, &|_| true, known) else { return nothing };
        let ln2 = std::f64::consts::LN_2;
        // What moves, glares or does not follow the curve does so in a part of the frame: the parts' disagreement is the uncertainty.
        let last = self.shades.iter().fold((0, 0), |m, s| (m.0.max(s.block.0), m.1.max(s.block.1)));
        let part = |s: &Shade| usize::from(2 * s.block.0 > last.0) + 2 * usize::from(2 * s.block.1 > last.1);
        let parts: Vec<Fit> = (0..4).filter_map(|q| self.fit(shape, &|s| part(s) != q, known)).collect();
        let deviation = |i: usize| {
            let spread = parts.iter().map(|f| (f.times[i] - fit.times[i]).powi(2)).sum::<f64>() * 0.75;
            (fit.variances[i].max(0.0) + spread).sqrt() / ln2
        };
        let shared: Vec<usize> = (0..n)
            .map(|i| self.shades.iter().filter(|s| tells_ratio(s, self.times) && s.seen.iter().any(|v| v.frame == i)).count())
            .collect();
        ExposureCheck {
            difference_ev: (0..n).map(|i| (shared[i] >= FEWEST).then(|| (fit.times[i] - self.times[i]) / ln2)).collect(),
            deviation_ev: (0..n).map(deviation).collect(),
            ..nothing
        }
    }
}

/// The (u, s) for which u `free` + s has the least sum of absolute differences to `given`, so that one wrong time does not pass for many; u = 1 when
/// `fixed`. Such a line goes through two of the points, or one.
pub(super) fn best_line(free: &[f64], given: &[f64], fixed: bool) -> (f64, f64) {
    let cost = |u: f64, s: f64| free.iter().zip(given).map(|(t, g)| (u * t + s - g).abs()).sum::<f64>();
    let mut best = (f64::INFINITY, 1.0, 0.0);
    for i in 0..given.len() {
        for j in 0..given.len() {
            let u = if fixed { 1.0 } else { (given[i] - given[j]) / (free[i] - free[j]) };
            let s = given[i] - u * free[i];
            // A power far from 1 is no slip of one exposure time.
            if (0.5..=2.0).contains(&u) && cost(u, s) < best.0 - 1e-12 {
                best = (cost(u, s), u, s);
            }
        }
    }
    (best.1, best.2)
}

/// ln f⁻¹ and its slope.
fn known_log(response: &Response, channel: usize, z: f64) -> (f64, f64) {
    let x = response.inverse(channel, z).max(1e-9);
    (x.ln(), (response.inverse_slope(channel, z, 2.0 / 255.0) / x).max(1e-3))
}

/// Of every frame that sees `shade`: ln f⁻¹(z) − ln Δt − ln E and its standard deviation, with the ln E that fits best.
fn residuals(shade: &Shade, log: &dyn Fn(usize, f64) -> (f64, f64), times: &[f64]) -> Vec<(f64, f64)> {
    let mut out: Vec<(f64, f64)> = shade
        .seen
        .iter()
        .map(|s| {
            let (g, slope) = log(shade.channel, s.z);
            (g - times[s.frame], FLOOR.hypot(slope * s.deviation))
        })
        .collect();
    let total: f64 = out.iter().map(|(_, d)| d.powi(-2)).sum();
    let mean = out.iter().map(|(v, d)| v * d.powi(-2)).sum::<f64>() / total;
    out.iter_mut().for_each(|(v, _)| *v -= mean);
    out
}
