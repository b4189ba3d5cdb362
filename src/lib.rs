//! Sharp HDR irradiance from a hand-held exposure bracket whose frames are blurred by camera shake.
//!
//! The method follows C. S. Vijay, C. Paramanand, A. N. Rajagopalan and R. Chellappa, "Non-Uniform Deblurring in HDR
//! Image Reconstruction", IEEE Transactions on Image Processing 22(10), 2013 ("the paper"; equation numbers are its):
//!
//! 1. [`response`]: irradiance B = f⁻¹(Z)/Δt of each frame from its intensity Z and exposure time Δt (section II-A).
//! 2. [`mask`] and [`noise`]: which pixels count (Tukey window, eq. 8) and how much (inverse variance).
//! 3. [`register`] and [`photometry`]: where each frame lies, its gain and its black level; [`pipeline`] judges which are stationary.
//! 4. [`psf`]: patches of each blurred frame and their local PSFs h against the sharp reference (eq. 11).
//! 5. [`tsf`]: the transformation spread function h_T over poses Γ (eq. 2-6) from the PSFs, refined on the whole frame.
//!    When no frame is sharp, [`blind`] finds the TSFs of all frames and the scene together instead (section III-B).
//! 6. [`deblur`]: irradiance E that explains all frames, data term and total variation (eq. 9-10), by conjugate
//!    gradients on the GPU; K and its exact adjoint Kᵀ are the [`kernels`].
//! 7. [`pipeline`]: these stages in order, from [`exposure::Bracket`] to irradiance and report.

pub mod baseline;
pub mod blind;
pub mod channels;
pub mod cli;
pub mod collaborative;
pub mod colour;
pub mod deblur;
pub mod error;
pub mod experiments;
pub mod exposure;
mod fft;
pub mod ghosts;
pub mod gpu;
pub mod hot;
pub mod image;
pub mod io;
pub mod kernels;
pub mod layers;
pub mod mask;
mod maths;
pub mod merge;
pub mod metrics;
pub mod noise;
mod nonnegative;
pub mod photometry;
pub mod pipeline;
pub mod pose;
#[cfg(feature = "preview")]
pub mod preview;
pub mod psf;
pub mod random;
pub mod register;
pub mod response;
mod robust;
mod sampling;
pub mod synth;
pub mod tonemap;
pub mod tsf;
