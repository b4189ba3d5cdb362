//! The camera's response from an unblurred bracket: P. Debevec and J. Malik, "Recovering High Dynamic Range Radiance
//! Maps from Photographs", SIGGRAPH 1997, with the latent exposures eliminated and the ends extrapolated.

use super::Response;
use crate::error::{Error, Result};
use crate::exposure::{Bracket, Frame};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

/// Codes of the table.
const CODES: usize = 256;
/// λ of Debevec and Malik, for the weight of [`REFERENCE_SAMPLES`] pixels.
const SMOOTHNESS: f64 = 10.0;
/// The data term is scaled as if it came from so many pixels, so that λ does not depend on the frames' size.
const REFERENCE_SAMPLES: f64 = 1000.0;
/// About so many pixels are used, on a regular grid over the frame. More change the curves by less than 0.01.
const MAX_SAMPLES: usize = 400_000;
/// Fewer pixels that two frames expose well do not tell a curve.
const MIN_OVERLAP: usize = 64;
/// Least rise of ln f⁻¹ from one code to the next, a tenth of the smallest that the curves measured so far have. A response
/// that stands still could not be inverted.
const LEAST_RISE: f64 = 0.001;
/// Code at which ln f⁻¹ is zero until the end.
const ANCHOR: usize = 128;

/// Response f of the camera that took `bracket`, as a table of f⁻¹ at the intensities 0/255, ..., 255/255 per channel.
/// The frames must show one scene without motion or blur. ([`of_still_frames`](super::of_still_frames) has less of their noise.)
///
/// Per channel, g = ln f⁻¹ minimises
///
/// Σ_p Σ_i w(Z_pi)² (g(Z_pi) − ln E_p − ln Δt_i)² + λ² Σ_z w(z)² (g(z−1) − 2 g(z) + g(z+1))²
///
/// with the hat weight w(z) = min(z + 1, 256 − z)/128 and λ = 10. Minimising over each ln E_p first leaves 256
/// unknowns whatever the number of pixels, so all pixels of a grid over the frame take part instead of a small sample.
///
/// **The ends** are extrapolated, because noise decides there what a pixel reads. Measured on frames with a full well of
/// 4000 e⁻ and read noise of 8 e⁻, the plain solution is e^3.7 too large at code 1 (noise cut off at black) and e^0.9
/// too large at code 255 (noise cut off at white, which would scale everything else).
/// * Dark: x is a power law of Z whose exponent follows from codes 28 to 110, changes downwards as it does there by at
///   most 0.3 and stays within 1..=3; it blends into the solution from code 40 to 20. So f(0) = 0.
/// * Bright: ln x goes on from code 246 with the slope that it has from 225 to 246.
///
/// The result rises strictly (pool adjacent violators) and scaled so that x = 1 at the largest code.
///
/// # Errors
/// [`Error::Bracket`] when too few pixels are well exposed in two frames of different exposure time.
///
/// # Examples
/// ```
/// use unshaken::{exposure::{Bracket, Frame}, image::{Plane, Rgb}, response::calibrate};
/// // A ramp of irradiance through the response Z = x^(1/2), at four exposure times.
/// let frames = [0.05, 0.2, 0.5, 1.0].map(|exposure_time| {
///     let ramp = Plane::from_fn(64, 64, |x, y| {
///         let irradiance = (y * 64 + x) as f64 / 2000.0;
///         ((irradiance * exposure_time).min(1.0).sqrt() * 255.0).round() as f32 / 255.0
///     });
///     Frame { name: format!("{exposure_time} s"), intensity: Rgb([ramp.clone(), ramp.clone(), ramp]), levels: 255, chroma_subsampled: false, lossy: false, speed: None, exposure_time }
/// });
/// let response = calibrate(&Bracket::new(frames.to_vec())?)?;
/// assert!((response.inverse(1, 0.5) - 0.25).abs() < 0.01);
/// # Ok::<(), unshaken::error::Error>(())
/// ```
pub fn calibrate(bracket: &Bracket) -> Result<Response> {
    let mut tables = [const { Vec::new() }; 3];
    for (c, table) in tables.iter_mut().enumerate() {
        *table = to_table(solve(bracket, c)?);
    }
    Ok(Response::Table(tables))
}

/// Hat weight of a code.
fn weight(code: usize) -> f64 {
    (code + 1).min(CODES - code) as f64 / 128.0
}

/// Codes of channel `c` of every `step`-th pixel in both directions.
fn codes(frame: &Frame, c: usize, step: usize) -> Vec<u8> {
    let plane = &frame.intensity.0[c];
    let mut out = Vec::with_capacity(plane.data.len() / (step * step) + plane.width);
    for y in (step / 2..plane.height).step_by(step) {
        out.extend((step / 2..plane.width).step_by(step).map(|x| (plane.at(x, y).clamp(0.0, 1.0) * 255.0).round() as u8));
    }
    out
}

/// ln f⁻¹ of channel `c` at the 256 codes, 0 at [`ANCHOR`].
fn solve(bracket: &Bracket, c: usize) -> Result<Vec<f64>> {
    let (width, height) = bracket.size();
    let step = ((width * height) as f64 / MAX_SAMPLES as f64).sqrt().ceil().max(1.0) as usize;
    let frames = bracket.frames();
    let sampled: Vec<Vec<u8>> = frames.iter().map(|f| codes(f, c, step)).collect();
    let times: Vec<f64> = frames.iter().map(|f| f.exposure_time.ln()).collect();
    let weights: Vec<f64> = (0..CODES).map(|z| weight(z).powi(2)).collect();

    // Normal equations of the data term after elimination of ln E: per pixel diag(w) − w wᵀ/Σw over its frames' codes.
    let n = sampled[0].len();
    let mut matrix = DMatrix::<f64>::zeros(CODES, CODES);
    let mut right = DVector::<f64>::zeros(CODES);
    let mut overlap = 0;
    for p in 0..n {
        let total: f64 = sampled.iter().map(|s| weights[s[p] as usize]).sum();
        let mean_time = sampled.iter().zip(&times).map(|(s, t)| weights[s[p] as usize] * t).sum::<f64>() / total;
        for (s, t) in sampled.iter().zip(&times) {
            let z = s[p] as usize;
            matrix[(z, z)] += weights[z];
            right[z] += weights[z] * (t - mean_time);
            for other in &sampled {
                let y = other[p] as usize;
                matrix[(y, z)] -= weights[z] * weights[y] / total;
            }
        }
        let well: Vec<f64> = sampled.iter().zip(&times).filter(|(s, _)| (10..=245).contains(&s[p])).map(|(_, t)| *t).collect();
        overlap += usize::from(well.iter().any(|t| (t - well[0]).abs() > 0.01));
    }
    if overlap < MIN_OVERLAP {
        return Err(Error::Bracket(format!(
            "{}: too few pixels ({overlap}) are well exposed in two frames of different exposure time; take frames whose exposure times are closer",
            frames[0].name
        )));
    }
    matrix *= REFERENCE_SAMPLES / n as f64;
    right *= REFERENCE_SAMPLES / n as f64;
    for z in 1..CODES - 1 {
        let s = SMOOTHNESS * SMOOTHNESS * weights[z];
        for (i, a) in [1.0, -2.0, 1.0].into_iter().enumerate() {
            for (j, b) in [1.0, -2.0, 1.0].into_iter().enumerate() {
                matrix[(z + i - 1, z + j - 1)] += s * a * b;
            }
        }
    }
    // g is known up to a constant.
    matrix[(ANCHOR, ANCHOR)] += REFERENCE_SAMPLES;
    let g = nalgebra::linalg::Cholesky::new(matrix).ok_or_else(|| {
        Error::Bracket(format!("{}: the frames do not determine a response; take more frames of a scene with more shades", frames[0].name))
    })?;
    let g = g.solve(&right);
    Ok(g.iter().map(|v| v - g[ANCHOR]).collect())
}

/// Extrapolated, monotone and normalised f⁻¹ from ln f⁻¹.
fn to_table(mut g: Vec<f64>) -> Vec<f64> {
    extend_dark_end(&mut g);
    extend_bright_end(&mut g);
    make_monotone(&mut g[1..]);
    let white = g[CODES - 1];
    let mut x: Vec<f64> = g.iter().map(|v| (v - white).exp()).collect();
    x[0] = 0.0;
    x
}

/// Least-squares a + b t + c t² through (t, value).
fn fit_parabola(points: impl Iterator<Item = (f64, f64)>) -> Vector3<f64> {
    let (mut m, mut r) = (Matrix3::zeros(), Vector3::zeros());
    for (t, v) in points {
        let row = Vector3::new(1.0, t, t * t);
        m += row * row.transpose();
        r += row * v;
    }
    m.lu().solve(&r).expect("more than three different abscissae determine a parabola")
}

/// Replaces codes below 20 by a power law, and blends up to code 40. The numbers: of eleven variants (range 20..28 to
/// 60..160, straight or curved, exponent free, held or bound), tried on film-like, sRGB and gamma 2.2 curves with the noise
/// named above, this one is off by at most 0.2 at codes 10 to 20 and 0.45 at 5 to 10 (mean over scenes) on all three.
fn extend_dark_end(g: &mut [f64]) {
    const FIRST: usize = 28;
    const LAST: usize = 110;
    const BLEND: [usize; 2] = [20, 40];
    const MAX_CHANGE: f64 = 0.3;
    let t = |z: usize| (z as f64 / 64.0).ln();
    let [a, b, c] = fit_parabola((FIRST..=LAST).map(|z| (t(z), g[z]))).into();
    let at_first = b + 2.0 * c * t(FIRST);
    let exponent = |t: f64| (b + 2.0 * c * t).clamp(at_first - MAX_CHANGE, at_first + MAX_CHANGE).clamp(1.0, 3.0);
    let mut law: Vec<f64> = (0..=BLEND[1]).map(|z| a + b * t(z.max(1)) + c * t(z.max(1)).powi(2)).collect();
    for z in (1..FIRST).rev() {
        law[z] = law[z + 1] - exponent((t(z) + t(z + 1)) / 2.0) * (t(z + 1) - t(z));
    }
    for z in 0..BLEND[1] {
        let solution = (z.saturating_sub(BLEND[0]) as f64 / (BLEND[1] - BLEND[0]) as f64).min(1.0);
        g[z] = solution * g[z] + (1.0 - solution) * law[z.max(1)];
    }
}

/// Continues ln x in a straight line to the largest code.
fn extend_bright_end(g: &mut [f64]) {
    const FIRST: usize = 225;
    const LAST: usize = 246;
    let n = (LAST - FIRST + 1) as f64;
    let (mean_z, mean_g) = ((FIRST + LAST) as f64 / 2.0, g[FIRST..=LAST].iter().sum::<f64>() / n);
    let (mut zg, mut zz) = (0.0, 0.0);
    for (z, v) in g.iter().enumerate().take(LAST + 1).skip(FIRST) {
        zg += (z as f64 - mean_z) * (v - mean_g);
        zz += (z as f64 - mean_z).powi(2);
    }
    for (z, v) in g.iter_mut().enumerate().skip(LAST + 1) {
        *v = mean_g + (zg / zz).max(0.0) * (z as f64 - mean_z);
    }
}

/// The nearest sequence, in the least-squares sense, that rises by at least [`LEAST_RISE`] from code to code: pool
/// adjacent violators.
pub(super) fn make_monotone(g: &mut [f64]) {
    g.iter_mut().enumerate().for_each(|(z, g)| *g -= LEAST_RISE * z as f64);
    let mut pools: Vec<(f64, usize)> = Vec::with_capacity(g.len());
    for &v in g.iter() {
        let mut pool = (v, 1);
        while let Some(&(mean, n)) = pools.last()
            && mean > pool.0
        {
            pool = ((mean * n as f64 + pool.0 * pool.1 as f64) / (n + pool.1) as f64, n + pool.1);
            pools.pop();
        }
        pools.push(pool);
    }
    let values = pools.into_iter().flat_map(|(v, n)| std::iter::repeat_n(v, n));
    g.iter_mut().zip(values).enumerate().for_each(|(z, (g, v))| *g = v + LEAST_RISE * z as f64);
}
