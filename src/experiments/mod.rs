//! The paper's experiments repeated on scenes with known truth: one file each, from bracket to table and picture.

mod accuracy;
mod apart;
mod joint;
mod local;
mod outcomes;
mod psfs;
mod sheet;
mod study;

pub use joint::Joint;

use crate::baseline;
use crate::error::{Error, Result};
use crate::exposure::Bracket;
use crate::pipeline::Event;
use crate::response;
use crate::synth::{Drawn, Scene};
use image::RgbImage;
use std::collections::BTreeMap;
use study::{Events, Exposures, Key, MARGIN, Shaking, Study};

/// The experiments that the program repeats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Experiment {
    /// Figure 3: patches, true and estimated PSFs.
    Psfs,
    /// Figure 4: PSFs from two blurred frames.
    BlindPsfs,
    /// Footnote 1: accuracy of TSFs from PSFs.
    Accuracy,
    /// Figure 5: blurred higher exposures.
    Blurred,
    /// Figure 6: all frames blurred, against uniform blur.
    AllBlurred,
    /// Figure 7: 6-D motion fitted by 3-D TSFs.
    SixD,
    /// Figure 8: what a camera makes of it, the longest frame blurred.
    Photographs,
    /// Figure 9: the same, all blurred.
    PhotographsAllBlurred,
    /// Figure 10: frames far apart.
    Apart,
    /// Figure 11: several more scenes.
    Scenes,
    /// Figure 12: against the tripod.
    Tripod,
    /// The sharpness claim of section IV.
    Sharpness,
    /// A photographed bracket, shaken afterwards.
    Office,
}

/// What an experiment shows.
pub struct Report {
    /// One line.
    pub title: String,
    /// What was done, and how it compares with the paper.
    pub text: String,
    /// Markdown table.
    pub table: String,
    /// Picture: inputs, results, close-ups.
    pub picture: RgbImage,
}

impl Experiment {
    /// All of them, in the paper's order.
    pub const ALL: [Self; 13] = [
        Self::Psfs,
        Self::BlindPsfs,
        Self::Accuracy,
        Self::Blurred,
        Self::AllBlurred,
        Self::SixD,
        Self::Photographs,
        Self::PhotographsAllBlurred,
        Self::Apart,
        Self::Scenes,
        Self::Tripod,
        Self::Sharpness,
        Self::Office,
    ];

    /// The word that names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Psfs => "fig3",
            Self::BlindPsfs => "fig4",
            Self::Accuracy => "tsf",
            Self::Blurred => "fig5",
            Self::AllBlurred => "fig6",
            Self::SixD => "fig7",
            Self::Photographs => "fig8",
            Self::PhotographsAllBlurred => "fig9",
            Self::Apart => "fig10",
            Self::Scenes => "fig11",
            Self::Tripod => "fig12",
            Self::Sharpness => "sharpness",
            Self::Office => "office",
        }
    }

    /// The experiment called `name`.
    ///
    /// # Errors
    /// [`Error::Input`] with the names there are.
    pub fn named(name: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|e| e.name() == name).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|e| e.name()).collect();
            Error::Input(format!("there is no experiment {name:?}; choose one of {} or all", names.join(", ")))
        })
    }
}

/// Runs experiments; brackets and their reconstructions are kept, since several experiments look at the same ones.
pub struct Lab {
    width: usize,
    seed: u64,
    studies: BTreeMap<Key, Study>,
    photographs: Option<Bracket>,
    photographed: Option<Study>,
}

impl Lab {
    /// A lab whose frames are `width` pixels wide and three quarters as high. `photographs`: a bracket from a tripod, for
    /// [`Experiment::Office`].
    pub fn new(width: usize, seed: u64, photographs: Option<Bracket>) -> Self {
        Self { width, seed, studies: BTreeMap::new(), photographs, photographed: None }
    }

    /// Runs one experiment. `events` hears the pipeline's events and cancels by `false`.
    ///
    /// # Errors
    /// The pipeline's; [`Error::Input`] for an experiment on photographs without any.
    pub fn run(&mut self, experiment: Experiment, events: &mut dyn FnMut(Event) -> bool) -> Result<Report> {
        match experiment {
            Experiment::Psfs => psfs::run(self, events),
            Experiment::BlindPsfs => psfs::blind(self, events),
            Experiment::Accuracy => accuracy::run(self, events),
            Experiment::Blurred => outcomes::blurred(self, events),
            Experiment::AllBlurred => outcomes::all_shaken(self, events),
            Experiment::SixD => outcomes::six_d(self, events),
            Experiment::Photographs => outcomes::photographs(self, false, events),
            Experiment::PhotographsAllBlurred => outcomes::photographs(self, true, events),
            Experiment::Apart => apart::run(self, events),
            Experiment::Scenes => outcomes::scenes(self, events),
            Experiment::Tripod => outcomes::tripod(self, events),
            Experiment::Sharpness => outcomes::sharpness(self, events),
            Experiment::Office => outcomes::office(self, events),
        }
    }

    /// The bracket of `scene` shaken by `shaking`, and what was made of it.
    fn study(&mut self, (scene, exposures, shaking): (Drawn, Exposures, Shaking), events: Events) -> Result<&Study> {
        let key = (scene.name(), exposures, shaking);
        if !self.studies.contains_key(&key) {
            let study = Study::new((scene, exposures, shaking), self.width, self.seed, events)?;
            self.studies.insert(key, study);
        }
        Ok(&self.studies[&key])
    }

    /// The photographed scene, shaken; `None` without photographs.
    fn photographed(&mut self, events: Events) -> Result<Option<&Study>> {
        let (Some(bracket), None) = (&self.photographs, &self.photographed) else { return Ok(self.photographed.as_ref()) };
        let response = response::calibrate(bracket)?;
        let all: Vec<usize> = (0..bracket.frames().len()).collect();
        let irradiance = baseline::merge(bracket, &response, &all);
        // Two samples per pixel where the photographs are large enough.
        let oversampling = (irradiance.width() / (self.width + 2 * MARGIN)).clamp(1, 2);
        let scene = Scene::photograph(&irradiance, Some(self.width), MARGIN, oversampling)?;
        let times: Vec<f64> = bracket.frames().iter().map(|f| f.exposure_time).collect();
        self.photographed = Some(Study::of_scene(scene, response, &times, STEADY, self.seed, events)?);
        Ok(self.photographed.as_ref())
    }
}

/// Exposure time in seconds up to which a hand holds a camera still enough.
const STEADY: f64 = 0.25;
