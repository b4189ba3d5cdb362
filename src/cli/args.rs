//! The command line.

use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;

/// Turns a hand-held exposure bracket with camera shake into one sharp HDR irradiance image.
#[derive(Debug, Parser)]
#[command(name = "unshaken", version, about)]
pub(super) struct CommandLine {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Reconstruct the sharp irradiance of a bracket
    Merge(Box<MergeArgs>),
    /// Measure the camera's response from an unblurred bracket (tripod), for merge --response
    Calibrate(CalibrateArgs),
    /// Make a shaken bracket, reconstruct it, and show what was gained
    Demo(DemoArgs),
    /// Make a hand-held bracket with known truth from a scene
    Synth(Box<super::synth::SynthArgs>),
    /// Judge results against the truth, or pictures by their sharpness
    Compare(super::compare::CompareArgs),
    /// Merge a bracket by what one would do instead, and judge all beside each other
    Baseline(super::baseline::BaselineArgs),
    /// Repeat the experiments of the paper: tables and pictures
    Experiment(super::experiment::ExperimentArgs),
    /// List the GPU adapters and the one that would be used
    Adapters,
}

#[derive(Debug, Args)]
pub(super) struct MergeArgs {
    /// Frames of one scene (PNG, JPEG or TIFF, 8 or 16 bits), counted from 1
    #[arg(required = true, value_name = "FRAME")]
    pub frames: Vec<PathBuf>,
    /// Irradiance as linear 32-bit float OpenEXR; 1.0 is the white of the reference frame
    #[arg(short, long, value_name = "OUT.exr")]
    pub output: PathBuf,
    /// Exposure times in seconds in the order of the frames, such as 1/30,1/8,0.2 [default: from EXIF]
    #[arg(long, value_name = "T,T,...", allow_hyphen_values = true)]
    pub exposures: Option<String>,
    /// Camera response: srgb, linear, gamma:2.2, a file from 'unshaken calibrate', or auto (from these frames) [default: auto for
    /// JPEG, srgb with a warning for PNG and TIFF]
    #[arg(long, value_name = "NAME|FILE.json")]
    pub response: Option<String>,
    /// Frame on whose pixel grid the result lies [default: the longest sharp frame]
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub reference: Option<String>,
    /// These frames are sharp [default: found out]
    #[arg(long, value_name = "N,N,...", allow_hyphen_values = true)]
    pub sharp: Option<String>,
    /// Leave these frames out
    #[arg(long, value_name = "N,N,...", allow_hyphen_values = true)]
    pub exclude: Option<String>,
    /// Take the frames as they lie, without registering them against each other
    #[arg(long)]
    pub no_align: bool,
    /// Exit with code 3 when a frame had to be left out (what the others give is written all the same)
    #[arg(long)]
    pub strict: bool,
    /// Alpha of the Tukey window over intensity, 0 to 1: the part of the range where weights taper off [default: 0.3]
    #[arg(long, value_name = "A", allow_hyphen_values = true)]
    pub alpha: Option<String>,
    /// How the camera may move while a frame is exposed: auto, rigid (shift and roll), translation, rotation (pitch, yaw, roll)
    /// or full (all five) [default: auto]
    #[arg(long, value_name = "MODEL")]
    pub model: Option<String>,
    /// Focal length in pixels [default: from EXIF, else found or 1.2 times the longer side]
    #[arg(long, value_name = "F", allow_hyphen_values = true)]
    pub focal_px: Option<String>,
    /// Look at the blur around this pixel, for the report; may be given several times [default: nine places are chosen]
    #[arg(long, value_name = "X,Y", allow_hyphen_values = true)]
    pub patch: Vec<String>,
    /// Full well and read noise in electrons, such as 12000,6 [default: estimated from the frames]
    #[arg(long, value_name = "FULL_WELL,READ_NOISE", allow_hyphen_values = true)]
    pub noise: Option<String>,
    /// Interpolation of the warps
    #[arg(long, value_name = "KERNEL", value_parser = ["bilinear", "bicubic", "six-point"], default_value = "bilinear")]
    pub interpolation: String,
    /// Use these TSFs instead of estimating them (frames are found by file name, without folder)
    #[arg(long, value_name = "FILE.json")]
    pub tsf: Option<PathBuf>,
    /// Solve at a reduced size, for a quick look: 0.5, 0.25, ... (one over a whole number)
    #[arg(long, value_name = "S", allow_hyphen_values = true)]
    pub scale: Option<String>,
    /// Most GPU memory to use, such as 2GiB or 800MiB; less is slower [default: all there is]
    #[arg(long, value_name = "SIZE", allow_hyphen_values = true)]
    pub memory_limit: Option<String>,
    /// Write a tone-mapped picture of the result
    #[arg(long, value_name = "OUT.png")]
    pub preview: Option<PathBuf>,
    /// Write everything that was estimated and how well it fits
    #[arg(long, value_name = "OUT.json")]
    pub report: Option<PathBuf>,
    /// Replace outputs that exist
    #[arg(long)]
    pub overwrite: bool,
}

#[derive(Debug, Args)]
pub(super) struct CalibrateArgs {
    /// Frames of one scene without shake (PNG, JPEG or TIFF), at two or more exposure times
    #[arg(required = true, value_name = "FRAME")]
    pub frames: Vec<PathBuf>,
    /// Response file to write
    #[arg(short, long, value_name = "RESPONSE.json")]
    pub output: PathBuf,
    /// Exposure times in seconds in the order of the frames, such as 1/30,1/8,0.2 [default: from EXIF]
    #[arg(long, value_name = "T,T,...", allow_hyphen_values = true)]
    pub exposures: Option<String>,
    /// How: debevec (a table, all exposure times believed) or mitsunaga (a polynomial, exposure times refined)
    #[arg(long, value_name = "NAME", value_enum, default_value_t = Method::Debevec)]
    pub method: Method,
    /// Replace an output that exists
    #[arg(long)]
    pub overwrite: bool,
}

/// How a response is calibrated.
#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
pub(super) enum Method {
    Debevec,
    Mitsunaga,
}

#[derive(Debug, Args)]
pub(super) struct DemoArgs {
    /// Folder for the results
    #[arg(long, value_name = "DIR", default_value = "unshaken-demo")]
    pub output_dir: PathBuf,
}
