//! Motions of a frame as a whole: how many degrees of freedom they have, and small steps in each.

use glam::{DMat3, DVec2};
use serde::Serialize;

/// Kind of a frame's motion against the reference, fewest degrees of freedom first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Model {
    /// Nothing moved.
    Identity,
    /// Shift.
    Translation,
    /// Shift and roll.
    Rigid,
    /// Shift, roll, scales and shear.
    Affine,
    /// Any homography: pitch and yaw as well.
    Homography,
}

impl Model {
    /// All of them, simplest first.
    pub const ALL: [Self; 5] = [Self::Identity, Self::Translation, Self::Rigid, Self::Affine, Self::Homography];

    /// Degrees of freedom.
    pub fn freedom(self) -> usize {
        match self {
            Self::Identity => 0,
            Self::Translation => 2,
            Self::Rigid => 3,
            Self::Affine => 6,
            Self::Homography => 8,
        }
    }

    /// The motion of this kind that the parameters `delta` (pixels at distance `scale` from the centre) stand for.
    ///
    /// Exact within each group, so that products of steps stay in it.
    pub(super) fn step(self, delta: &[f64], scale: f64) -> DMat3 {
        let d = |i: usize| delta.get(i).copied().unwrap_or(0.0);
        let shift = DVec2::new(d(0), d(1));
        match self {
            Self::Identity => DMat3::IDENTITY,
            Self::Translation => DMat3::from_translation(shift),
            Self::Rigid => DMat3::from_translation(shift) * DMat3::from_angle(d(2) / scale),
            Self::Affine | Self::Homography => {
                let s = scale;
                DMat3::from_cols(
                    glam::DVec3::new(1.0 + (d(3) + d(4)) / s, (d(5) + d(2)) / s, -d(6) / (s * s)),
                    glam::DVec3::new((d(5) - d(2)) / s, 1.0 + (d(3) - d(4)) / s, -d(7) / (s * s)),
                    glam::DVec3::new(shift.x, shift.y, 1.0),
                )
            }
        }
    }
}

/// Displacement of the point `p` per unit of each of the eight parameters; models use the first [`Model::freedom`] of them.
pub(super) fn fields(p: DVec2, scale: f64) -> [DVec2; 8] {
    let (x, y) = (p.x / scale, p.y / scale);
    [
        DVec2::new(1.0, 0.0),
        DVec2::new(0.0, 1.0),
        DVec2::new(-y, x),
        DVec2::new(x, y),
        DVec2::new(x, -y),
        DVec2::new(y, x),
        DVec2::new(x * x, x * y),
        DVec2::new(x * y, y * y),
    ]
}

/// `h` scaled so that its last element is 1.
pub(super) fn normalised(h: DMat3) -> DMat3 {
    h * (1.0 / h.z_axis.z)
}

/// Root mean square and largest displacement in pixels between the motions `a` and `b` over a `width` x `height` frame.
pub fn distance(a: &DMat3, b: &DMat3, width: usize, height: usize) -> (f64, f64) {
    let half = DVec2::new(0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let (mut sum, mut worst, mut n) = (0.0, 0.0f64, 0.0);
    for j in -2..=2 {
        for i in -2..=2 {
            let p = half * DVec2::new(f64::from(i), f64::from(j)) * 0.5;
            let d = (crate::pose::project(a, p) - crate::pose::project(b, p)).length();
            sum += d * d;
            worst = worst.max(d);
            n += 1.0;
        }
    }
    ((sum / n).sqrt(), worst)
}
