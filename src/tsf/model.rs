//! Motion models: which of a pose's coordinates move.

use crate::pose::Pose;
use glam::DVec2;
use serde::{Deserialize, Serialize};

/// What the camera may do during an exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Model {
    /// The simplest of the others that explains parts of the frame which it was not fitted to as well as any.
    #[default]
    Auto,
    /// t_x, t_y: the same blur everywhere (uniform blur).
    Translation,
    /// t_x, t_y, θ_z: the paper's transformation space.
    Rigid,
    /// θ_x, θ_y, θ_z: a camera that turns without moving. Needs a focal length.
    Rotation,
    /// t_x, t_y, θ_x, θ_y, θ_z. Needs a focal length.
    Full,
}

impl Model {
    /// All models, in the order of the command line's help.
    pub const ALL: [Self; 5] = [Self::Auto, Self::Rigid, Self::Translation, Self::Rotation, Self::Full];

    /// Name on the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Translation => "translation",
            Self::Rigid => "rigid",
            Self::Rotation => "rotation",
            Self::Full => "full",
        }
    }

    /// The model called `name`.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.name() == name)
    }
}

/// A model's coordinates on one frame, all in pixels so that steps of 1 mean the same: the motion of the frame's centre, and what
/// roll (at the corner) and perspective (pitch and yaw, at the middle of the sides, centre held) add to it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Chart {
    pub model: Model,
    pub focal: f64,
    /// Distance of the corner from the centre.
    corner: f64,
    /// Half the longer side.
    half: f64,
}

/// Coordinates of a pose: centre x, centre y, roll, perspective x (yaw), perspective y (pitch).
pub(super) type Coordinates = [f64; 5];

impl Chart {
    pub fn new(model: Model, focal: f64, width: usize, height: usize) -> Self {
        Self { model, focal, corner: 0.5 * (width as f64).hypot(height as f64), half: 0.5 * width.max(height) as f64 }
    }

    /// How many of the coordinates the model moves: the first ones.
    pub fn free(&self) -> usize {
        match self.model {
            Model::Translation => 2,
            Model::Rigid | Model::Rotation => 3,
            Model::Full | Model::Auto => 5,
        }
    }

    /// Coordinates of `pose`, forced into the model.
    pub fn coordinates(&self, pose: &Pose) -> Coordinates {
        let (pitch, yaw) = (pose.theta_x_deg.to_radians(), pose.theta_y_deg.to_radians());
        let perspective = self.half * self.half / self.focal;
        let mut c = [
            pose.t_x + self.focal * yaw.tan(),
            pose.t_y - self.focal * pitch.tan(),
            pose.theta_z_deg.to_radians() * self.corner,
            yaw * perspective,
            pitch * perspective,
        ];
        for v in c.iter_mut().skip(self.free()) {
            *v = 0.0;
        }
        c
    }

    /// The pose at `c`.
    pub fn pose(&self, c: &Coordinates, weight: f64) -> Pose {
        let perspective = self.half * self.half / self.focal;
        let (t, yaw, pitch) = match self.model {
            Model::Rotation => (DVec2::ZERO, (c[0] / self.focal).atan(), (-c[1] / self.focal).atan()),
            Model::Full | Model::Auto => {
                let (yaw, pitch) = (c[3] / perspective, c[4] / perspective);
                (DVec2::new(c[0] - self.focal * yaw.tan(), c[1] + self.focal * pitch.tan()), yaw, pitch)
            }
            Model::Translation | Model::Rigid => (DVec2::new(c[0], c[1]), 0.0, 0.0),
        };
        let roll = if self.model == Model::Translation { 0.0 } else { c[2] / self.corner };
        Pose { t_x: t.x, t_y: t.y, theta_x_deg: pitch.to_degrees(), theta_y_deg: yaw.to_degrees(), theta_z_deg: roll.to_degrees(), weight }
    }

    /// How the frame point `p` (centred) moves per unit of each coordinate, first order in the angles, which are a few degrees.
    ///
    /// Yaw b moves it by `(b F + b x²/F, b x y/F)`, pitch a by `(-a x y/F, -a F - a y²/F)`.
    #[inline(always)]
    pub fn motion(&self, p: DVec2) -> [DVec2; 5] {
        let roll = DVec2::new(-p.y, p.x) / self.corner;
        if self.model == Model::Rotation {
            let s = 1.0 / (self.focal * self.focal);
            return [DVec2::X + p * (p.x * s), DVec2::Y + p * (p.y * s), roll, DVec2::ZERO, DVec2::ZERO];
        }
        let s = 1.0 / (self.half * self.half);
        [DVec2::X, DVec2::Y, roll, p * (p.x * s), -p * (p.y * s)]
    }
}
