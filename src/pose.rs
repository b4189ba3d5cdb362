//! Camera poses: [`Pose`], its homography Γ of eq. (2), and [`PoseGrid`], the sampled transformation space H.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// One camera pose with its weight: the fraction of the exposure time that the camera spent there.
///
/// A pose maps the latent scene on the reference grid to the frame: pixels, x right, y down, pixel centres at
/// integers, origin at the frame's centre ((W-1)/2, (H-1)/2); `p_frame = T(t_x, t_y) K R K^-1 p_scene` with
/// `K = diag(F, F, 1)` and `R = exp(Φ)` of eq. (2).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Translation to the right, pixels.
    pub t_x: f64,
    /// Translation down, pixels.
    pub t_y: f64,
    /// Pitch, degrees.
    #[serde(default)]
    pub theta_x_deg: f64,
    /// Yaw, degrees.
    #[serde(default)]
    pub theta_y_deg: f64,
    /// Roll, degrees.
    #[serde(default)]
    pub theta_z_deg: f64,
    /// Fraction of the exposure time, 0..=1.
    pub weight: f64,
}

impl Pose {
    /// The pose that moves nothing, with weight 1.
    pub const IDENTITY: Self = Self { t_x: 0.0, t_y: 0.0, theta_x_deg: 0.0, theta_y_deg: 0.0, theta_z_deg: 0.0, weight: 1.0 };

    /// A pose of the paper's 3-D transformation space (t_x, t_y in pixels, θ_z in degrees).
    pub fn planar(t_x: f64, t_y: f64, theta_z_deg: f64, weight: f64) -> Self {
        Self { t_x, t_y, theta_z_deg, weight, ..Self::IDENTITY }
    }

    /// Γ of eq. (2) in centred pixel coordinates, for focal length `focal_px` in pixels.
    pub fn homography(&self, focal_px: f64) -> DMat3 {
        DMat3::from_translation(DVec2::new(self.t_x, self.t_y)) * self.rotation(focal_px)
    }

    /// `K R K^-1`: the rotational part of Γ.
    pub fn rotation(&self, focal_px: f64) -> DMat3 {
        let v = DVec3::new(self.theta_x_deg, self.theta_y_deg, self.theta_z_deg) * std::f64::consts::PI / 180.0;
        let r = turn(v);
        let k = DMat3::from_diagonal(DVec3::new(focal_px, focal_px, 1.0));
        let h = k * r * k.inverse();
        h * (1.0 / h.z_axis.z)
    }

    /// Where Γ takes the scene point `p` (centred pixels).
    pub fn apply(&self, focal_px: f64, p: DVec2) -> DVec2 {
        project(&self.homography(focal_px), p)
    }
}

/// exp(Φ) of eq. (2), by Rodrigues. Sine and cosine are not the machine's own: a synthetic bracket is to be the same everywhere.
fn turn(v: DVec3) -> DMat3 {
    let angle = v.length();
    if angle < 1e-15 {
        return DMat3::IDENTITY;
    }
    let (sin, cos) = libm::sincos(angle);
    let a = v / angle;
    let (s, b) = (a * sin, a * (1.0 - cos));
    DMat3::from_cols(
        DVec3::new(cos + a.x * b.x, a.y * b.x + s.z, a.z * b.x - s.y),
        DVec3::new(a.x * b.y - s.z, cos + a.y * b.y, a.z * b.y + s.x),
        DVec3::new(a.x * b.z + s.y, a.y * b.z - s.x, cos + a.z * b.z),
    )
}

/// `h p` with the perspective division.
pub fn project(h: &DMat3, p: DVec2) -> DVec2 {
    let q = *h * DVec3::new(p.x, p.y, 1.0);
    DVec2::new(q.x / q.z, q.y / q.z)
}

/// [`project`] for many points: affine motions need no division.
#[derive(Clone, Copy, Debug)]
pub struct Projection {
    h: DMat3,
    affine: bool,
}

impl Projection {
    /// That of `h`.
    pub fn new(h: DMat3) -> Self {
        Self { h, affine: h.x_axis.z == 0.0 && h.y_axis.z == 0.0 && h.z_axis.z == 1.0 }
    }

    /// Where it takes `p`.
    #[inline(always)]
    pub fn of(&self, p: DVec2) -> DVec2 {
        if self.affine {
            self.h.x_axis.truncate() * p.x + self.h.y_axis.truncate() * p.y + self.h.z_axis.truncate()
        } else {
            project(&self.h, p)
        }
    }
}

/// Index, row by row, of the pixel of a `width` x `height` frame nearest to where `h` (centred pixels) takes the pixel (x, y); `None` outside.
pub fn nearest_pixel(h: &DMat3, width: usize, height: usize, x: usize, y: usize) -> Option<usize> {
    let centre = DVec2::new(0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let q = project(h, DVec2::new(x as f64, y as f64) - centre) + centre;
    let (i, j) = (q.x.round(), q.y.round());
    (i >= 0.0 && j >= 0.0 && i < width as f64 && j < height as f64).then(|| j as usize * width + i as usize)
}

/// The sampled transformation space H of section II-B: integer translations and equally spaced roll angles.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseGrid {
    /// Translations are the integers of `-radius..=radius`, pixels, in x and in y.
    pub radius: usize,
    /// Roll angles θ_z in degrees, ascending, equally spaced.
    pub angles_deg: Vec<f64>,
}

impl PoseGrid {
    /// Grid with translations up to `radius` pixels and angles up to `max_deg`, whose angle step moves the farthest
    /// pixel of a `width` x `height` frame by at most `corner_step` pixels.
    pub fn new(width: usize, height: usize, radius: usize, max_deg: f64, corner_step: f64) -> Self {
        let corner = 0.5 * (width as f64).hypot(height as f64);
        let step = (corner_step / corner.max(1.0)).to_degrees();
        let n = (max_deg / step).ceil().max(0.0) as i64;
        let step = if n > 0 { max_deg / n as f64 } else { 0.0 };
        Self { radius, angles_deg: (-n..=n).map(|i| i as f64 * step).collect() }
    }

    /// Angle between neighbours, degrees (0 for a single angle).
    pub fn step_deg(&self) -> f64 {
        if self.angles_deg.len() < 2 { 0.0 } else { self.angles_deg[1] - self.angles_deg[0] }
    }
}
