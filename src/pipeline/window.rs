//! A part of the frames in place of the whole: where blurs are a few pixels long it tells as much.

use super::Run;
use crate::blind::Frame;
use crate::image::Plane;
use crate::pose::project;
use crate::psf;
use crate::tsf::Tsf;
use glam::{DMat3, DVec2};

/// A part of some frames that lies on the same part of the scene in all of them, to the pixel.
pub(super) struct Window {
    /// Its upper left corner in the reference frame, pixels.
    pub(super) at: (usize, usize),
    /// Its width and height in pixels.
    pub(super) size: (usize, usize),
    /// Its centre in the reference frame, centred pixels.
    pub(super) centre: DVec2,
    /// How far it lies from there in each of the frames, whole pixels.
    pub(super) shifts: Vec<DVec2>,
}

impl Window {
    /// Its upper left corner in the frame `k` of them.
    fn place(&self, k: usize) -> (usize, usize) {
        ((self.at.0 as f64 + self.shifts[k].x) as usize, (self.at.1 as f64 + self.shifts[k].y) as usize)
    }

    /// What it shows of `plane`, the frame `k`'s.
    pub(super) fn crop(&self, plane: &Plane, k: usize) -> Plane {
        let (x, y) = self.place(k);
        plane.crop(x, y, self.size.0, self.size.1)
    }

    /// The `frames` within it.
    pub(super) fn cut(&self, frames: &[Frame]) -> Vec<Frame> {
        frames.iter().enumerate().map(|(k, f)| f.crop(self.place(k), self.size)).collect()
    }

    /// `tsf` of the frame `k` as the window sees it: exact where it has no rotations out of the image plane, else true at its centre.
    pub(super) fn seen(&self, k: usize, tsf: &Tsf) -> Tsf {
        let here = self.centre + self.shifts[k];
        tsf.around(here).about(DMat3::from_translation(-here) * tsf.base * DMat3::from_translation(self.centre))
    }

    /// The way back: `tsf` that was found in the window of the frame `k`, on the frame.
    pub(super) fn on_frame(&self, k: usize, tsf: &Tsf) -> Tsf {
        let here = self.centre + self.shifts[k];
        tsf.around(-here).about(DMat3::from_translation(here) * tsf.base * DMat3::from_translation(-self.centre))
    }

    /// Left, top, width and height in the reference frame.
    pub(super) fn report(&self) -> [usize; 4] {
        [self.at.0, self.at.1, self.size.0, self.size.1]
    }
}

/// Least side of it.
const LEAST_WINDOW: usize = 96;

impl Run<'_> {
    /// How far the point `c` of the reference frame (centred pixels) lies from there in frame `i`: to the pixel.
    pub(super) fn shift(&self, i: usize, c: DVec2) -> DVec2 {
        (project(&self.motions[i], c) - c).round()
    }

    /// The part with much texture of `frames`, whose luminances are `whole`, of `most` (longer and shorter side) pixels at most; `None` where there is none to be
    /// had.
    pub(super) fn window(&self, frames: &[usize], whole: &[Frame], most: (usize, usize)) -> Option<Window> {
        let (w, h) = self.bracket.size();
        let corner = DVec2::new(0.5 * w as f64, 0.5 * h as f64);
        let corners = [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)].map(|(x, y)| DVec2::new(x, y) * corner);
        let margin = frames.iter().flat_map(|&i| corners.map(|c| self.shift(i, c).abs())).fold(DVec2::ZERO, DVec2::max);
        let room = |n: usize, m: f64| n.saturating_sub(2 * m as usize);
        let (rw, rh) = (room(w, margin.x), room(h, margin.y));
        let longest = |n: usize, other: usize| n.min(if n >= other { most.0 } else { most.1 });
        let (ww, wh) = (longest(rw, rh), longest(rh, rw));
        if ww.min(wh) < LEAST_WINDOW {
            return None;
        }
        let (mx, my) = (margin.x as usize, margin.y as usize);
        let first = &whole[0];
        let weight = first.mask.zip(&first.variance, |m, v| m * m / v);
        let seen = |p: &Plane| p.crop(mx, my, rw, rh);
        let best = psf::choose(&seen(&first.blurred), &seen(&weight), ww.min(wh), 1).first().copied()?;
        let (x, y) = (mx + best.x.min(rw - ww), my + best.y.min(rh - wh));
        let centre = DVec2::new(x as f64 + 0.5 * (ww as f64 - w as f64), y as f64 + 0.5 * (wh as f64 - h as f64));
        Some(Window { at: (x, y), size: (ww, wh), centre, shifts: frames.iter().map(|&i| self.shift(i, centre)).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::Pose;

    #[test]
    fn a_window_sees_what_the_frame_sees() {
        let window =
            Window { at: (700, 90), size: (320, 240), centre: DVec2::new(360.5, -89.5), shifts: vec![DVec2::ZERO, DVec2::new(-7.0, 3.0)] };
        let base =
            DMat3::from_translation(DVec2::new(-6.8, 3.3)) * DMat3::from_angle(0.01) * DMat3::from_translation(DVec2::new(0.2, -0.1));
        let poses = vec![Pose::planar(1.5, -0.5, 0.3, 0.6), Pose::planar(-2.0, 1.0, -0.2, 0.4)];
        let tsf = Tsf::new(900.0, poses).unwrap().about(base);
        let seen = window.seen(1, &tsf);
        let corner = window.centre + window.shifts[1];
        for p in [DVec2::ZERO, DVec2::new(-150.0, 100.0), DVec2::new(120.5, -80.25)] {
            for (here, there) in seen.poses.iter().zip(&tsf.poses) {
                let found = here.apply(seen.focal_px, project(&seen.base, p));
                let want = there.apply(tsf.focal_px, project(&tsf.base, p + window.centre)) - corner;
                assert!((found - want).length() < 1e-9, "{p}: {found} for {want}");
            }
        }
        let back = window.on_frame(1, &seen);
        for (found, want) in back.poses.iter().zip(&tsf.poses) {
            assert!(
                (found.t_x - want.t_x).abs() + (found.t_y - want.t_y).abs() < 1e-9 && found.theta_z_deg == want.theta_z_deg,
                "{found:?}"
            );
        }
        assert!(back.base.abs_diff_eq(tsf.base, 1e-9), "{}", back.base);
        // Out of the image plane: true at the window's centre.
        let turned = Tsf::new(900.0, vec![Pose { theta_x_deg: 0.4, theta_y_deg: -0.3, ..Pose::planar(1.0, 2.0, 0.1, 1.0) }]).unwrap();
        let (found, pose) = (window.seen(0, &turned), turned.poses[0]);
        let centre = pose.apply(900.0, window.centre) - window.centre;
        assert!((found.poses[0].apply(900.0, DVec2::ZERO) - centre).length() < 1e-9, "{found:?}");
    }
}
