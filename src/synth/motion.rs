//! What the camera does during one exposure: tremor, a TSF on the paper's grid, a gyroscope's record, or motion in six degrees of freedom.

use super::gyro::GyroRecord;
use super::shake::{Tremor, Wander, identity};
use crate::error::{Error, Result};
use crate::pose::Pose;
use crate::random::Random;
use crate::tsf::Tsf;
use glam::{DMat3, DVec3};
use std::collections::BTreeMap;

/// The camera's motion during one exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    /// The poses as a TSF. With motion along the optical axis (`nearing`) they are the closest that a TSF can say.
    pub tsf: Tsf,
    /// T_Z / d_o of eq. (2) for each pose; empty where the camera keeps its distance.
    pub nearing: Vec<f64>,
    /// Whether the camera moved during the exposure; a frame that is merely displaced is sharp.
    pub shaken: bool,
}

/// How a frame's motion comes about.
#[derive(Clone, Debug)]
pub enum Shake {
    /// Smooth random tremor in t_x, t_y and θ_z, off every grid.
    Tremor(Tremor),
    /// Tremor rounded to the paper's grid (section IV): t_x and t_y in whole pixels from -12 to 12, θ_z from -1.5° to 1.5° by 0.25°.
    Grid(Tremor),
    /// Rotations of a gyroscope's record from a random moment on, times `strength`.
    Gyro {
        /// The record.
        record: GyroRecord,
        /// Factor on the angles; 1 is the hand as recorded.
        strength: f64,
    },
    /// Tremor in six degrees of freedom before a flat scene, by eq. (2).
    SixD(Wobble),
}

/// Extents of a tremor in six degrees of freedom.
#[derive(Clone, Debug)]
pub struct Wobble {
    /// Largest extent of T_X or T_Y, metres.
    pub shift_m: f64,
    /// Extent of T_Z, metres.
    pub nearing_m: f64,
    /// Largest extent of pitch or yaw, degrees.
    pub tilt_deg: f64,
    /// Extent of roll, degrees.
    pub roll_deg: f64,
    /// Distance d_o of the scene, metres.
    pub depth_m: f64,
}

impl Motion {
    /// Motion through the poses of `tsf`.
    pub fn new(tsf: Tsf, shaken: bool) -> Self {
        Self { tsf, nearing: Vec::new(), shaken }
    }

    /// Homographies frame ← scene in centred pixels, with weights: eq. (2) exactly, T_Z included.
    pub fn homographies(&self) -> Vec<(DMat3, f64)> {
        let focal = self.tsf.focal_px;
        let poses = self.tsf.poses.iter().enumerate();
        poses
            .map(|(i, p)| {
                let Some(nearing) = self.nearing.get(i).copied() else { return (p.homography(focal), p.weight) };
                // v (T_X, T_Y) / d_o such that the frame's centre goes where the TSF's pose takes it.
                let rotated = p.rotation(focal).z_axis;
                let scale = 1.0 + nearing;
                let t = DVec3::new((rotated.x + p.t_x) * scale - rotated.x, (rotated.y + p.t_y) * scale - rotated.y, nearing);
                let h = p.rotation(focal);
                (DMat3::from_cols(h.x_axis, h.y_axis, h.z_axis + t), p.weight)
            })
            .collect()
    }

    /// The same motion displaced by (t_x, t_y) pixels and θ_z degrees.
    pub fn displaced(mut self, t_x: f64, t_y: f64, theta_z_deg: f64) -> Self {
        for p in &mut self.tsf.poses {
            p.t_x += t_x;
            p.t_y += t_y;
            p.theta_z_deg += theta_z_deg;
        }
        self
    }
}

impl Shake {
    /// Motion during an exposure of `exposure_time` seconds of a frame of `width` x `height` pixels, with a focal length of `focal_px`
    /// pixels. `part` (0..=1) scales the extents, as short exposures see less of a tremor. No two successive poses move any pixel by
    /// more than `step_px` (except on the grid, whose poses are what it has).
    ///
    /// # Errors
    /// [`Error::Input`] for settings that are not finite or a motion that is not one.
    pub fn motion(
        &self,
        width: usize,
        height: usize,
        focal_px: f64,
        exposure_time: f64,
        part: f64,
        step_px: f64,
        seed: u64,
        stream: u64,
    ) -> Result<Motion> {
        let mut random = Random::new(seed, stream);
        let scale = |t: &Tremor| Tremor { extent_px: t.extent_px * part, roll_deg: t.roll_deg * part, ..t.clone() };
        let corner = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
        let path: Path = match self {
            Self::Tremor(t) | Self::Grid(t) => planar(&scale(t), exposure_time, &mut random),
            Self::Gyro { record, strength } => {
                let start = random.uniform(0.0, 2.0 * record.duration());
                let (record, strength) = (record.clone(), *strength);
                Box::new(move |t| {
                    let [pitch, yaw, roll] = record.at(start + t * exposure_time).map(|v| v * strength);
                    [0.0, 0.0, 0.0, pitch, yaw, roll]
                })
            }
            Self::SixD(w) => wobble(w, focal_px, exposure_time, part, &mut random),
        };
        // Where the frame's corners go decides how finely time is cut.
        let probe = 2048;
        let homography = |v: [f64; 6]| pose(v, 1.0).homography(focal_px) * DMat3::from_diagonal(DVec3::new(1.0, 1.0, 1.0 + v[2]));
        let corners = |v: [f64; 6]| {
            let h = homography(v);
            [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(i, j)| {
                let q = h * DVec3::new(i * corner.0, j * corner.1, 1.0);
                (q.x / q.z, q.y / q.z)
            })
        };
        let at = |i: usize, n: usize| path((i as f64 + 0.5) / n as f64);
        let mut longest = 0f64;
        let mut last = corners(at(0, probe));
        for i in 1..probe {
            let next = corners(at(i, probe));
            for (a, b) in last.iter().zip(&next) {
                longest = longest.max(((a.0 - b.0) * (a.0 - b.0) + (a.1 - b.1) * (a.1 - b.1)).sqrt());
            }
            last = next;
        }
        if !longest.is_finite() || step_px.is_nan() || step_px <= 0.0 {
            return Err(Error::Input("the shake holds a number that is not finite, or steps of no length".into()));
        }
        let n = ((longest * probe as f64 / step_px).ceil() as usize).clamp(2, 200_000);
        let samples: Vec<[f64; 6]> = (0..n).map(|i| at(i, n)).collect();
        let mean: [f64; 6] = std::array::from_fn(|d| samples.iter().map(|s| s[d]).sum::<f64>() / n as f64);
        // The motion is about the reference pose, or near it: a frame's mean pose is rarely the reference's.
        let offset = match self {
            Self::Tremor(t) | Self::Grid(t) => {
                let mut draw = |range: f64| random.uniform(-1.0, 1.0) * range;
                [draw(t.offset_px), draw(t.offset_px), 0.0, 0.0, 0.0, draw(t.offset_deg)]
            }
            _ => [0.0; 6],
        };
        let samples = samples.into_iter().map(|s| std::array::from_fn(|d| s[d] - mean[d] + offset[d]));
        if let Self::Grid(_) = self {
            return Ok(Motion::new(Tsf::new(focal_px, on_grid(samples))?, true));
        }
        let samples: Vec<[f64; 6]> = samples.collect();
        let poses = samples.iter().map(|s| pose(*s, 1.0)).collect();
        let nearing = if matches!(self, Self::SixD(_)) { samples.iter().map(|s| s[2]).collect() } else { Vec::new() };
        Ok(Motion { tsf: Tsf::new(focal_px, poses)?, nearing, shaken: true })
    }

    /// The motion of a frame that did not move.
    pub fn none(width: usize) -> Motion {
        Motion::new(identity(width), false)
    }
}

/// t_x, t_y in pixels, T_Z / d_o, pitch, yaw, roll in degrees at a moment 0..1 of the exposure.
type Path = Box<dyn Fn(f64) -> [f64; 6]>;

fn pose(v: [f64; 6], weight: f64) -> Pose {
    Pose { t_x: v[0], t_y: v[1], theta_x_deg: v[3], theta_y_deg: v[4], theta_z_deg: v[5], weight }
}

/// `n` wanders over `exposure_time` seconds, each of unit range, as functions of the moment 0..1.
fn wanders(n: usize, groups: &[&[usize]], exposure_time: f64, random: &mut Random) -> Vec<impl Fn(f64) -> f64 + use<>> {
    let duration = exposure_time.max(0.05);
    let all: Vec<Wander> = (0..n).map(|_| Wander::new(random)).collect();
    let range = |w: &Wander| {
        let samples = (0..2048).map(|i| w.at(duration * ((f64::from(i) + 0.5) / 2048.0 - 0.5)));
        let (a, b) = samples.fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        (b - a).max(1e-9)
    };
    let ranges: Vec<f64> = all.iter().map(range).collect();
    // Directions of one kind share a scale, so that the larger reaches its extent.
    let scale: Vec<f64> = (0..n)
        .map(|d| groups.iter().find(|g| g.contains(&d)).map_or(ranges[d], |g| g.iter().map(|&k| ranges[k]).fold(0.0, f64::max)))
        .collect();
    all.into_iter().zip(scale).map(|(w, s)| move |t: f64| w.at(duration * (t - 0.5)) / s).collect()
}

fn planar(t: &Tremor, exposure_time: f64, random: &mut Random) -> Path {
    let w = wanders(3, &[&[0, 1]], exposure_time, random);
    let (extent, roll) = (t.extent_px, t.roll_deg);
    Box::new(move |t| [extent * w[0](t), extent * w[1](t), 0.0, 0.0, 0.0, roll * w[2](t)])
}

fn wobble(w: &Wobble, focal_px: f64, exposure_time: f64, part: f64, random: &mut Random) -> Path {
    let path = wanders(6, &[&[0, 1], &[3, 4]], exposure_time, random);
    // Eq. (2): T / d_o, times v in pixels for the components across the optical axis.
    let (shift, nearing) = (focal_px * w.shift_m / w.depth_m * part, w.nearing_m / w.depth_m * part);
    let (tilt, roll) = (w.tilt_deg * part, w.roll_deg * part);
    let extent = [shift, shift, nearing, tilt, tilt, roll];
    Box::new(move |t| std::array::from_fn(|d| extent[d] * path[d](t)))
}

/// Largest translation of the paper's grid, pixels (section IV).
const GRID_PX: f64 = 12.0;
/// Largest roll of the paper's grid and its step, degrees.
const GRID_DEG: (f64, f64) = (1.5, 0.25);

/// Poses of the paper's grid nearest to `samples`, weighted by how many samples each holds.
fn on_grid(samples: impl Iterator<Item = [f64; 6]>) -> Vec<Pose> {
    let mut cells: BTreeMap<(i64, i64, i64), u32> = BTreeMap::new();
    for s in samples {
        let whole = |v: f64| v.clamp(-GRID_PX, GRID_PX).round() as i64;
        let angle = (s[5].clamp(-GRID_DEG.0, GRID_DEG.0) / GRID_DEG.1).round() as i64;
        *cells.entry((whole(s[0]), whole(s[1]), angle)).or_default() += 1;
    }
    let cell = |((x, y, a), n): ((i64, i64, i64), u32)| Pose::planar(x as f64, y as f64, a as f64 * GRID_DEG.1, f64::from(n));
    cells.into_iter().map(cell).collect()
}
