//! The window of `unshaken preview`, without a screen: what it shows and hears, on a real device (feature `preview-tests`).

/// The window, its picture, a bracket's files.
mod support;

/// What the window is made of: times, histogram, PSFs, keys.
mod parts;
/// Undo, session files, the command line that a session is.
mod sessions;
/// What is drawn again and what is not, local operators, messages over the picture.
mod smooth;
/// Labels, clicks, keys, the divider, error messages.
mod window;

/// The program in a real window.
#[cfg(target_os = "linux")]
mod screen;
