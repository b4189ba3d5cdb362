//! Masks m of eq. (8): Tukey windows of the intensity, and what is clipped. No irradiance.

use crate::exposure::Frame;
use crate::image::{Channels, Plane};
use crate::pose::nearest_pixel;
use glam::DMat3;
use rayon::prelude::*;

/// Intensity from which a channel counts as clipped: the well clips after the noise, so that values just below white are
/// already biased. 250 of 255.
pub const CLIPPED: f32 = 250.0 / 255.0;

/// Tukey window at `z` in 0..=1: 1 in the middle, cosine tapers of width α/2 at both ends.
pub fn tukey(z: f32, alpha: f32) -> f32 {
    low_taper(z, alpha) * low_taper(1.0 - z, alpha)
}

fn low_taper(z: f32, alpha: f32) -> f32 {
    let z = z.clamp(0.0, 1.0);
    if alpha <= 0.0 || z >= 0.5 * alpha { 1.0 } else { 0.5 * (1.0 - (2.0 * std::f32::consts::PI * z / alpha).cos()) }
}

/// Rec. 601 luma's weights of red, green and blue.
const LUMA: [f32; 3] = [0.299, 0.587, 0.114];

/// Grey equivalent of `channels` of a frame's intensity: for all three, Rec. 601 luma.
fn grey(frame: &Frame, channels: Channels) -> Plane {
    let all: f32 = channels.indices().map(|c| LUMA[c]).sum();
    frame.intensity.weighted(channels, LUMA.map(|l| l / all))
}

/// Where any of `channels` of the frame is clipped.
pub fn clipped(frame: &Frame, channels: Channels) -> Vec<bool> {
    let planes = &frame.intensity.0;
    (0..planes[0].data.len()).into_par_iter().map(|i| channels.indices().any(|c| planes[c].data[i] >= CLIPPED)).collect()
}

/// Pixels from a clipped one up to which it spoils the colour of a file that holds colour at half the resolution, and interpolates it.
const SPOILT: usize = 1;

/// Where any of `channels` of the frame is clipped, or mixed with neighbours that are.
pub fn spoilt(frame: &Frame, channels: Channels) -> Vec<bool> {
    let found = clipped(frame, channels);
    if !frame.chroma_subsampled {
        return found;
    }
    let near = apart(&found, frame.intensity.size(), SPOILT);
    near.into_iter().map(|apart| !apart).collect()
}

/// [`spoilt`] of red, green and blue, each by itself.
pub fn spoilt_channels(frame: &Frame) -> [Vec<bool>; 3] {
    Channels::EACH.map(|c| spoilt(frame, c))
}

/// `mask`, which is 0 where any channel of `frame` is clipped, for those who take each channel by itself: where some are clipped and others are
/// not, the window's high end at the grey of them all, times `share` there. The colour of a lamp or of the sky is clipped in one channel long before it is
/// in the others, which no other frame may show as well.
///
/// `clipped`: [`spoilt_channels`] of the frame.
pub fn with_partly_clipped(
    mask: &Plane,
    frame: &Frame,
    clipped: &[Vec<bool>; 3],
    alpha: f32,
    share: impl Fn(usize) -> f32 + Sync,
) -> Plane {
    let grey = grey(frame, Channels::ALL);
    let one = |p: usize| match clipped.iter().filter(|c| c[p]).count() {
        1 | 2 => share(p) * low_taper(1.0 - grey.data[p], alpha),
        _ => mask.data[p],
    };
    Plane { data: (0..mask.data.len()).into_par_iter().map(one).collect(), ..grey }
}

/// [`masks`] of all channels, each frame's [`with_partly_clipped`]: how frames count in the solver.
pub fn counting(frames: &[Frame], sharp: &[bool], alpha: f32, motions: &[DMat3]) -> Vec<Plane> {
    let all = masks(frames, sharp, alpha, motions, Channels::ALL);
    all.iter().zip(frames).map(|(m, f)| with_partly_clipped(m, f, &spoilt_channels(f), alpha, |_| 1.0)).collect()
}

/// Distance in pixels from what no frame knows up to which its light, blurred, is counted with.
pub const UNKNOWN: usize = 10;

/// Pixels of a frame of `size` farther than `radius`, along rows and columns, from those where `lost` is true.
pub fn apart(lost: &[bool], size: (usize, usize), radius: usize) -> Vec<bool> {
    let lost = Plane { width: size.0, height: size.1, data: lost.iter().map(|&l| f32::from(l)).collect() };
    // Counts of at most (2 radius + 1)² are whole numbers in f32, whatever is added and taken away before.
    lost.box_sum(radius).data.into_iter().map(|count| count < 0.5).collect()
}

/// One mask per frame, 0..=1, for all of `channels` together.
///
/// The window's high end applies everywhere, and the mask is 0 wherever any of them is clipped. Its low end applies only where
/// a longer frame that is at least as sharp has the pixel in the flat part of its own window: elsewhere the dark values are
/// the best there is, and their variance already says what they are worth (the low end alone costs 3 dB).
///
/// `motions`: each frame's place, from the reference, centred pixels.
pub fn masks(frames: &[Frame], sharp: &[bool], alpha: f32, motions: &[DMat3], channels: Channels) -> Vec<Plane> {
    let greys: Vec<Plane> = frames.iter().map(|f| grey(f, channels)).collect();
    let clipped: Vec<Vec<bool>> = frames.iter().map(|f| spoilt(f, channels)).collect();
    frames
        .iter()
        .enumerate()
        .map(|(i, f)| {
            let better: Vec<usize> =
                (0..frames.len()).filter(|&j| frames[j].exposure_time > 1.001 * f.exposure_time && (sharp[j] || !sharp[i])).collect();
            let (w, h) = f.intensity.size();
            let to: Vec<(usize, Option<DMat3>)> =
                better.into_iter().map(|j| (j, (motions[j] != motions[i]).then(|| motions[j] * motions[i].inverse()))).collect();
            let data = (0..greys[i].data.len())
                .into_par_iter()
                .map(|p| {
                    if clipped[i][p] {
                        return 0.0;
                    }
                    let z = greys[i].data[p];
                    let covered = to.iter().any(|(j, motion)| {
                        let there = motion.map_or(Some(p), |m| nearest_pixel(&m, w, h, p % w, p / w));
                        there.is_some_and(|q| !clipped[*j][q] && tukey(greys[*j].data[q], alpha) >= 1.0)
                    });
                    low_taper(1.0 - z, alpha) * if covered { low_taper(z, alpha) } else { 1.0 }
                })
                .collect();
            Plane { width: greys[i].width, height: greys[i].height, data }
        })
        .collect()
}
