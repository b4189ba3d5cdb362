//! Transformation spread functions (section II-B): which poses the camera went through and for how long.

mod active_set;
mod align_across;
mod align_within;
mod continuous;
mod estimate;
mod from_psfs;
mod grid_search;
mod held_out;
mod model;
mod taps;
mod unseen;
mod whole_frame;

pub use align_across::{align_across, blurred};
pub use align_within::{Within, align_within, psf_at, shifted};
pub(crate) use estimate::filled;
pub use estimate::{Estimate, Search, Trial, extent, path_at, stroke};
pub use from_psfs::from_psfs;
pub use model::Model;
pub use taps::{INDISTINGUISHABLE, Interpolation, Tap, TapSet, WARP_COST};
pub use unseen::{Latent, Stride, Unseen, divided};
pub use whole_frame::WholeFrame;

use crate::error::{Error, Result};
use crate::pose::Pose;
use glam::{DMat2, DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The TSF h_T of one frame: sparse poses whose weights sum to 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Tsf {
    /// Focal length in pixels of the frame that the poses speak of.
    pub focal_px: f64,
    /// The poses; weights positive, sum 1.
    pub poses: Vec<Pose>,
    /// Motion of the frame as a whole, from the latent scene on the reference's grid to the grid about which the poses move (centred
    /// pixels): a pose takes the scene point p to Γ(base p). The identity for frames that lie on the reference.
    pub base: DMat3,
}

impl Tsf {
    /// Moves each pose `part` of the way to that of `other`, which has as many.
    ///
    /// # Panics
    /// Where it has not.
    pub fn move_towards(&mut self, other: &Self, part: f64) {
        assert_eq!(self.poses.len(), other.poses.len(), "pose by pose");
        let to = |a: &mut f64, b: f64| *a += part * (b - *a);
        for (p, q) in self.poses.iter_mut().zip(&other.poses) {
            to(&mut p.t_x, q.t_x);
            to(&mut p.t_y, q.t_y);
            to(&mut p.theta_x_deg, q.theta_x_deg);
            to(&mut p.theta_y_deg, q.theta_y_deg);
            to(&mut p.theta_z_deg, q.theta_z_deg);
            to(&mut p.weight, q.weight);
        }
        self.base = other.base;
    }

    /// Checks and normalises: poses of zero weight are dropped, the others' weights scaled to sum 1.
    ///
    /// # Errors
    /// [`Error::Input`] for no poses, negative or non-finite numbers, a sum of zero, a focal length that is not positive.
    pub fn new(focal_px: f64, poses: Vec<Pose>) -> Result<Self> {
        if !(focal_px.is_finite() && focal_px > 0.0) {
            return Err(Error::Input(format!("focal length {focal_px} px is not a positive number")));
        }
        for p in &poses {
            let all = [p.t_x, p.t_y, p.theta_x_deg, p.theta_y_deg, p.theta_z_deg, p.weight];
            if all.iter().any(|v| !v.is_finite()) || p.weight < 0.0 {
                return Err(Error::Input(format!("pose {p:?} holds a negative weight or a number that is not finite")));
            }
        }
        let sum: f64 = poses.iter().map(|p| p.weight).sum();
        if sum <= 0.0 {
            return Err(Error::Input("a TSF needs at least one pose with a positive weight".into()));
        }
        let poses = poses.into_iter().filter(|p| p.weight > 0.0).map(|p| Pose { weight: p.weight / sum, ..p }).collect();
        Ok(Self { focal_px, poses, base: DMat3::IDENTITY })
    }

    /// The same poses about another motion of the frame as a whole.
    #[must_use]
    pub fn about(self, base: DMat3) -> Self {
        Self { base, ..self }
    }

    /// The TSF of a frame that is sharp and displaced by `motion` (frame from reference, centred pixels).
    pub fn still(motion: DMat3) -> Self {
        Self::identity().about(motion)
    }

    /// The TSF of a frame that is sharp and in place.
    pub fn identity() -> Self {
        Self { focal_px: 1000.0, poses: vec![Pose::IDENTITY], base: DMat3::IDENTITY }
    }

    /// Whether the frame is the latent scene itself (single pose, nothing moves).
    pub fn is_identity(&self) -> bool {
        self.base.abs_diff_eq(DMat3::IDENTITY, 1e-9) && matches!(self.poses.as_slice(), [p] if Pose { weight: 1.0, ..*p } == Pose::IDENTITY)
    }

    /// Where the frame of a single pose lies (frame from reference, centred pixels); `None` for a blurred frame.
    pub fn single(&self) -> Option<DMat3> {
        match self.poses.as_slice() {
            [p] => Some(p.homography(self.focal_px) * self.base),
            _ => None,
        }
    }

    /// Motion of the mean pose (frame from reference, centred pixels).
    pub fn centre(&self) -> DMat3 {
        self.mean().homography(self.focal_px) * self.base
    }

    /// The same with poses that no pixel of a `width` x `height` frame tells apart made one, their weighted mean: wherever a pose takes a
    /// pixel of the frame, a pose of the result stands within `bound` pixels of it with its weight. One pass, whatever the poses' order.
    pub fn merged(&self, width: usize, height: usize, bound: f64) -> Self {
        let (x, y) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
        let corners = [(-x, -y), (x, -y), (-x, y), (x, y)].map(|c| DVec2::new(c.0, c.1));
        // Cells whose diagonal is the bound; a small homography moves no pixel farther than the corner that moves farthest.
        let side = bound / std::f64::consts::SQRT_2;
        let mut cells: BTreeMap<[i64; 8], Pose> = BTreeMap::new();
        for p in &self.poses {
            let moved = corners.map(|c| p.apply(self.focal_px, c) - c);
            let key = std::array::from_fn(|i| ((if i % 2 == 0 { moved[i / 2].x } else { moved[i / 2].y }) / side).floor() as i64);
            let cell = cells.entry(key).or_insert(Pose { weight: 0.0, ..*p });
            let sum = cell.weight + p.weight;
            let mean = |a: f64, b: f64| a + (b - a) * (p.weight / sum);
            *cell = Pose {
                t_x: mean(cell.t_x, p.t_x),
                t_y: mean(cell.t_y, p.t_y),
                theta_x_deg: mean(cell.theta_x_deg, p.theta_x_deg),
                theta_y_deg: mean(cell.theta_y_deg, p.theta_y_deg),
                theta_z_deg: mean(cell.theta_z_deg, p.theta_z_deg),
                weight: sum,
            };
        }
        Self { poses: cells.into_values().collect(), ..self.clone() }
    }

    /// The same motion on frames `factor` times as large.
    pub fn scaled(&self, factor: f64) -> Self {
        let poses = self.poses.iter().map(|p| Pose { t_x: factor * p.t_x, t_y: factor * p.t_y, ..*p }).collect();
        let larger = DMat3::from_diagonal(DVec3::new(factor, factor, 1.0));
        Self { focal_px: factor * self.focal_px, poses, base: larger * self.base * larger.inverse() }
    }

    /// The same poses about the point `centre` (centred pixels) instead of the frame's own centre, where they turn in the image plane only; of other
    /// rotations what they do at that point. The base stays.
    #[must_use]
    pub fn around(&self, centre: DVec2) -> Self {
        let moved = |p: &Pose| {
            let t = p.apply(self.focal_px, centre) - centre;
            Pose::planar(t.x, t.y, p.theta_z_deg, p.weight)
        };
        Self { poses: self.poses.iter().map(moved).collect(), ..self.clone() }
    }

    /// Weighted mean pose: (t_x, t_y) in pixels, (θ_x, θ_y, θ_z) in degrees.
    pub fn mean(&self) -> Pose {
        let mut m = Pose { weight: 1.0, ..Pose::planar(0.0, 0.0, 0.0, 1.0) };
        for p in &self.poses {
            m.t_x += p.weight * p.t_x;
            m.t_y += p.weight * p.t_y;
            m.theta_x_deg += p.weight * p.theta_x_deg;
            m.theta_y_deg += p.weight * p.theta_y_deg;
            m.theta_z_deg += p.weight * p.theta_z_deg;
        }
        m
    }

    /// Weighted covariance of (t_x, t_y), square pixels: where the image's centre goes, about the mean of that.
    pub fn covariance(&self) -> DMat2 {
        let mean = self.mean();
        let one = |p: &Pose| {
            let d = DVec2::new(p.t_x - mean.t_x, p.t_y - mean.t_y);
            DMat2::from_cols(d * d.x, d * d.y) * p.weight
        };
        self.poses.iter().map(one).fold(DMat2::ZERO, |sum, m| sum + m)
    }
}

/// A frame's TSF as it stands in a TSF file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TsfEntry {
    /// File name of the frame (no folder).
    pub frame: String,
    /// Frame width in pixels.
    pub width: usize,
    /// Frame height in pixels.
    pub height: usize,
    /// Focal length in pixels.
    pub focal_px: f64,
    /// The poses.
    pub poses: Vec<Pose>,
    /// Motion of the frame as a whole before the poses (see [`Tsf::base`]), row by row; left out where it is the identity.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub base: Option<[[f64; 3]; 3]>,
}

impl TsfEntry {
    /// The entry of the frame `name` of `width` x `height` pixels.
    pub fn new(name: &str, width: usize, height: usize, tsf: &Tsf) -> Self {
        let base = (tsf.base != DMat3::IDENTITY).then(|| tsf.base.transpose().to_cols_array_2d());
        Self { frame: name.into(), width, height, focal_px: tsf.focal_px, poses: tsf.poses.clone(), base }
    }
}

/// A TSF file: `{"format":"unshaken-tsf","version":1,"frames":[...]}`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TsfFile {
    /// Always `unshaken-tsf`.
    pub format: String,
    /// Always 1.
    pub version: u32,
    /// One entry per frame.
    pub frames: Vec<TsfEntry>,
}

impl TsfFile {
    /// `format` of every TSF file.
    pub const FORMAT: &'static str = "unshaken-tsf";
    /// The version that this program reads and writes.
    pub const VERSION: u32 = 1;

    /// A file that holds `frames`.
    pub fn new(frames: Vec<TsfEntry>) -> Self {
        Self { format: Self::FORMAT.into(), version: Self::VERSION, frames }
    }

    /// Reads the text of a TSF file.
    ///
    /// # Errors
    /// [`Error::Input`] for text that is not such a file.
    pub fn parse(text: &str) -> Result<Self> {
        let file: Self = serde_json::from_str(text).map_err(|e| {
            Error::Input(format!("is not a TSF file ({e}); expected {{\"format\":\"unshaken-tsf\",\"version\":1,\"frames\":[...]}}"))
        })?;
        if file.format != Self::FORMAT || file.version != Self::VERSION {
            return Err(Error::Input(format!(
                "has format {:?} version {}; expected format \"unshaken-tsf\" version 1",
                file.format, file.version
            )));
        }
        Ok(file)
    }

    /// The TSF of the frame called `name`, checked against the frame's size; `None` when the file does not hold it.
    ///
    /// # Errors
    /// [`Error::Input`] for a size other than the frame's and for what [`Tsf::new`] refuses.
    pub fn find(&self, name: &str, width: usize, height: usize) -> Result<Option<Tsf>> {
        let Some(e) = self.frames.iter().find(|e| e.frame == name) else { return Ok(None) };
        if (e.width, e.height) != (width, height) {
            return Err(Error::Input(format!("TSF of {name} is for {} x {} pixels, the frame is {width} x {height}", e.width, e.height)));
        }
        let base = e.base.map_or(DMat3::IDENTITY, |b| DMat3::from_cols_array_2d(&b).transpose());
        let sound = base.is_finite() && base.determinant().abs() > 1e-3 && base.z_axis.z.abs() > 1e-3;
        if !sound {
            return Err(Error::Input(format!("TSF of {name}: its base is no homography that can be undone")));
        }
        let tsf = Tsf::new(e.focal_px, e.poses.clone()).map_err(|x| Error::Input(format!("TSF of {name}: {x}")))?;
        for pose in &tsf.poses {
            // Where the frame's centre goes: a pose that shows nothing of the frame is a mistake in units or sign.
            let centre = pose.apply(tsf.focal_px, DVec2::ZERO);
            if !(centre.x.abs() < width as f64 && centre.y.abs() < height as f64) {
                return Err(Error::Input(format!(
                    "TSF of {name}: pose {pose:?} moves the whole frame out of view; translations are pixels, angles degrees"
                )));
            }
        }
        Ok(Some(tsf.about(base)))
    }

    /// The same motions on frames whose sides are divided by `divisor` (and rounded down).
    pub fn reduced(&self, divisor: usize) -> Self {
        let factor = 1.0 / divisor as f64;
        let frames = self.frames.iter().map(|e| TsfEntry {
            width: e.width / divisor,
            height: e.height / divisor,
            focal_px: e.focal_px * factor,
            poses: e.poses.iter().map(|p| Pose { t_x: factor * p.t_x, t_y: factor * p.t_y, ..*p }).collect(),
            // In pixels: the third column grows with the frame, the third row shrinks.
            base: e.base.map(|[[a, b, c], [d, f, g], [h, i, j]]| [[a, b, c * factor], [d, f, g * factor], [h / factor, i / factor, j]]),
            ..e.clone()
        });
        Self::new(frames.collect())
    }
}
