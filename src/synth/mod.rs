//! Brackets with known truth: a scene drawn by the program, a hand's tremor, a camera. Never imports an estimator.

pub mod capture;
pub mod font;
pub mod gyro;
pub mod motion;
pub mod scene;
pub mod shake;

pub use capture::{Camera, SyntheticBracket, capture, expose, integrate, photograph};
pub use gyro::GyroRecord;
pub use motion::{Motion, Shake, Wobble};
pub use scene::{Drawn, Scene, room};
pub use shake::{Tremor, identity};
