//! Alignment without features: correlation of two small pictures over all shifts and a few rolls, on the pixels that both see.

use super::picture::Tone;
use crate::fft::{Fft2, Spectrum};
use crate::image::Plane;
use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// Largest roll in degrees that is searched.
const LARGEST_ROLL: f64 = 3.0;
/// Radius of the squares whose mean is taken off, pixels.
const LOCAL: usize = 8;
/// Contrast (natural logarithm) at which a pixel counts half.
const CONTRAST: f32 = 0.1;

/// Detail (local mean taken off) and weight.
fn detail(tone: &Tone) -> (Plane, Plane) {
    let c2 = CONTRAST * CONTRAST;
    let weight =
        Plane { data: tone.valid.data.iter().zip(&tone.variance.data).map(|(m, v)| m * c2 / (c2 + v)).collect(), ..tone.value.clone() };
    let (sum, total) = (tone.value.zip(&weight, |v, k| v * k).box_sum(LOCAL), weight.box_sum(LOCAL));
    let value = Plane {
        data: (0..weight.data.len())
            .map(|i| if weight.data[i] > 1e-3 { tone.value.data[i] - sum.data[i] / total.data[i].max(1e-6) } else { 0.0 })
            .collect(),
        ..tone.value.clone()
    };
    (value, weight)
}

/// Motions (frame from reference, centred pixels) with the highest correlations, best first, one per roll; shifts up to `reach` pixels.
pub(super) fn search(reference: &Tone, frame: &Tone, reach: usize, count: usize) -> Vec<(f64, DMat3)> {
    let (w, h) = reference.size();
    let corner = 0.5 * (w as f64).hypot(h as f64);
    let steps = (LARGEST_ROLL.to_radians() * corner).ceil() as i32;
    let fft = Fft2::new(w + reach, h + reach);
    let spectra = |tone: &Tone| -> [Spectrum; 3] {
        let (d, k) = detail(tone);
        [d.zip(&k, |d, k| d * k), k.clone(), d.zip(&k, |d, k| d * d * k)].map(|p| fft.forward(&p.data, w))
    };
    let own = spectra(reference);
    let total: f64 = detail(reference).1.data.iter().map(|&v| f64::from(v)).sum();
    let mut found: Vec<(f64, DMat3)> = (-steps..=steps)
        .into_par_iter()
        .map(|i| {
            let roll = DMat3::from_angle(LARGEST_ROLL.to_radians() * f64::from(i) / f64::from(steps.max(1)));
            let other = spectra(&frame.on_reference(&roll));
            let correlate = |a: &Spectrum, b: &Spectrum| fft.inverse(a.iter().zip(b).map(|(a, b)| a.conj() * b).collect());
            // Entry s: sum over p of reference(p) frame(p + s).
            let product = correlate(&own[0], &other[0]);
            let (energy, energy_other) = (correlate(&own[2], &other[1]), correlate(&own[1], &other[2]));
            let overlap = correlate(&own[1], &other[1]);
            let (mut best, mut at) = (f64::NEG_INFINITY, DVec2::ZERO);
            let r = reach as isize;
            for dy in -r..=r {
                for dx in -r..=r {
                    let k = dy.rem_euclid(fft.height as isize) as usize * fft.width + dx.rem_euclid(fft.width as isize) as usize;
                    if f64::from(overlap[k]) < 0.2 * total {
                        continue;
                    }
                    let norm = f64::from(energy[k].max(0.0)) * f64::from(energy_other[k].max(0.0));
                    let score = f64::from(product[k]) / norm.sqrt().max(1e-12);
                    if score > best {
                        (best, at) = (score, DVec2::new(dx as f64, dy as f64));
                    }
                }
            }
            // The rolled frame was sampled at `roll p`: shifted there by `at`, the frame's own point is roll (p + at).
            (best, roll * DMat3::from_translation(at))
        })
        .collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.truncate(count);
    found
}
