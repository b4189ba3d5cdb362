//! Where to look at the blur: patches chosen by how well they determine a PSF, spread over the frame.

use crate::image::Plane;
use glam::DVec2;
use serde::Serialize;

/// A square part of the frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Patch {
    /// Left edge, pixels.
    pub x: usize,
    /// Upper edge, pixels.
    pub y: usize,
    /// Side, pixels.
    pub size: usize,
    /// Noise-weighted gradient energy across its weakest direction: larger determines a PSF better.
    pub score: f64,
}

impl Patch {
    /// Centre in pixels of the frame.
    pub fn centre(&self) -> (f64, f64) {
        let half = (self.size as f64 - 1.0) / 2.0;
        (self.x as f64 + half, self.y as f64 + half)
    }

    /// Centre in centred pixels of a frame of `size`.
    pub fn centred(&self, size: (usize, usize)) -> DVec2 {
        let (x, y) = self.centre();
        DVec2::new(x - 0.5 * (size.0 as f64 - 1.0), y - 0.5 * (size.1 as f64 - 1.0))
    }
}

/// Up to `count` patches of side `size` of the reference `latent`, `weight` being the inverse variance (0: not usable) of the
/// blurred frame's pixels on the same grid.
///
/// A patch is scored by the smaller eigenvalue of its noise-weighted structure tensor, the per-direction form of the measure
/// that ranks patches by PSF error (rank correlation 0.9 on real scenes; coverage or variance alone do not). The best comes
/// first, then the one with the largest score times squared distance to those chosen.
pub fn choose(latent: &Plane, weight: &Plane, size: usize, count: usize) -> Vec<Patch> {
    let (w, h) = latent.size();
    let size = size.min(w).min(h);
    let stride = (size / 4).max(1);
    let mut candidates = Vec::new();
    for y in (0..=h - size).step_by(stride) {
        for x in (0..=w - size).step_by(stride) {
            let score = score(latent, weight, x, y, size);
            if score > 0.0 {
                candidates.push(Patch { x, y, size, score });
            }
        }
    }
    let mut chosen: Vec<Patch> = Vec::new();
    while chosen.len() < count {
        let spread = |p: &Patch| {
            let nearest =
                chosen.iter().map(|q| (p.x as f64 - q.x as f64).powi(2) + (p.y as f64 - q.y as f64).powi(2)).fold(f64::INFINITY, f64::min);
            p.score * nearest.min((w * w + h * h) as f64)
        };
        let Some(best) = candidates.iter().copied().max_by(|a, b| spread(a).total_cmp(&spread(b))) else { break };
        if spread(&best) <= 0.0 {
            break;
        }
        chosen.push(best);
    }
    chosen
}

/// The patch of side `size` around the pixel (x, y), moved inside the frame.
pub fn around(latent: &Plane, weight: &Plane, x: usize, y: usize, size: usize) -> Patch {
    let (w, h) = latent.size();
    let size = size.min(w).min(h);
    let (x, y) = (x.saturating_sub(size / 2).min(w - size), y.saturating_sub(size / 2).min(h - size));
    Patch { x, y, size, score: score(latent, weight, x, y, size) }
}

/// Smaller eigenvalue of the noise-weighted structure tensor of a square.
fn score(latent: &Plane, weight: &Plane, x: usize, y: usize, size: usize) -> f64 {
    let (mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0);
    for j in y..y + size - 1 {
        for i in x..x + size - 1 {
            let k = f64::from(weight.at(i, j).min(weight.at(i + 1, j)).min(weight.at(i, j + 1)));
            let gx = f64::from(latent.at(i + 1, j) - latent.at(i, j));
            let gy = f64::from(latent.at(i, j + 1) - latent.at(i, j));
            xx += k * gx * gx;
            yy += k * gy * gy;
            xy += k * gx * gy;
        }
    }
    0.5 * (xx + yy) - (0.25 * (xx - yy).powi(2) + xy * xy).sqrt()
}
