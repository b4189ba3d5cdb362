//! Brackets without a sharp frame (section III-B): irradiance and the TSFs of all frames together.
//!
//! Coarse to fine over the whole bracket, on luminance: with the TSFs held, the latent luminance that explains all frames
//! (a solver on the CPU); with the luminance held, each frame's TSF from the whole frame ([`crate::tsf::WholeFrame`]). It starts from the least
//! blurred frame, the smoothness is strong at first and falls. At the end the TSFs are cross-validated: pixels held out in turn have to be explained by
//! the luminance that the others give.
//!
//! Any common warp of all TSFs can be made good by the opposite warp of the scene. It is fixed so that the mean pose of the reference
//! frame is the identity.

mod joint;
mod lens;
mod luminance;
mod operator;
mod patches;

pub use joint::{
    Begun, Doubt, FittedTo, Joint, Known, Stage, Start, Way, cross_validated, doubt, estimate, fits, fix_warp, geometric_mean,
};
pub use luminance::{Frame, luminance_of};
pub use operator::Operator;
pub use patches::{Lack, PatchSetup, Patches, from_patches};
