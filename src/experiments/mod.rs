//! The paper's experiments repeated on scenes with known truth: one file each, from bracket to table and picture.

mod accuracy;
mod joint;
mod outcomes;
mod psfs;
mod sheet;
mod study;

pub use joint::Joint;

use crate::error::{Error, Result};
use crate::pipeline::Event;
use crate::synth::Drawn;
use image::RgbImage;
use std::collections::BTreeMap;
use study::{Shaking, Study};

/// The experiments that the program repeats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Experiment {
    /// Figure 3: patches, true and estimated PSFs.
    Psfs,
    /// Footnote 1: accuracy of TSFs from PSFs.
    Accuracy,
    /// Figure 5: blurred higher exposures.
    Blurred,
    /// Figure 7: 6-D motion fitted by 3-D TSFs.
    SixD,
    /// Figure 11: several more scenes.
    Scenes,
    /// Figure 12: against the tripod.
    Tripod,
    /// The sharpness claim of section IV.
    Sharpness,
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
    pub const ALL: [Self; 7] = [Self::Psfs, Self::Accuracy, Self::Blurred, Self::SixD, Self::Scenes, Self::Tripod, Self::Sharpness];

    /// The word that names it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Psfs => "fig3",
            Self::Accuracy => "tsf",
            Self::Blurred => "fig5",
            Self::SixD => "fig7",
            Self::Scenes => "fig11",
            Self::Tripod => "fig12",
            Self::Sharpness => "sharpness",
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
    studies: BTreeMap<(&'static str, Shaking), Study>,
}

impl Lab {
    /// A lab whose frames are `width` pixels wide and three quarters as high.
    pub fn new(width: usize, seed: u64) -> Self {
        Self { width, seed, studies: BTreeMap::new() }
    }

    /// Runs one experiment. `events` hears the pipeline's events and cancels by `false`.
    ///
    /// # Errors
    /// The pipeline's.
    pub fn run(&mut self, experiment: Experiment, events: &mut dyn FnMut(Event) -> bool) -> Result<Report> {
        match experiment {
            Experiment::Psfs => psfs::run(self, events),
            Experiment::Accuracy => accuracy::run(self, events),
            Experiment::Blurred => outcomes::blurred(self, events),
            Experiment::SixD => outcomes::six_d(self, events),
            Experiment::Scenes => outcomes::scenes(self, events),
            Experiment::Tripod => outcomes::tripod(self, events),
            Experiment::Sharpness => outcomes::sharpness(self, events),
        }
    }

    /// The bracket of `scene` shaken by `shaking`, and what was made of it.
    fn study(&mut self, scene: Drawn, shaking: Shaking, events: &mut dyn FnMut(Event) -> bool) -> Result<&Study> {
        let key = (scene.name(), shaking);
        if !self.studies.contains_key(&key) {
            let study = Study::new(scene, shaking, self.width, self.seed, events)?;
            self.studies.insert(key, study);
        }
        Ok(&self.studies[&key])
    }
}
