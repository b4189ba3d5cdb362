//! Local PSFs h of a blurred frame against a sharp reference (section III-A) or of two shaken frames (III-B). No poses.

mod blind;
mod paired;
mod patch;

pub use blind::{Pair, Setup, estimate_pair};
pub use paired::{Measured, estimate, estimate_within};
pub use patch::{Patch, around, choose};

use crate::image::Plane;

/// A local PSF: `frame(y) = Σ_u h(u) E(y - u)` with u from `-radius..=radius` in x and y; non-negative, sum 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Psf {
    /// Largest |u| per axis, pixels.
    pub radius: usize,
    /// Square of side 2 · radius + 1; u = 0 is the centre.
    pub values: Plane,
}

impl Psf {
    /// Centroid (u_x, u_y) in pixels.
    pub fn centroid(&self) -> (f64, f64) {
        let (mut s, mut x, mut y) = (0.0, 0.0, 0.0);
        let r = self.radius as f64;
        for (i, &v) in self.values.data.iter().enumerate() {
            let v = f64::from(v);
            s += v;
            x += v * ((i % self.values.width) as f64 - r);
            y += v * ((i / self.values.width) as f64 - r);
        }
        (x / s, y / s)
    }

    /// Root mean square distance from the centroid in pixels.
    pub fn extent(&self) -> f64 {
        let (cx, cy) = self.centroid();
        let (mut s, mut d) = (0.0, 0.0);
        let r = self.radius as f64;
        for (i, &v) in self.values.data.iter().enumerate() {
            let v = f64::from(v);
            let (x, y) = ((i % self.values.width) as f64 - r - cx, (i / self.values.width) as f64 - r - cy);
            s += v;
            d += v * (x * x + y * y);
        }
        (d / s).sqrt()
    }
}
