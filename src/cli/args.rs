//! The command line.

use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;

/// Turns a hand-held exposure bracket with camera shake into one sharp HDR irradiance image.
#[derive(Debug, Parser)]
#[command(name = "unshaken", version, about, after_help = EXAMPLES)]
pub(super) struct CommandLine {
    #[command(subcommand)]
    pub command: Command,
    #[command(flatten)]
    pub session: SessionArgs,
}

/// What every command understands.
#[derive(Debug, Args)]
pub(super) struct SessionArgs {
    /// Say nothing but errors
    #[arg(long, global = true, conflicts_with = "json", help_heading = "Output of the program")]
    pub quiet: bool,
    /// Tell progress, warnings and results as JSON lines on standard output
    #[arg(long, global = true, help_heading = "Output of the program")]
    pub json: bool,
}

const EXAMPLES: &str = "Examples:
  unshaken demo
  unshaken merge -o night.exr --preview night.png IMG_1.jpg IMG_2.jpg IMG_3.jpg
  unshaken merge -o night.exr --report-html night.html IMG_*.dng
  unshaken tonemap night.exr -o night.jpg --tonemap reinhard-local:key=0.22
  unshaken batch photos/ --output-dir merged --dry-run";

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
    /// Make a picture for the screen from a linear image
    Tonemap(TonemapArgs),
    /// Open a window: see a bracket, nudge it, export it
    #[cfg(feature = "preview")]
    Preview(PreviewArgs),
    /// Find the brackets among many photographs and merge each
    Batch(BatchArgs),
    /// Print the completions of a shell, or the manual page
    Generate(GenerateArgs),
}

#[derive(Debug, Args)]
#[command(after_help = MERGE_EXAMPLES)]
pub(super) struct MergeArgs {
    /// Frames of one scene (camera raw, JPEG, PNG, TIFF, OpenEXR or Radiance HDR), counted from 1
    #[arg(required = true, value_name = "FRAME")]
    pub frames: Vec<PathBuf>,
    /// Linear irradiance as OpenEXR, Radiance .hdr or TIFF, by the name's ending; 1.0 is the white of the reference frame
    #[arg(short, long, value_name = "OUT.exr")]
    pub output: PathBuf,
    #[command(flatten)]
    pub photo: PhotoArgs,
    /// Exposure times in seconds in the order of the frames, such as 1/30,1/8,0.2 [default: from EXIF]
    #[arg(long, value_name = "T,T,...", allow_hyphen_values = true)]
    pub exposures: Option<String>,
    /// Camera response: srgb, linear, gamma:2.2, a file from 'unshaken calibrate', or auto (from these frames) [default: what raw files
    /// and profiles of PNG and TIFF files state; auto for JPEG; else srgb with a warning]
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
    /// Let all sharp frames count where something moved between them, instead of the one that shows it best
    #[arg(long)]
    pub keep_ghosts: bool,
    /// Exit with code 3 when a frame was left out or nothing could be deblurred (what there is is written all the same)
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
    /// Largest reach in pixels of the local blurs (PSFs) in the report, and of those of pairs of patches [default: as far as the camera's motion
    /// takes the place; of pairs of patches 12, at most a quarter of a patch]
    #[arg(long, value_name = "R", allow_hyphen_values = true)]
    pub psf_radius: Option<String>,
    /// Side in pixels of the patches from pairs of which blurs are found (blind: patches) [default: 120]
    #[arg(long, value_name = "PIXELS", allow_hyphen_values = true)]
    pub patch_size: Option<String>,
    /// What the picture is taken to look like: collaborative (patches that look alike are freed of noise together), tv (few edges: total variation alone)
    #[arg(long, value_name = "PRIOR", value_parser = ["collaborative", "tv"], default_value = "collaborative")]
    pub prior: String,
    /// Weight of the smoothness: more is smoother and less noisy [default: 2.5]
    #[arg(long, value_name = "L", allow_hyphen_values = true)]
    pub lambda: Option<String>,
    /// How much a shaken frame loses weight where its blur does not explain it: 0 (trusted everywhere) and more [default: 1]
    #[arg(long, value_name = "C", allow_hyphen_values = true)]
    pub robust: Option<String>,
    /// Full well and read noise in electrons, such as 12000,6 [default: what DNG files note, else estimated from the frames]
    #[arg(long, value_name = "FULL_WELL,READ_NOISE", allow_hyphen_values = true)]
    pub noise: Option<String>,
    /// Interpolation of the blurred frames' warps
    #[arg(long, value_name = "KERNEL", value_parser = ["bilinear", "bicubic", "six-point"], default_value = "bicubic")]
    pub interpolation: String,
    /// When no frame is sharp: auto (all blurs and the scene together, if the shortest frame is soft and that explains the frames better), joint (in any case), patches (the paper's way: from pairs of patches), off (the shortest frame counts as sharp) [default: auto]
    #[arg(long, value_name = "auto|joint|patches|off")]
    pub blind: Option<String>,
    /// Use these TSFs instead of estimating them (frames are found by file name, without folder)
    #[arg(long, value_name = "FILE.json")]
    pub tsf: Option<PathBuf>,
    /// Solve at a reduced size, for a quick look: 0.5, 0.25, ... (one over a whole number)
    #[arg(long, value_name = "S", allow_hyphen_values = true)]
    pub scale: Option<String>,
    /// Most GPU memory to use, such as 2GiB or 800MiB; less is slower [default: all there is]
    #[arg(long, value_name = "SIZE", allow_hyphen_values = true)]
    pub memory_limit: Option<String>,
    /// Write a tone-mapped picture of the result, as PNG or JPEG by the name's ending
    #[arg(long, value_name = "OUT.png|OUT.jpg")]
    pub preview: Option<PathBuf>,
    /// Write everything that was estimated and how well it fits
    #[arg(long, value_name = "OUT.json")]
    pub report: Option<PathBuf>,
    /// Replace outputs that exist
    #[arg(long)]
    pub overwrite: bool,
}

const MERGE_EXAMPLES: &str = "Examples:
  unshaken merge -o night.exr --preview night.png IMG_1.jpg IMG_2.jpg IMG_3.jpg
  unshaken merge -o night.exr --exposures 1/30,1/8,0.5,2 --response camera.json a.png b.png c.png d.png
  unshaken merge -o night.exr --primaries rec2020 --half --report-html night.html IMG_*.dng

Exit codes: 0 done, 1 failed, 2 wrong command line, 3 done but degraded (with --strict), 130 interrupted.";

/// Photographers' files: what goes in, what comes out.
#[derive(Debug, Args)]
pub(super) struct PhotoArgs {
    /// Relative exposures in EV in the order of the frames, such as -2,0,2, instead of times
    #[arg(long, value_name = "EV,EV,...", allow_hyphen_values = true, conflicts_with = "exposures")]
    pub ev: Option<String>,
    /// Value of floating-point frames (OpenEXR, Radiance HDR, TIFF) from which they are clipped [default: 1]
    #[arg(long, value_name = "V", allow_hyphen_values = true)]
    pub white: Option<String>,
    /// Primaries of the result: rec709, rec2020, p3 or acescg [default: rec709]
    #[arg(long, value_name = "NAME", help_heading = "Result")]
    pub primaries: Option<String>,
    /// Write 16 bits: half floats in OpenEXR, integers in TIFF [default: 32-bit float]
    #[arg(long, help_heading = "Result")]
    pub half: bool,
    /// Pixel values are cd/m2, from aperture, ISO speed and exposure time of the reference frame
    #[arg(long, help_heading = "Result")]
    pub absolute: bool,
    /// Add channels to the OpenEXR file: confidence, saturation, residual, weight of each frame
    #[arg(long, help_heading = "Result")]
    pub layers: bool,
    /// Tone mapping of --preview: filmic, reinhard, reinhard-local, durand or fattal, with parameters such as filmic:exposure=1 [default: filmic]
    #[arg(long, value_name = "OP[:NAME=V,...]", help_heading = "Result")]
    pub tonemap: Option<String>,
    /// Give the JPEG of --preview a gain map (Ultra HDR): brighter highlights where the screen can show them
    #[arg(long, help_heading = "Result")]
    pub gain_map: bool,
    /// Write one page (HTML) that shows everything: before and after, frames, masks, blur, residuals, settings
    #[arg(long, value_name = "OUT.html", help_heading = "Result")]
    pub report_html: Option<PathBuf>,
    /// Options from a TOML file [default: unshaken/config.toml in the user's configuration folder, where it exists]
    #[arg(long, value_name = "FILE.toml", help_heading = "Settings")]
    pub config: Option<PathBuf>,
    /// Options of one [preset.NAME] table of the configuration, or of a built-in one: archive, small
    #[arg(long, value_name = "NAME", help_heading = "Settings")]
    pub preset: Option<String>,
    /// Print the options that are in force, as a configuration file, and stop
    #[arg(long, help_heading = "Settings")]
    pub print_config: bool,
}

#[derive(Debug, Args)]
#[command(after_help = TONEMAP_EXAMPLES)]
pub(super) struct TonemapArgs {
    /// Linear image: OpenEXR, Radiance HDR or floating-point TIFF
    #[arg(value_name = "IN.exr")]
    pub input: PathBuf,
    /// Picture: PNG or JPEG, by the name's ending
    #[arg(short, long, value_name = "OUT.png|OUT.jpg")]
    pub output: PathBuf,
    /// Operator: filmic, reinhard, reinhard-local, durand or fattal, with parameters such as filmic:exposure=1,saturation=0.9
    #[arg(long, value_name = "OP[:NAME=V,...]", default_value = "filmic")]
    pub tonemap: String,
    /// Give the JPEG a gain map (Ultra HDR): brighter highlights where the screen can show them
    #[arg(long)]
    pub gain_map: bool,
    /// Quality of a JPEG, 1 to 100
    #[arg(long, value_name = "N", default_value_t = 92, value_parser = clap::value_parser!(u8).range(1..=100))]
    pub quality: u8,
    /// Replace an output that exists
    #[arg(long)]
    pub overwrite: bool,
}

const TONEMAP_EXAMPLES: &str = "Examples:
  unshaken tonemap night.exr -o night.png
  unshaken tonemap night.exr -o night.jpg --tonemap reinhard-local:key=0.22,saturation=0.9 --quality 95
  unshaken tonemap night.exr -o night.jpg --gain-map";

/// Options of 'merge' come beside these.
#[derive(Debug, Args)]
#[command(after_help = BATCH_EXAMPLES)]
pub(super) struct BatchArgs {
    /// Photographs, and folders whose photographs are meant
    #[arg(required_unless_present = "manifest", value_name = "DIR|FILE")]
    pub photographs: Vec<PathBuf>,
    /// Folder for the results, which is made if need be
    #[arg(long, value_name = "OUT")]
    pub output_dir: PathBuf,
    /// Print the brackets that were found, as a manifest, and stop
    #[arg(long)]
    pub dry_run: bool,
    /// The brackets, instead of finding them (TOML; --dry-run prints one)
    #[arg(long, value_name = "FILE.toml")]
    pub manifest: Option<PathBuf>,
    /// Longest pause in seconds between the end of one frame and the next of its bracket
    #[arg(long, value_name = "S", default_value_t = 3.0)]
    pub gap: f64,
    /// Brackets that are merged at a time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub jobs: u16,
    /// Only every Nth bracket, beginning with the Ith (counted from 1), so that N machines share the work
    #[arg(long, value_name = "I/N")]
    pub shard: Option<String>,
    /// Merge again what is done already
    #[arg(long)]
    pub again: bool,
}

const BATCH_EXAMPLES: &str = "Examples:
  unshaken batch photos/ --output-dir merged --dry-run > brackets.toml
  unshaken batch --manifest brackets.toml --output-dir merged --jobs 2 --response camera.json
  unshaken batch photos/ --output-dir merged --shard $SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT

Each bracket's result is OUT/NAME.exr with NAME.jpg and NAME.json beside it. What is finished is skipped when its frames and options are
the same. Options of 'merge' that are about one bracket's frames apply to all.

Exit codes: 0 all done, 1 some failed, 2 wrong command line, 3 none failed but some are degraded (with --strict), 130 interrupted.";

#[derive(Debug, Args)]
#[command(after_help = GENERATE_EXAMPLES)]
pub(super) struct GenerateArgs {
    /// What to print
    #[arg(value_enum)]
    pub what: Generate,
}

const GENERATE_EXAMPLES: &str = "Examples:
  unshaken generate bash > ~/.local/share/bash-completion/completions/unshaken
  unshaken generate zsh > ~/.zfunc/_unshaken
  unshaken generate fish > ~/.config/fish/completions/unshaken.fish
  unshaken generate man > unshaken.1 && man ./unshaken.1";

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
pub(super) enum Generate {
    /// Completions for bash
    Bash,
    /// Completions for zsh
    Zsh,
    /// Completions for fish
    Fish,
    /// The manual page (roff)
    Man,
}

#[derive(Debug, Args)]
#[command(after_help = CALIBRATE_EXAMPLES)]
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
    /// How: blocks (a smooth curve through the means of blocks), debevec (a table from single pixels) or mitsunaga (a polynomial, exposure
    /// times refined)
    #[arg(long, value_name = "NAME", value_enum, default_value_t = Method::Blocks)]
    pub method: Method,
    /// Replace an output that exists
    #[arg(long)]
    pub overwrite: bool,
}

const CALIBRATE_EXAMPLES: &str = "Examples:
  unshaken calibrate -o camera.json TRIPOD_1.jpg TRIPOD_2.jpg TRIPOD_3.jpg
  unshaken calibrate -o camera.json --method mitsunaga --exposures 1/30,1/8,0.5 a.png b.png c.png";

/// How a response is calibrated.
#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
pub(super) enum Method {
    Blocks,
    Debevec,
    Mitsunaga,
}

#[derive(Debug, Args)]
pub(super) struct DemoArgs {
    /// Folder for the results
    #[arg(long, value_name = "DIR", default_value = "unshaken-demo")]
    pub output_dir: PathBuf,
}

#[cfg(feature = "preview")]
const PREVIEW_EXAMPLES: &str = "Examples:
  unshaken preview IMG_1.jpg IMG_2.jpg IMG_3.jpg
  unshaken preview --blur session.json";

#[cfg(feature = "preview")]
#[derive(Debug, Args)]
#[command(after_help = PREVIEW_EXAMPLES)]
pub(super) struct PreviewArgs {
    /// Frames of one scene, or a saved session (.json); more can be opened in the window
    #[arg(value_name = "FRAME")]
    pub files: Vec<PathBuf>,
    /// Save a picture of the window once the full-size result is shown, and close it
    #[arg(long, value_name = "OUT.png")]
    pub screenshot: Option<PathBuf>,
    /// Size of the window in points, such as 1440x900
    #[arg(long, value_name = "WxH")]
    pub size: Option<String>,
    /// Begin with the blur view
    #[arg(long)]
    pub blur: bool,
    /// Colours of the window [default: the system's]
    #[arg(long, value_name = "light|dark", value_parser = ["light", "dark"])]
    pub theme: Option<String>,
}
