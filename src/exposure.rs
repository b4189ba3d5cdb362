//! [`Frame`] (intensity Z and exposure time Δt) and [`Bracket`] (frames of one scene). No files.

use crate::error::{Error, Result};
use crate::image::Rgb;
use rayon::prelude::*;

/// One photograph of the bracket.
#[derive(Clone, Debug)]
pub struct Frame {
    /// How messages name the frame: its file name.
    pub name: String,
    /// Intensity Z in 0..=1 (1 is the file's largest code), three channels.
    pub intensity: Rgb,
    /// Number of intensity steps of the file: 255 for 8 bits, 65535 for 16 bits.
    pub levels: u32,
    /// Whether the file holds colour more coarsely than brightness, as most JPEG files do (4:2:0, 4:2:2): no channel by itself is as sharp as their mean.
    pub chroma_subsampled: bool,
    /// Whether the file format drops what is fine and faint, and noise with it (JPEG).
    pub lossy: bool,
    /// ISO speed, where the file notes it.
    pub speed: Option<f64>,
    /// Exposure time Δt in seconds.
    pub exposure_time: f64,
}

/// Part of a channel's pixels that read its least value where noise is cut off there. Of 483 channels of random brackets without a pedestal none is taken for one that has it; of 255 with one, 57 show it
/// so: the others hold little that is dark, or an engine has smoothed it.
const CUT_OFF: f64 = 0.005;

impl Frame {
    /// Intensity of `channel` at which noise is cut off at black: its least value, where so many pixels read it that it is more than the darkest thing in sight (a file may add
    /// a pedestal to black), else 0.
    pub fn black(&self, channel: usize) -> f32 {
        let data = &self.intensity.0[channel].data;
        let least = |a: (f32, usize), b: (f32, usize)| match a.0 == b.0 {
            true => (a.0, a.1 + b.1),
            false if a.0 < b.0 => a,
            false => b,
        };
        let (least, count) = data.par_iter().map(|&z| (z, 1)).reduce(|| (f32::INFINITY, 0), least);
        if count as f64 > CUT_OFF * data.len() as f64 { least.max(0.0) } else { 0.0 }
    }
}

/// Two or more frames of one scene, of one size, at more than one exposure time, in command-line order.
#[derive(Clone, Debug)]
pub struct Bracket {
    frames: Vec<Frame>,
}

impl Bracket {
    /// Checks that the frames make a bracket.
    ///
    /// # Errors
    /// [`Error::Bracket`], naming the frame, for fewer than two frames, frames of different size, an exposure time
    /// that is not a positive finite number, intensities that are NaN or infinite, frames that all have the same exposure time, and frames that are all
    /// clipped or all black.
    pub fn new(frames: Vec<Frame>) -> Result<Self> {
        if frames.len() < 2 {
            return Err(Error::Bracket(format!(
                "a bracket needs at least two frames, {} given; add frames with other exposure times",
                frames.len()
            )));
        }
        let size = frames[0].intensity.size();
        for f in &frames {
            if f.intensity.size() != size {
                let (w, h) = f.intensity.size();
                return Err(Error::Bracket(format!(
                    "{}: is {w} x {h} pixels but {} is {} x {}; all frames must have one size",
                    f.name, frames[0].name, size.0, size.1
                )));
            }
            for (plane, channel) in f.intensity.0.iter().zip(["red", "green", "blue"]) {
                if let Some(i) = plane.data.iter().position(|v| !v.is_finite()) {
                    let (x, y, value) = (i % size.0, i / size.0, plane.data[i]);
                    let text = format!("{}: {channel} of pixel ({x}, {y}) is {value}; intensities are numbers from 0 to 1", f.name);
                    return Err(Error::Bracket(text));
                }
            }
            if !(f.exposure_time.is_finite() && f.exposure_time > 0.0) {
                return Err(Error::Bracket(format!(
                    "{}: exposure time {} s is not a positive number; give the times with --exposures",
                    f.name, f.exposure_time
                )));
            }
        }
        let times = frames.iter().map(|f| f.exposure_time);
        let (min, max) = times.fold((f64::INFINITY, 0.0f64), |(a, b), t| (a.min(t), b.max(t)));
        if max / min < 1.01 {
            return Err(Error::Bracket(format!(
                "{}: all frames have the same exposure time ({min} s); a bracket needs at least two different ones, give the true times with --exposures",
                frames[0].name
            )));
        }
        for (what, test) in [("clipped", (|v: f32| v >= 1.0) as fn(f32) -> bool), ("black", |v: f32| v <= 0.0)] {
            if frames.iter().all(|f| f.intensity.0.iter().all(|p| p.data.iter().all(|&v| test(v)))) {
                return Err(Error::Bracket(format!(
                    "{}: every pixel of every frame is {what}; take frames with {} exposure times",
                    frames[0].name,
                    if what == "clipped" { "shorter" } else { "longer" }
                )));
            }
        }
        Ok(Self { frames })
    }

    /// The same frames at other exposure times, in seconds, as many as there are frames.
    #[must_use]
    pub fn with_exposure_times(&self, times: impl Iterator<Item = f64>) -> Self {
        Self { frames: self.frames.iter().zip(times).map(|(f, exposure_time)| Frame { exposure_time, ..f.clone() }).collect() }
    }

    /// Of each frame the part of `size` (width, height) whose first pixel is that of `corners`, one for each frame.
    ///
    /// # Panics
    /// When a part leaves its frame.
    #[must_use]
    pub fn cropped(&self, corners: &[(usize, usize)], size: (usize, usize)) -> Self {
        let part = |(f, &(x, y)): (&Frame, &(usize, usize))| Frame {
            name: f.name.clone(),
            intensity: f.intensity.crop(x, y, size.0, size.1),
            levels: f.levels,
            chroma_subsampled: f.chroma_subsampled,
            lossy: f.lossy,
            speed: f.speed,
            exposure_time: f.exposure_time,
        };
        Self { frames: self.frames.iter().zip(corners).map(part).collect() }
    }

    /// The frames in command-line order.
    pub fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// The frame of `ids` with the shortest exposure time; `None` for no ids.
    pub fn shortest(&self, ids: &[usize]) -> Option<usize> {
        ids.iter().copied().min_by(|&a, &b| self.frames[a].exposure_time.total_cmp(&self.frames[b].exposure_time))
    }

    /// The frame of `ids` with the longest exposure time; `None` for no ids.
    pub fn longest(&self, ids: &[usize]) -> Option<usize> {
        ids.iter().copied().max_by(|&a, &b| self.frames[a].exposure_time.total_cmp(&self.frames[b].exposure_time))
    }

    /// (width, height) of every frame.
    pub fn size(&self) -> (usize, usize) {
        self.frames[0].intensity.size()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Plane;

    #[test]
    fn black_is_where_noise_is_cut_off() {
        // Noise of 0.02 about 0.01, cut off at black, on a pedestal; without; and a scene without black.
        let noise = |i: usize| 0.07 * ((((i * 7919) % 1009) as f32) / 1009.0 - 0.5);
        let frame = |value: &(dyn Fn(usize) -> f32 + Sync)| Frame {
            name: "black".into(),
            intensity: Rgb(std::array::from_fn(|_| Plane::from_fn(64, 48, |x, y| value(y * 64 + x)))),
            levels: 65535,
            chroma_subsampled: false,
            lossy: false,
            speed: None,
            exposure_time: 1.0,
        };
        let black = |value: &(dyn Fn(usize) -> f32 + Sync)| [0, 1, 2].map(|c| frame(value).black(c));
        assert_eq!(black(&|i| (0.01 + noise(i)).max(0.0) + 0.03), [0.03; 3]);
        assert_eq!(black(&|i| (0.01 + noise(i)).max(0.0)), [0.0; 3]);
        assert_eq!(black(&|i| 0.2 + noise(i)), [0.0; 3]);
    }
}
