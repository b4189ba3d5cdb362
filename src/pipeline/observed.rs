//! Frames as the solver and the estimators get them: placed, weighed, merged.

use super::Run;
use crate::deblur::{self, Observation};
use crate::image::{Channels, Plane, Rgb};
use crate::kernels::{STILL, UNSEEN};
use crate::mask;
use crate::merge;
use crate::tsf::Tsf;
use glam::DMat3;
use std::borrow::Cow;

/// Most pixels by which the latent grid surrounds the frame, as a part of the frame's longer side.
const LARGEST_PAD: f64 = 0.15;
/// Relative error of a merge that was resampled.
const AT_THE_BORDER: f32 = 0.04;

impl Run<'_> {
    /// Masks of all frames, of which `sharp` are sharp, and how the blurs of the others of the frames `used` are looked at.
    pub(super) fn weigh(&mut self, sharp: &[bool], used: &[usize]) {
        let masks = |c| mask::masks(self.bracket.frames(), sharp, self.settings.alpha as f32, &self.motions, c);
        let (still, moved): (Vec<usize>, Vec<usize>) = used.iter().partition(|&&i| sharp[i]);
        let by = if still.is_empty() { &moved } else { &still };
        let look = |i: usize| {
            let channels = if moved.contains(&i) { self.most_telling(&[i], by) } else { Channels::ALL };
            (channels, (channels != Channels::ALL).then(|| masks(channels).swap_remove(i)))
        };
        self.looks = (0..sharp.len()).map(look).collect();
        self.masks = masks(Channels::ALL);
        // Of a frame that turned out to be shaken nothing of the kind is known.
        self.ghosts.iter_mut().zip(sharp).for_each(|(ghost, sharp)| *ghost = ghost.take().filter(|_| *sharp));
        for (mask, kept) in self.masks.iter_mut().zip(&self.ghosts) {
            if let Some(kept) = kept {
                *mask = mask.zip(kept, |m, k| m * k);
            }
        }
    }

    /// What displaced ones of the sharp frames `ids` (`observations`, in that order) show of the pixels next to the border of the latent grid, merged as they
    /// lie, where no frame in place shows them: the warp of a frame that lies between them reaches beyond the border, so that it does not count there, and
    /// what is left of it two pixels farther in, a hundredth of their light, would tell any nonsense of them.
    pub(super) fn at_the_border(&self, ids: &[usize], observations: &[Observation]) -> Option<Observation> {
        let (w, h) = self.bracket.size();
        let reach = STILL.support();
        let (in_place, displaced): (Vec<usize>, Vec<usize>) =
            (0..ids.len()).filter(|&k| observations[k].tsf.single().is_some()).partition(|&k| observations[k].tsf.is_identity());
        let displaced: Vec<usize> = displaced.into_iter().map(|k| ids[k]).collect();
        if displaced.is_empty() {
            return None;
        }
        let masks: Vec<&Plane> = in_place.into_iter().map(|k| &self.masks[ids[k]]).collect();
        let lost = |p: usize| masks.iter().all(|m| m.data[p] == 0.0);
        let edge = |a: usize, n: usize| a < reach || a + reach >= n;
        let counts = |x: usize, y: usize| (edge(x, w) || edge(y, h)) && lost(y * w + x);
        let mask = Plane::from_fn(w, h, |x, y| f32::from(counts(x, y)));
        if !mask.data.contains(&1.0) {
            return None;
        }
        let (merged, _) = self.start(&displaced, 0);
        let brightest = (0..w * h).filter(|&p| mask.data[p] > 0.0).flat_map(|p| merged.pixel(p)).fold(0.0, f32::max);
        if brightest <= 0.0 {
            return None;
        }
        let steps = self.curves[ids[0]][0].len();
        let noise = (0..steps).map(|k| AT_THE_BORDER * (k as f32 / (steps - 1) as f32).powi(2).max(1e-6)).collect::<Vec<_>>();
        Some(Observation {
            exposure: merged.map_planes(|p| p.map(|v| (v / brightest).min(1.0))),
            mask,
            exposure_time: 1.0 / f64::from(brightest),
            noise: std::array::from_fn(|_| noise.clone()),
            black_clipped: false,
            tsf: Tsf::identity(),
        })
    }

    /// Pixels by which the latent grid surrounds frames under `tsfs`.
    pub(super) fn pad<'t>(&self, tsfs: impl Iterator<Item = &'t Tsf>) -> usize {
        let (w, h) = self.bracket.size();
        deblur::pad_for(&tsfs.collect::<Vec<_>>(), w, h, (LARGEST_PAD * w.max(h) as f64) as usize)
    }

    /// The mask by which frame `i` counts in the solver. `clipped`: its [`mask::spoilt_channels`].
    pub(super) fn counting(&self, i: usize, clipped: &[Vec<bool>; 3]) -> Plane {
        let kept = self.ghosts[i].as_ref();
        let share = |p: usize| kept.map_or(1.0, |k| k.data[p]);
        mask::with_partly_clipped(&self.masks[i], &self.bracket.frames()[i], clipped, self.settings.alpha as f32, share)
    }

    /// Frame `i`, every channel that is not clipped by itself.
    pub(super) fn observation(&self, i: usize, tsf: Tsf) -> Observation {
        let frame = &self.bracket.frames()[i];
        let mut exposure = self.exposures[i].clone();
        let clipped = mask::spoilt_channels(frame);
        for (plane, clipped) in exposure.0.iter_mut().zip(&clipped) {
            plane.data.iter_mut().zip(clipped).filter(|(_, clipped)| **clipped).for_each(|(e, _)| *e = UNSEEN);
        }
        if let Some(finer) = &self.aliasing[i] {
            for (e, f) in exposure.0.iter_mut().zip(&finer.0) {
                *e = e.zip(f, |e, f| if e == UNSEEN { e } else { e - f });
            }
        }
        Observation {
            exposure,
            mask: self.counting(i, &clipped),
            exposure_time: frame.exposure_time,
            noise: self.curves[i].clone(),
            black_clipped: true,
            tsf,
        }
    }

    /// Exposures and masks of the frames `ids` as registration places them, on the reference's grid plus `pad` pixels on every side; of
    /// the others as they are. Nothing is copied where nothing moves.
    pub(super) fn placed<'m>(&'m self, ids: &[usize], masks: &'m [Plane], pad: usize) -> (Cow<'m, [Rgb]>, Cow<'m, [Plane]>) {
        let moves = |i: usize| pad > 0 || self.motions[i] != DMat3::IDENTITY;
        if !ids.iter().any(|&i| moves(i)) {
            return (Cow::Borrowed(&self.exposures), Cow::Borrowed(masks));
        }
        let placed = (0..masks.len()).map(|i| {
            if ids.contains(&i) && moves(i) {
                merge::resampled(&self.exposures[i], &masks[i], &self.motions[i], pad)
            } else {
                (self.exposures[i].clone(), masks[i].clone())
            }
        });
        let (exposures, masks): (Vec<Rgb>, Vec<Plane>) = placed.unzip();
        (Cow::Owned(exposures), Cow::Owned(masks))
    }

    /// Merge of the frames `ids`, placed but not deblurred, on the reference's grid plus `pad` pixels on every side, and where any of
    /// them is not masked.
    pub(super) fn start(&self, ids: &[usize], pad: usize) -> (Rgb, Plane) {
        let (exposures, masks) = self.placed(ids, &self.masks, pad);
        let merged = merge::irradiance(self.bracket, &exposures, &masks, &self.curves, ids);
        let (w, h) = merged.size();
        (merged, Plane::from_fn(w, h, |x, y| ids.iter().map(|&i| masks[i].data[y * w + x]).fold(0.0, f32::max)))
    }

    /// `image`, which lies on the reference's grid plus `own` pixels on every side, on that plus `pad` pixels. What it lacks is what
    /// the frames show that see it: the sharp ones, where none the others; and beyond all of them the nearest pixel.
    pub(super) fn surrounded(&self, image: &Rgb, own: usize, pad: usize, still: &[usize], shaken: &[usize]) -> Rgb {
        let (w, h) = self.bracket.size();
        let nearest = |x: usize, y: usize| ((x + own) as isize - pad as isize, (y + own) as isize - pad as isize);
        let displaced = |ids: &[usize]| -> Option<(Rgb, Plane)> {
            let moved = ids.iter().any(|&i| self.motions[i] != DMat3::IDENTITY);
            (pad > own && moved).then(|| self.start(ids, pad))
        };
        let around = [displaced(still), displaced(shaken)];
        let within = |a: isize, n: usize| a >= 0 && (a as usize) < n + 2 * own;
        Rgb(std::array::from_fn(|c| {
            Plane::from_fn(w + 2 * pad, h + 2 * pad, |x, y| {
                let (i, j) = nearest(x, y);
                let beyond = !(within(i, w) && within(j, h));
                let other = around.iter().flatten().find(|(_, seen)| beyond && seen.data[y * seen.width + x] > 0.0);
                other.map_or_else(|| image.0[c].clamped(i, j), |(shown, seen)| shown.0[c].data[y * seen.width + x])
            })
        }))
    }

    /// The irradiance `latent` on the grid of a frame at `motion`, and 1 where it reaches.
    pub(super) fn seen<'r>(&self, latent: &'r Rgb, motion: &DMat3) -> (Cow<'r, Rgb>, Plane) {
        let everywhere = self.masks[0].map(|_| 1.0);
        if *motion == DMat3::IDENTITY {
            return (Cow::Borrowed(latent), everywhere);
        }
        let (seen, inside) = merge::resampled(latent, &everywhere, &motion.inverse(), 0);
        (Cow::Owned(seen), inside)
    }
}
