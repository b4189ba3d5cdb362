//! One bracket with known truth and everything that was made of it.

use super::Joint;
use crate::baseline;
use crate::error::Result;
use crate::exposure::Bracket;
use crate::image::Rgb;
use crate::metrics::{self, Judge, Score};
use crate::pipeline::{Event, Settings};
use crate::response::Response;
use crate::synth::{self, Camera, Drawn, Motion, Scene, Shake, SyntheticBracket, Tremor, Wobble};
use crate::tonemap::{ToneMap, codes};

/// Exposure times of the paper's Figure 5, seconds; the two longest are shaken.
pub(super) const TIMES: [f64; 5] = [1.0 / 30.0, 1.0 / 8.0, 1.0 / 5.0, 1.0 / 2.0, 2.0];
/// The first shaken frame.
pub(super) const SHAKEN: usize = 3;
/// Content beyond the frame, pixels.
const MARGIN: usize = 40;
/// Median luminance: this part of white after 1 s.
const MEDIAN: f64 = 0.05;

/// How the two longest frames are shaken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Shaking {
    /// TSFs on the paper's grid.
    Grid,
    /// Smooth tremor, off every grid.
    Tremor,
    /// Tremor in six degrees of freedom.
    SixD,
}

pub(super) struct Study {
    pub scene: Scene,
    pub made: SyntheticBracket,
    pub motions: Vec<Motion>,
    pub tripod: Bracket,
    pub joint: Joint,
    pub naive: Rgb,
    pub tone: ToneMap,
    judge: Judge,
}

impl Study {
    pub fn new(drawn: Drawn, shaking: Shaking, width: usize, seed: u64, events: &mut dyn FnMut(Event) -> bool) -> Result<Self> {
        events(Event::Progress { stage: format!("scene {}", drawn.name()), fraction: 0.0 });
        let height = width * 3 / 4;
        let scene = drawn.draw(width, height, MARGIN, 2, seed);
        let focal_px = 1.2 * width as f64;
        // Extents as those of the demo: a hand at 2 s moves the picture by a few hundredths of its width.
        let tremor = Tremor { extent_px: 0.028 * width as f64, roll_deg: 1.2, offset_px: 1.0, offset_deg: 0.1 };
        let shake = match shaking {
            Shaking::Grid => Shake::Grid(tremor),
            Shaking::Tremor => Shake::Tremor(tremor),
            Shaking::SixD => Shake::SixD(Wobble {
                shift_m: 0.022 * width as f64 * 2.0 / focal_px,
                nearing_m: 0.002,
                tilt_deg: 0.6,
                roll_deg: 0.9,
                depth_m: 2.0,
            }),
        };
        let mut frames = Vec::new();
        for (i, time) in TIMES.into_iter().enumerate() {
            let motion = if i < SHAKEN {
                Shake::none(width)
            } else {
                let part = (time / TIMES[TIMES.len() - 1]).powf(0.35);
                shake.motion(width, height, focal_px, time, part, 0.25, seed, i as u64 + 1)?
            };
            frames.push((time, motion));
        }
        let (made, tripod) = synth::photograph(&scene, &Camera::default(), &frames, MEDIAN, seed, true)?;
        let tripod = tripod.expect("asked for");
        let settings = Settings::default();
        let joint = Joint::new(&made.bracket, &Response::Srgb, &settings, None, events)?;
        let mut hear = |f: f32| events(Event::Progress { stage: "deblurring each frame".into(), fraction: f });
        let naive = baseline::deblur_each(&made.bracket, &Response::Srgb, &joint.tsfs, &settings.deblur, &mut hear)?;
        let judge = Judge { limit: Some((0.98 / TIMES[0]) as f32), ..Judge::default() };
        let tone = ToneMap::fit(&made.truth);
        let motions = frames.into_iter().map(|f| f.1).collect();
        Ok(Self { scene, made, motions, tripod, joint, naive, tone, judge })
    }

    /// What the methods made, with their names: all frames merged, the sharp ones, each deblurred alone, all together, the tripod.
    pub fn methods(&self) -> Vec<(&'static str, Rgb)> {
        let merge = |bracket: &Bracket, frames: &[usize]| baseline::merge(bracket, &Response::Srgb, frames);
        let all: Vec<usize> = (0..TIMES.len()).collect();
        vec![
            ("all frames merged", merge(&self.made.bracket, &all)),
            ("sharp frames merged", merge(&self.made.bracket, &all[..SHAKEN])),
            ("each deblurred, merged", self.naive.clone()),
            ("unshaken", self.joint.irradiance.clone()),
            ("tripod merged", merge(&self.tripod, &all)),
        ]
    }

    pub fn score(&self, image: &Rgb) -> Result<Score> {
        metrics::score(image, &self.made.truth, &self.judge)
    }

    /// Frame `i` as a picture: its intensity.
    pub fn photo(&self, i: usize) -> image::RgbImage {
        codes(&self.made.bracket.frames()[i].intensity)
    }

    /// Exposure fusion of all frames.
    pub fn fused(&self) -> image::RgbImage {
        let all: Vec<usize> = (0..TIMES.len()).collect();
        codes(&baseline::fuse(&self.made.bracket, &all))
    }
}
