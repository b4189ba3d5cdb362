//! The stage for brackets without a sharp frame: what [`crate::blind`] needs of the run, and whether its answer is believed.

use super::{Event, Run, Settings};
use crate::blind::{self, Begun, Doubt, Frame, Known, Lack, PatchSetup, Start};
use crate::error::{Error, Result};
use crate::image::{Channels, Plane, Rgb};
use crate::mask;
use crate::merge;
use crate::psf::{self, Patch, Psf};
use crate::tsf::{self, Tsf};
use glam::DMat3;
use rayon::prelude::*;
use serde_json::{Value, json};

/// Energy of differences over that of those twice as long, in the softest direction, below which a frame may have moved: sharp frames of the benchmark have 0.65, one that moved by 6 px
/// 0.47. A soft lens has such edges too: being asked costs time alone.
const SOFT: f64 = 0.55;
/// The same above which structure is as fine as the pixels: brackets of cameras have 0.28 to 0.47 in the mean (lens and mosaic), scenes that are sampled without a lens and photographs that were reduced in size
/// 0.52 to 0.65.
const PIXEL_SHARP: f64 = 0.5;
/// Longest differences that are looked at where shorter ones are noise, pixels.
const LONGEST: usize = 4;
/// Times its noise that a frame's energy has to be for its edges to tell.
const CLEAR: f64 = 3.0;

/// What is done when no frame is sharp.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Blind {
    /// [`Blind::Joint`] when no frame is sharp, and when none is surely sharp and the estimate finds that all of them moved.
    #[default]
    Auto,
    /// Irradiance and the TSFs of all frames together, whatever the judgements of the frames.
    Joint,
    /// The paper's path (section III-B), whatever the judgements of the frames: PSFs of pairs of patches, aligned; TSFs from them.
    Patches,
    /// The sharpest frame counts as sharp whatever it shows.
    Off,
}

/// Irradiance to start from and one TSF for each of the frames used.
#[derive(Clone)]
pub(super) struct Found {
    pub start: Rgb,
    pub tsfs: Vec<Tsf>,
    pub reference: usize,
    /// Whether the TSFs were estimated at a smaller size than the frame's.
    pub reduced: bool,
}

impl Settings {
    /// How [`Blind::Patches`] looks at the patches.
    pub(crate) fn patch_setup(&self) -> PatchSetup {
        let usual = PatchSetup::default();
        let side = self.patch_size.unwrap_or(usual.side);
        let radius = self.psf_radius.unwrap_or(usual.pair.radius).clamp(1, (side / 4).max(1));
        PatchSetup { side, pair: psf::Setup { radius, ..usual.pair }, ..usual }
    }
}

impl Run<'_> {
    /// Masks by which the mean of `channels` counts in a bracket of which the frames `still` alone are sharp.
    fn masks_with(&self, still: &[usize], channels: Channels) -> Vec<Plane> {
        let frames = self.bracket.frames();
        let sharp: Vec<bool> = (0..frames.len()).map(|i| still.contains(&i)).collect();
        mask::masks(frames, &sharp, self.settings.alpha as f32, &self.motions, channels)
    }

    /// Luminance of the frames `ids`: the mean of `channels`.
    pub(super) fn luminance_frames(&self, ids: &[usize], channels: Channels) -> Vec<Frame> {
        let masks = self.masks_with(&[], channels);
        let one = |&i: &usize| Frame::new(&self.exposures[i], &masks[i], &self.curves[i], self.bracket.frames()[i].exposure_time, channels);
        ids.iter().map(one).collect()
    }

    /// The frames `used` merged as they are placed, without deblurring.
    fn blurred_merge(&self, used: &[usize]) -> Rgb {
        let masks = self.masks_with(&[], Channels::ALL);
        let (aligned, seen) = self.placed(used, &masks, 0);
        merge::irradiance(self.bracket, &aligned, &seen, &self.curves, used)
    }

    /// `luminance`, the mean of `channels`, in the colours of `merged`: those of a blurred merge, but they change less across an edge than the
    /// luminance does.
    fn coloured(merged: &Rgb, luminance: &Plane, channels: Channels) -> Rgb {
        let mean = merged.mean_of(channels);
        merged.map_planes(|p| {
            let data =
                p.data.iter().zip(mean.data.iter().zip(&luminance.data)).map(|(c, (m, l))| c * l / m.max(f32::MIN_POSITIVE)).collect();
            Plane { width: p.width, height: p.height, data }
        })
    }

    /// Irradiance to start from where the TSFs of all of the frames `used` are known: no frame shows the scene, and the colour
    /// solver's iterations are dear.
    pub(super) fn start_from_tsfs(&mut self, used: &[usize], tsfs: &[Option<Tsf>]) -> Result<Rgb> {
        let channels = self.most_telling(used, used);
        let (frames, merged) = (self.luminance_frames(used, channels), self.blurred_merge(used));
        let (w, h) = self.bracket.size();
        let known: Vec<Tsf> = used.iter().map(|&i| tsfs[i].clone().unwrap_or_else(Tsf::identity)).collect();
        let pad = self.pad(known.iter());
        let luminance = blind::luminance_of(&frames, &known, &merged.mean_of(channels), pad);
        Ok(Self::coloured(&merged, &luminance.crop(pad, pad, w, h), channels))
    }

    /// Frame of `used` to start from, its luminance the mean of `channels`, and the next best: the shortest are nearly always the least blurred.
    fn starts(&self, used: &[usize], channels: Channels) -> Vec<Start> {
        let time = |k: usize| self.bracket.frames()[used[k]].exposure_time;
        let mut order: Vec<usize> = (0..used.len()).collect();
        order.sort_by(|&a, &b| time(a).total_cmp(&time(b)));
        if let Some(r) = self.settings.reference.and_then(|r| used.iter().position(|&i| i == r)) {
            order = vec![r];
        }
        order.into_iter().take(2).map(|k| Start { reference: k, luminance: self.alone(used[k], channels) }).collect()
    }

    /// Irradiance of the frame `i` alone, the mean of `channels`.
    pub(super) fn alone(&self, i: usize, channels: Channels) -> Plane {
        merge::irradiance(self.bracket, &self.exposures, &self.own_masks(i), &self.curves, &[i]).mean_of(channels)
    }

    /// The paper's path (section III-B) over the frames `used`; `None` where patches lack texture.
    pub(super) fn patches(&mut self, used: &[usize], from: f32, to: f32) -> Result<Option<Found>> {
        let frames = self.luminance_frames(used, self.most_telling(used, used));
        let times = |k: &usize| self.bracket.frames()[used[*k]].exposure_time;
        let shortest = (0..used.len()).min_by(|a, b| times(a).total_cmp(&times(b))).unwrap_or(0);
        let reference = self.settings.reference.and_then(|r| used.iter().position(|&i| i == r)).unwrap_or(shortest);
        let setup = self.settings.patch_setup();
        let events = &mut self.events;
        let found = blind::from_patches(&frames, reference, &setup, &mut |f| {
            events(Event::Progress { stage: "estimating the blurs of pairs of patches".into(), fraction: from + 0.9 * (to - from) * f })
        });
        let name = |k: usize| self.bracket.frames()[used[k]].name.clone();
        let found = match found {
            Ok(found) => found,
            Err(Lack::Cancelled) => return Err(Error::Cancelled),
            Err(Lack::Texture(k)) => {
                self.degrade(format!(
                    "{}: shares no patch of enough texture with {}, unclipped in both, to find its blur; the frames are judged beside the shortest \
                     (--blind joint may find more)",
                    name(k),
                    name(reference)
                ))?;
                return Ok(None);
            }
        };
        let psfs = |k: usize| {
            let one = |(p, h): &(Patch, Psf)| json!({ "x": p.x, "y": p.y, "size": p.size, "radius": h.radius, "values": h.values.data });
            json!({ "frame": name(k), "psfs": found.psfs[k].iter().map(one).collect::<Vec<_>>() })
        };
        self.blind = json!({
            "method": "patches",
            "reference": name(reference),
            "believed": true,
            "reference_error": found.error,
            "patches": (0..used.len()).map(psfs).collect::<Vec<_>>(),
        });
        let mut tsfs = vec![None; self.bracket.frames().len()];
        for (&i, tsf) in used.iter().zip(&found.tsfs) {
            self.motions[i] = tsf.centre();
            tsfs[i] = Some(tsf.clone());
        }
        let start = self.start_from_tsfs(used, &tsfs)?;
        Ok(Some(Found { start, tsfs: found.tsfs, reference: used[reference], reduced: false }))
    }

    /// The joint estimate of irradiance and the TSFs of all of the frames `used`; `None` where it explains pixels that it was not fitted to no better than what is known
    /// without it: a merge, or what is `known` of a scene, the TSFs under it and the first frame that was taken for stationary, which itself has to be explained better. `begun`: what [`Run::doubt`]
    /// left to go on from.
    pub(super) fn joint(
        &mut self,
        used: &[usize],
        known: Option<(&Rgb, &[Option<Tsf>], usize)>,
        begun: Option<&Begun>,
        from: f32,
        to: f32,
    ) -> Result<Option<Found>> {
        let channels = self.most_telling(used, used);
        let (frames, merged) = (self.luminance_frames(used, channels), self.blurred_merge(used));
        let names: Vec<String> = used.iter().map(|&i| self.bracket.frames()[i].name.clone()).collect();
        let starts = self.starts(used, channels);
        let tsf = |i: usize| known.and_then(|k| k.1[i].clone()).unwrap_or_else(|| Tsf::still(self.motions[i]));
        let otherwise: Vec<Tsf> = used.iter().map(|&i| tsf(i)).collect();
        let scene = known.map_or(&merged, |k| k.0).mean_of(channels);
        let first = known.and_then(|k| used.iter().position(|&i| i == k.2));
        let events = &mut self.events;
        let known = Known { scene: &scene, tsfs: &otherwise, first };
        let found = blind::estimate(&frames, &starts, begun, &known, &mut |s| {
            let size = if s.scale > 1 { format!(" at 1/{} of the size", s.scale) } else { String::new() };
            events(Event::Progress {
                stage: format!("no frame is sharp: estimating all blurs{size}"),
                fraction: from + (to - from) * s.fraction,
            })
        })
        .ok_or(Error::Cancelled)?;
        let (w, h) = self.bracket.size();
        let extents: Vec<f64> = found.tsfs.iter().map(|t| tsf::extent(t, w, h)).collect();
        let believed = found.is_believed(first);
        self.blind = json!({
            "method": "joint",
            "reference": names[found.reference],
            "believed": believed,
            "channels": channels.names(),
            "extent_px": extents,
            "estimated_at_scale": found.scale,
            "held_out_chi_squared": found.held_out,
            "held_out_chi_squared_otherwise": found.held_out_merge,
            "lens_px": found.lens_px,
            "ways": found.ways,
        });
        if !believed {
            return Ok(None);
        }
        let start = self.scene(used, &found.tsfs, &found.luminance, channels);
        Ok(Some(Found { start, tsfs: found.tsfs, reference: used[found.reference], reduced: found.scale > 1 }))
    }

    /// `luminance`, the mean of `channels`, in colour, the frames `used` as `tsfs` place them from now on.
    pub(super) fn scene(&mut self, used: &[usize], tsfs: &[Tsf], luminance: &Plane, channels: Channels) -> Rgb {
        for (&i, tsf) in used.iter().zip(tsfs) {
            self.motions[i] = tsf.centre();
        }
        Self::coloured(&self.blurred_merge(used), luminance, channels)
    }

    /// What speaks for it that the frame `first`, one of those of the frames `used` that are taken for stationary (`still`), moved as well as all others, and what a joint estimate of them can go on
    /// from; `None` where the edges of one of these are as hard as a sharp frame's.
    pub(super) fn doubt(&mut self, first: usize, still: &[usize], used: &[usize]) -> Result<Option<(Doubt, Option<Begun>)>> {
        if !still.iter().all(|&i| self.hardness(i).is_some_and(|h| h < SOFT)) {
            return Ok(None);
        }
        let reference = used.iter().position(|&i| i == first).unwrap_or(0);
        let size = self.bracket.size();
        self.remembered(
            "doubt",
            &format!("{first} {used:?}"),
            |_| 0,
            |run| {
                run.within_window(used, |part| {
                    let channels = part.most_telling(used, used);
                    let frames = part.luminance_frames(used, channels);
                    let start = Start { reference, luminance: part.alone(first, channels) };
                    let stage = format!("looking whether {} moved as well", part.bracket.frames()[first].name);
                    let found = blind::doubt(&frames, &start, &mut || part.progress(&stage, 0.40).is_ok());
                    let (doubt, begun) = found.ok_or(Error::Cancelled)?;
                    // Of a part nothing is begun that the whole can go on from.
                    Ok(Some((doubt, begun.filter(|_| part.bracket.size() == size))))
                })
            },
        )
    }

    /// Whether displaced ones of the stationary frames `still` show structure as fine as the pixels, in the mean: noise raises short frames, the rim of what is clipped long ones.
    pub(super) fn is_pixel_sharp(&self, still: &[usize]) -> bool {
        if still.iter().all(|&i| self.motions[i] == DMat3::IDENTITY) {
            return false;
        }
        let found: Vec<f64> = still.iter().filter_map(|&i| self.hardness(i)).collect();
        found.iter().sum::<f64>() > PIXEL_SHARP * found.len() as f64
    }

    /// Energy of the differences of frame `i` over that of differences twice as long, in the direction in which that is least, at the shortest length at which they are clear of noise; `None` where
    /// none are. Structure as fine as the pixels has about 0.7, a lens 0.3 to 0.5, a motion less in its direction.
    pub(super) fn hardness(&self, i: usize) -> Option<f64> {
        let (x, noise) = (self.exposures[i].mean(), &self.noise[i]);
        let clipped = mask::clipped(&self.bracket.frames()[i], Channels::ALL);
        let (w, h) = x.size();
        // Energy of differences over (dx, dy), weighted by the light, and its noise.
        let energy = |dx: usize, dy: usize| -> [f64; 2] {
            let row = |y: usize| {
                let mut sum = [0.0f64; 2];
                for p in (y * w..(y + 1) * w - dx.min(w)).filter(|&p| !clipped[p] && !clipped[p + dy * w + dx]) {
                    let q = p + dy * w + dx;
                    let light = f64::from(x.data[p] + x.data[q]).max(0.0) * 0.5;
                    let variance = 2.0 * noise.share(1) * noise.luminance.variance(light);
                    let weight = 1.0 / (variance + (0.05 * light).powi(2));
                    sum[0] += weight * f64::from(x.data[p] - x.data[q]).powi(2);
                    sum[1] += weight * variance;
                }
                sum
            };
            (0..h.saturating_sub(dy)).into_par_iter().map(row).reduce(|| [0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]])
        };
        let softness = |&(dx, dy): &(usize, usize)| -> Option<f64> {
            // The finest structure that is clear of noise tells.
            let clear = (1..=LONGEST).map(|k| (k, energy(k * dx, k * dy))).find(|(_, [one, noise])| *one > CLEAR * noise);
            clear.map(|(k, [one, noise])| (one - noise) / (energy(2 * k * dx, 2 * k * dy)[0] - noise).max(f64::MIN_POSITIVE))
        };
        [(1, 0), (0, 1), (1, 1)].iter().filter_map(softness).min_by(f64::total_cmp)
    }

    /// Masks by which the frame `i` alone counts.
    fn own_masks(&self, i: usize) -> Vec<Plane> {
        self.masks_with(&[i], Channels::ALL)
    }

    /// What the report says about a bracket without a sharp frame; null where there was one.
    pub(super) fn blind_report(&mut self) -> Value {
        std::mem::take(&mut self.blind)
    }
}
