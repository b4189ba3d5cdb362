//! Brackets with known truth: a scene drawn by the program, a hand's tremor, a camera. Never imports an estimator.

pub mod capture;
pub mod font;
pub mod random;
pub mod scene;
pub mod shake;

pub use capture::{Camera, SyntheticBracket, capture, expose};
pub use scene::{Scene, room};
pub use shake::{Tremor, identity};
