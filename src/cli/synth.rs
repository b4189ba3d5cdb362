//! `unshaken synth`: a hand-held bracket with known truth.

use super::{Usage, given, with_progress};
use crate::error::Error;
use crate::exposure::Frame;
use crate::image::Rgb;
use crate::io::exif::{self, Format};
use crate::io::exr::{self, Radiometry};
use crate::io::output::Output;
use crate::pipeline::Event;
use crate::response::Response;
use crate::synth::{self, Camera, Drawn, GyroRecord, Motion, Scene, Shake, Tremor, Wobble};
use crate::tsf::{TsfEntry, TsfFile};
use anyhow::Context;
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "Examples:
  unshaken synth --scene window --tripod --output-dir bracket
  unshaken synth photograph.exr --exposures 1/30,1/8,1 --extent 20 --seed 7 --output-dir bracket";

#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct SynthArgs {
    /// Linear OpenEXR photograph to take as the scene
    #[arg(value_name = "SCENE.exr", required_unless_present = "scene", conflicts_with = "scene")]
    pub photograph: Option<PathBuf>,
    /// Scene drawn by the program: room, chart, lamps, foliage or window, each over five decades
    #[arg(long, value_name = "NAME")]
    pub scene: Option<String>,
    /// Folder for the bracket, made if need be
    #[arg(long, value_name = "DIR")]
    pub output_dir: PathBuf,
    /// Exposure times in seconds
    #[arg(long, value_name = "T,T,...", default_value = "1/30,1/8,1/5,1/2,2", allow_hyphen_values = true)]
    pub exposures: String,
    /// Which frames are shaken, counted from 1, or 'all' or 'none' [default: those longer than 1/4 s]
    #[arg(long, value_name = "N,N,...", allow_hyphen_values = true)]
    pub shaken: Option<String>,
    /// Motion of shaken frames: tremor (smooth, off every grid), grid (whole pixels to 12 and quarter degrees to 1.5, as the
    /// paper), 6d (eq. 2, with --focal-px and --depth), or gyro:FILE (a gyroscope's record: ns, rad/s about x, y, z)
    #[arg(long, value_name = "KIND", default_value = "tremor")]
    pub shake: String,
    /// Extent of the longest frame's shift in pixels (tremor, grid; for 6d that of T_X or T_Y)
    #[arg(long, value_name = "PX", default_value = "12", allow_hyphen_values = true)]
    pub extent: String,
    /// Extent of the longest frame's roll in degrees (tremor, grid, 6d)
    #[arg(long, value_name = "DEG", default_value = "1", allow_hyphen_values = true)]
    pub roll: String,
    /// Extent of the longest frame's pitch or yaw in degrees (6d)
    #[arg(long, value_name = "DEG", default_value = "0.5", allow_hyphen_values = true)]
    pub tilt: String,
    /// Extent of T_Z in metres (6d)
    #[arg(long, value_name = "M", default_value = "0.001", allow_hyphen_values = true)]
    pub nearing: String,
    /// Factor on the angles of a gyroscope's record
    #[arg(long, value_name = "K", default_value = "1", allow_hyphen_values = true)]
    pub strength: String,
    /// Distance of the scene in metres (6d)
    #[arg(long, value_name = "M", default_value = "2", allow_hyphen_values = true)]
    pub depth: String,
    /// Focal length in pixels [default: 1.2 times the frame's width]
    #[arg(long, value_name = "PX", allow_hyphen_values = true)]
    pub focal_px: Option<String>,
    /// Displace every frame but the first by up to PX pixels in x and y, and up to PX/60 degrees
    #[arg(long, value_name = "PX", default_value = "0", allow_hyphen_values = true)]
    pub shift: String,
    /// Frames of the drawn scenes, WIDTHxHEIGHT; for a photograph the width alone counts [default: 512x384, or what it allows]
    #[arg(long, value_name = "WxH")]
    pub size: Option<String>,
    /// Content beyond the frame that the shake can bring in, pixels
    #[arg(long, value_name = "PX", default_value_t = 48)]
    pub margin: usize,
    /// Samples of the scene per pixel and direction
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=8))]
    pub oversampling: u8,
    /// Largest step of any pixel between two samples of the motion, pixels
    #[arg(long, value_name = "PX", default_value = "0.25", allow_hyphen_values = true)]
    pub step: String,
    /// Median luminance of the scene: this part of white after 1 s
    #[arg(long, value_name = "E", default_value = "0.05", allow_hyphen_values = true)]
    pub median: String,
    /// Camera response: srgb, linear, gamma:2.2, or a file from 'unshaken calibrate'
    #[arg(long, value_name = "NAME|FILE.json", default_value = "srgb")]
    pub response: String,
    /// Electrons at white
    #[arg(long, value_name = "E", default_value = "4000", allow_hyphen_values = true)]
    pub full_well: String,
    /// Read noise in electrons
    #[arg(long, value_name = "E", default_value = "8", allow_hyphen_values = true)]
    pub read_noise: String,
    /// Bits of an intensity code; more than 8 are stored as 16-bit PNG
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u8).range(8..=16))]
    pub bits: u8,
    /// Write JPEG frames of this quality instead of PNG
    #[arg(long, value_name = "QUALITY", value_parser = clap::value_parser!(u8).range(1..=100))]
    pub jpeg: Option<u8>,
    /// Also write the frames that a camera on a tripod would have taken
    #[arg(long)]
    pub tripod: bool,
    /// Seed of scene, shake and noise: the same seed makes the same bracket on every machine
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Replace outputs that exist
    #[arg(long)]
    pub overwrite: bool,
}

/// A frame is taken to be shaken when it is longer than this, seconds.
const SHAKEN_FROM: f64 = 0.25;
/// Part of the extent that a frame of time Δt sees, of the longest's: (Δt / longest) to this power, as tremor is mostly slow.
const GROWTH: f64 = 0.35;

/// Numbers checked before anything is made.
struct Numbers {
    times: Vec<f64>,
    shaken: Vec<bool>,
    shake: Shake,
    focal_px: Option<f64>,
    shift: f64,
    size: Option<(usize, Option<usize>)>,
    step: f64,
    median: f64,
    camera: Camera,
}

pub(super) fn run(args: &SynthArgs) -> anyhow::Result<()> {
    let drawn = args.scene.as_deref().map(Drawn::named).transpose().map_err(|e| Usage(format!("--scene: {e}")))?;
    let numbers = numbers(args)?;
    std::fs::create_dir_all(&args.output_dir)
        .with_context(|| format!("{}: cannot be made; choose another --output-dir", args.output_dir.display()))?;
    let format = args.jpeg.map_or(Format::Png, Format::Jpeg);
    let targets = Targets::check(args, numbers.times.len(), format)?;
    let text = with_progress(|events| {
        events(Event::Progress { stage: "making the scene".into(), fraction: 0.0 });
        let n = usize::from(args.oversampling);
        let scene = match (drawn, &args.photograph) {
            (Some(drawn), _) => {
                let (width, height) = numbers.size.map_or((512, 384), |(w, h)| (w, h.unwrap_or((w * 3 / 4).max(1))));
                drawn.draw(width, height, args.margin, n, args.seed)
            }
            (None, Some(path)) => {
                let (image, _) = exr::read(path)?;
                Scene::photograph(&image, numbers.size.map(|s| s.0), args.margin, n)
                    .map_err(|e| Error::Format { path: path.clone(), reason: e.to_string() })?
            }
            (None, None) => return Err(Usage("no scene; give SCENE.exr or --scene NAME".into()).into()),
        };
        let (width, height) = scene.frame_size();
        let focal_px = numbers.focal_px.unwrap_or(1.2 * width as f64);
        events(Event::Progress { stage: "shaking".into(), fraction: 0.2 });
        let motions = motions(args, &numbers, width, height, focal_px)?;
        let frames: Vec<(f64, Motion)> = numbers.times.iter().copied().zip(motions).collect();
        let (mut made, mut tripod) = synth::photograph(&scene, &numbers.camera, &frames, numbers.median, args.seed, args.tripod)?;
        let reference = (0..frames.len()).filter(|&i| made.sharp[i]).max_by(|&a, &b| frames[a].0.total_cmp(&frames[b].0)).unwrap_or(0);
        let seconds = frames[reference].0;
        let radiometry = Radiometry { exposure_time: seconds, frame: targets.name("frame", reference) };
        let truth = made.truth.map_planes(|p| p.map(|v| v * seconds as f32));
        let tsfs =
            TsfFile::new(made.tsfs.iter().enumerate().map(|(i, t)| TsfEntry::new(&targets.name("frame", i), width, height, t)).collect());
        events(Event::Progress { stage: "writing".into(), fraction: 0.8 });
        let shortest = numbers.times.iter().copied().fold(f64::INFINITY, f64::min);
        let description = json!({
            "format": "unshaken-bracket",
            "version": 1,
            "program": concat!("unshaken ", env!("CARGO_PKG_VERSION")),
            "scene": args.scene.clone().unwrap_or_else(|| args.photograph.as_ref().map_or(String::new(), |p| p.display().to_string())),
            "seed": args.seed,
            "size": [width, height],
            "margin_px": args.margin,
            "oversampling": args.oversampling,
            "step_px": numbers.step,
            "focal_px": focal_px,
            "response": args.response,
            "full_well": numbers.camera.full_well,
            "read_noise": numbers.camera.read_noise,
            "bits": args.bits,
            "shake": args.shake,
            "truth": { "file": "truth.exr", "unit": "value = irradiance * exposure time of the reference frame; irradiance 1 is white after 1 s",
                "reference": targets.name("frame", reference), "factor_s": seconds,
                // Beyond it even the shortest frame is clipped: what no frame recorded is not to be judged.
                "limit": 0.98 / shortest * seconds },
            "frames": (0..frames.len()).map(|i| json!({
                "file": targets.name("frame", i),
                "tripod": args.tripod.then(|| targets.name("tripod", i)),
                "exposure_time_s": frames[i].0,
                "sharp": made.sharp[i],
                "nearing": frames[i].1.nearing,
                "poses": made.tsfs[i].poses,
            })).collect::<Vec<_>>(),
        });
        let mut staged =
            vec![targets.bracket.stage_json(&description)?, targets.truth.stage_exr(&truth, &radiometry)?, targets.tsf.stage_json(&tsfs)?];
        let brackets = [("frame", Some(&mut made.bracket)), ("tripod", tripod.as_mut())];
        for (stem, bracket) in brackets {
            let Some(bracket) = bracket else { continue };
            for (i, frame) in bracket.frames().iter().enumerate() {
                let picture = codes(frame);
                staged.push(targets.frame(stem, i).stage(|to| exif::write(to, &picture, format, frame.exposure_time))?);
            }
        }
        for file in staged {
            file.commit()?;
        }
        Ok(summary(args, &numbers, &targets, (width, height), &made.truth, seconds))
    })?;
    super::progress::done(&text, serde_json::json!({ "output": args.output_dir }));
    Ok(())
}

fn summary(args: &SynthArgs, numbers: &Numbers, targets: &Targets, (width, height): (usize, usize), truth: &Rgb, seconds: f64) -> String {
    let mut lum = truth.mean().data;
    lum.sort_unstable_by(f32::total_cmp);
    let decades = (lum[lum.len() - 1] / lum[0].max(f32::MIN_POSITIVE)).log10();
    let shaken = numbers.shaken.iter().filter(|s| **s).count();
    let shortest = numbers.times.iter().copied().fold(f64::INFINITY, f64::min);
    let dir = args.output_dir.display();
    let frames: Vec<String> = (0..numbers.times.len()).map(|i| format!("{dir}/{}", targets.name("frame", i))).collect();
    format!(
        "wrote {} of {width} x {height} pixels to {dir}, {shaken} of them shaken; the scene spans {decades:.1} decades\nmerge:   unshaken merge -o {dir}/result.exr {}\ncompare: unshaken compare --limit {:.6} {dir}/result.exr {dir}/truth.exr",
        super::frames::count(numbers.times.len(), "frame"),
        frames.join(" "),
        0.98 / shortest * seconds,
    )
}

/// The files of a bracket.
struct Targets {
    extension: &'static str,
    bracket: Output,
    truth: Output,
    tsf: Output,
    frames: Vec<Output>,
    tripod: Vec<Output>,
}

impl Targets {
    fn check(args: &SynthArgs, frames: usize, format: Format) -> Result<Self, Error> {
        let extension = if format == Format::Png { "png" } else { "jpg" };
        let at = |name: &str| Output::check(&args.output_dir.join(name), args.overwrite);
        let all = |stem: &str, n: usize| (1..=n).map(|i| at(&format!("{stem}{i}.{extension}"))).collect::<Result<Vec<_>, _>>();
        Ok(Self {
            extension,
            bracket: at("bracket.json")?,
            truth: at("truth.exr")?,
            tsf: at("truth_tsf.json")?,
            frames: all("frame", frames)?,
            tripod: all("tripod", if args.tripod { frames } else { 0 })?,
        })
    }

    fn name(&self, stem: &str, i: usize) -> String {
        format!("{stem}{}.{}", i + 1, self.extension)
    }

    fn frame(&self, stem: &str, i: usize) -> &Output {
        if stem == "tripod" { &self.tripod[i] } else { &self.frames[i] }
    }
}

/// The frame's codes as a picture: 8 bits as they are, more stretched to 16.
fn codes(frame: &Frame) -> image::DynamicImage {
    let (width, height) = frame.intensity.size();
    let at = |x: u32, y: u32| frame.intensity.pixel(y as usize * width + x as usize);
    let (w, h) = (width as u32, height as u32);
    if frame.levels == 255 {
        crate::tonemap::codes(&frame.intensity).into()
    } else {
        image::ImageBuffer::<image::Rgb<u16>, _>::from_fn(w, h, |x, y| image::Rgb(at(x, y).map(|v| (v * 65535.0).round() as u16))).into()
    }
}

/// The frames' motions, displacement included.
fn motions(args: &SynthArgs, numbers: &Numbers, width: usize, height: usize, focal_px: f64) -> crate::error::Result<Vec<Motion>> {
    let longest = numbers.times.iter().copied().fold(0.0, f64::max);
    let mut displacement = crate::random::Random::new(args.seed, u64::MAX);
    let mut out = Vec::new();
    for (i, (&time, &shaken)) in numbers.times.iter().zip(&numbers.shaken).enumerate() {
        let motion = if shaken {
            let part = (time / longest).powf(GROWTH);
            numbers.shake.motion(width, height, focal_px, time, part, numbers.step, args.seed, i as u64 + 1)?
        } else {
            Shake::none(width)
        };
        let mut draw = || displacement.uniform(-1.0, 1.0) * numbers.shift;
        let (x, y, roll) = (draw(), draw(), draw() / 60.0);
        out.push(if i == 0 || numbers.shift == 0.0 { motion } else { motion.displaced(x, y, roll) });
    }
    Ok(out)
}

fn numbers(args: &SynthArgs) -> anyhow::Result<Numbers> {
    let times = args.exposures.split(',').map(|w| seconds(w.trim())).collect::<Result<Vec<_>, _>>()?;
    if times.len() < 2 {
        return Err(Usage("--exposures: a bracket needs two or more times; give seconds such as 1/30,1/8,2".into()).into());
    }
    let n = times.len();
    let shaken = match args.shaken.as_deref() {
        None => times.iter().map(|&t| t > SHAKEN_FROM).collect(),
        Some("all") => vec![true; n],
        Some("none") => vec![false; n],
        Some(list) => {
            let listed = given::frame_numbers("--shaken", list, n)?;
            (0..n).map(|i| listed.contains(&i)).collect()
        }
    };
    let positive = |option: &str, word: &str| number(option, word, f64::MIN_POSITIVE, 1e9);
    let extent = |option: &str, word: &str| number(option, word, 0.0, 1e4);
    let tremor =
        Tremor { extent_px: extent("--extent", &args.extent)?, roll_deg: extent("--roll", &args.roll)?, offset_px: 1.5, offset_deg: 0.1 };
    let depth_m = positive("--depth", &args.depth)?;
    let focal_px = args.focal_px.as_deref().map(|w| positive("--focal-px", w)).transpose()?;
    let size = args.size.as_deref().map(size).transpose()?;
    let shake = match args.shake.as_str() {
        "tremor" => Shake::Tremor(tremor),
        "grid" => Shake::Grid(tremor),
        "6d" => {
            // The extent in pixels is what a photographer sees; eq. (2) wants metres at that depth and focal length.
            let focal = focal_px.unwrap_or_else(|| 1.2 * size.map_or(512, |s| s.0) as f64);
            Shake::SixD(Wobble {
                shift_m: tremor.extent_px * depth_m / focal,
                nearing_m: extent("--nearing", &args.nearing)?,
                tilt_deg: extent("--tilt", &args.tilt)?,
                roll_deg: tremor.roll_deg,
                depth_m,
            })
        }
        word => match word.strip_prefix("gyro:") {
            Some(path) => {
                let path = PathBuf::from(path);
                let record = GyroRecord::parse(&crate::io::read_text(&path)?).map_err(|e| Error::Format { path, reason: e.to_string() })?;
                Shake::Gyro { record, strength: extent("--strength", &args.strength)? }
            }
            None => return Err(Usage(format!("--shake: {word:?} is not a motion; choose tremor, grid, 6d or gyro:FILE")).into()),
        },
    };
    let camera = Camera {
        full_well: positive("--full-well", &args.full_well)?,
        read_noise: extent("--read-noise", &args.read_noise)?,
        response: response(&args.response)?,
        bits: u32::from(args.bits),
    };
    if args.jpeg.is_some() && args.bits > 8 {
        return Err(Usage("--jpeg holds 8 bits; leave out --bits or --jpeg".into()).into());
    }
    Ok(Numbers {
        times,
        shaken,
        shake,
        focal_px,
        shift: extent("--shift", &args.shift)?,
        size,
        step: number("--step", &args.step, 1e-3, 10.0)?,
        median: positive("--median", &args.median)?,
        camera,
    })
}

fn response(word: &str) -> anyhow::Result<Response> {
    match Response::named(word).map_err(|e| Usage(format!("--response: {e}")))? {
        Some(response) => Ok(response),
        None => Ok(given::read_response(Path::new(word))?),
    }
}

fn seconds(word: &str) -> Result<f64, Usage> {
    let value = match word.split_once('/') {
        Some((a, b)) => a.trim().parse::<f64>().and_then(|a| Ok(a / b.trim().parse::<f64>()?)),
        None => word.parse(),
    };
    match value {
        Ok(t) if t.is_finite() && t > 0.0 => Ok(t),
        _ => Err(Usage(format!("--exposures: {word:?} is not a positive time; give seconds such as 1/30 or 0.2"))),
    }
}

fn number(option: &str, word: &str, low: f64, high: f64) -> Result<f64, Usage> {
    match word.trim().parse::<f64>() {
        Ok(v) if (low..=high).contains(&v) => Ok(v),
        _ if low > 0.0 && low < 1e-100 => Err(Usage(format!("{option}: {word:?} is not a positive number up to {high}"))),
        _ => Err(Usage(format!("{option}: {word:?} is not a number from {low} to {high}"))),
    }
}

/// Largest side of a frame that is made, pixels.
const LARGEST: usize = 20_000;

fn size(word: &str) -> Result<(usize, Option<usize>), Usage> {
    let refuse = || Usage(format!("--size: {word:?} is not a size from 32 to {LARGEST} pixels; give WIDTHxHEIGHT such as 640x480"));
    let side = |w: &str| w.trim().parse().ok().filter(|n| (32..=LARGEST).contains(n)).ok_or_else(refuse);
    match word.split_once(['x', 'X']) {
        Some((w, h)) => Ok((side(w)?, Some(side(h)?))),
        None => Ok((side(word)?, None)),
    }
}
