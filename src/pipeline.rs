//! The stages in order: a bracket in, irradiance and report out. No mathematics, no files, no printing.

use crate::error::Result;
use crate::exposure::Bracket;
use crate::image::Rgb;
use crate::response::Response;
use crate::tsf::TsfFile;

/// What a user can set about a merge. `Default` is what the program uses when nothing is said.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Frame (0-based) on whose pixel grid the result lies; `None`: the longest sharp frame.
    pub reference: Option<usize>,
    /// Frames (0-based) that are sharp; `None`: found out.
    pub sharp: Option<Vec<usize>>,
    /// Frames (0-based) to leave out.
    pub exclude: Vec<usize>,
    /// α of the Tukey window, 0..=1.
    pub alpha: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { reference: None, sharp: None, exclude: Vec::new(), alpha: 0.3 }
    }
}

/// What a running merge tells its caller.
#[derive(Clone, Debug)]
pub enum Event {
    /// Work goes on: `stage` is what is being done, `fraction` how much of the whole merge is done, 0..=1.
    Progress {
        /// Stage in words.
        stage: String,
        /// Part of the whole, 0..=1.
        fraction: f32,
    },
    /// Something the user should know; the merge goes on.
    Warning(String),
}

/// Result of a merge.
pub struct Outcome {
    /// Irradiance E times the reference frame's exposure time: 1.0 is that frame's white. Finite, not negative.
    pub irradiance: Rgb,
    /// Index (0-based, in command-line order) of the reference frame.
    pub reference: usize,
    /// Everything that was estimated, as JSON (`format` "unshaken-report", `version` 1).
    pub report: serde_json::Value,
}

/// Reconstructs the irradiance of `bracket`. `given`: TSFs to use instead of estimating them. `events` is called from
/// the calling thread; returning `false` cancels.
///
/// # Errors
/// [`crate::error::Error::Input`] for settings or TSFs that do not fit the bracket, `Cancelled`, and the GPU's errors.
pub fn merge(
    bracket: &Bracket,
    response: &Response,
    settings: &Settings,
    given: Option<&TsfFile>,
    events: &mut dyn FnMut(Event) -> bool,
) -> Result<Outcome> {
    let _ = (bracket, response, settings, given, events);
    Err(crate::error::Error::Cancelled)
}
