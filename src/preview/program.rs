//! The program whose window this is, as far as the window knows it: handed in by whoever opens the window.

use crate::colour::Matrix;
use crate::exposure::Bracket;
use crate::pipeline::{Event, Outcome, Settings};
use crate::response::Response;
use std::any::Any;
use std::ffi::OsString;
use std::sync::Arc;

/// Frames as the program read them.
#[derive(Clone)]
pub struct Opened {
    /// The frames.
    pub bracket: Arc<Bracket>,
    /// Their response.
    pub response: Response,
    /// Their linear RGB to Rec. 709.
    pub to_display: Matrix,
    /// Whatever else the program needs to write results.
    pub more: Arc<dyn Any + Send + Sync>,
}

/// `unshaken merge`, without its output on a terminal. Arguments are those of `merge`, without the word itself.
pub trait Program: Send + Sync {
    /// Reads the frames that the arguments name and finds their response.
    ///
    /// # Errors
    /// What `merge` refuses, in its words.
    fn open(&self, arguments: &[OsString], events: &mut dyn FnMut(Event) -> bool) -> anyhow::Result<Opened>;

    /// The settings for frames of full size that the arguments ask for.
    ///
    /// # Errors
    /// What `merge` refuses.
    fn settings(&self, arguments: &[OsString], opened: &Opened) -> anyhow::Result<Settings>;

    /// Writes the outputs that the arguments ask for, of the merge of `bracket`; returns what was written, in words.
    ///
    /// # Errors
    /// As `merge`.
    fn write(
        &self,
        arguments: &[OsString],
        opened: &Opened,
        bracket: &Bracket,
        outcome: &Outcome,
        warnings: &[String],
    ) -> anyhow::Result<String>;
}
