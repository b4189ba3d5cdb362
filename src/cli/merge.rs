//! `unshaken merge`.

use super::args::MergeArgs;
use super::progress::done;
use super::{Done, Usage, frames, given, interrupt, page, with_progress};
use crate::colour::{self, Matrix, Primaries};
use crate::deblur::Prior;
use crate::error::Error;
use crate::exposure::Bracket;
use crate::io::exr::{self, Radiometry};
use crate::io::metadata::Metadata;
use crate::io::output::{self, Output};
use crate::layers;
use crate::noise::NoiseModel;
use crate::pipeline::{self, Blind, Event, Outcome, Settings};
use crate::response::Response;
use crate::tonemap::Operator;
use crate::tsf::{Interpolation, Model, TsfFile};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;

pub(super) fn run(args: &MergeArgs) -> anyhow::Result<Done> {
    // Everything that can be refused without reading pixels comes first: a merge takes a while.
    let asked = Asked::of(args)?;
    let targets = asked.outputs()?;
    let job = asked.read()?;
    let (text, quality) = with_progress(|events| {
        let mut opened = job.open(events)?;
        let settings = job.settings(&opened)?.reduced(job.asked.divisor);
        let tsf = job.tsf.as_ref().map(|t| t.reduced(job.asked.divisor));
        if job.asked.divisor > 1 {
            // The frames themselves are not needed any more: their memory is.
            opened.bracket = Arc::new(crate::response::reduced(&opened.bracket, &opened.response, job.asked.divisor)?);
        }
        let mut warnings = Vec::new();
        let outcome = pipeline::merge(&opened.bracket, &opened.response, &settings, tsf.as_ref(), &mut |event| {
            if let Event::Warning(text) = &event {
                warnings.push(text.clone());
            }
            events(event)
        })?;
        let text = job.write(&targets, &opened, &opened.bracket, &outcome, &warnings, events)?;
        let as_asked = outcome.degraded.is_empty();
        let quality = if as_asked { Done::AsAsked } else { Done::Degraded };
        Ok((text, quality))
    })?;
    done(&text, json!({ "output": args.output, "degraded": quality == Done::Degraded }));
    Ok(if args.strict { quality } else { Done::AsAsked })
}

/// A merge as its arguments ask for it, understood and checked as far as this needs no pixels.
pub(super) struct Job<'a> {
    asked: Asked<'a>,
    response: Option<Response>,
    tsf: Option<TsfFile>,
    photo: PhotoSettings,
}

/// The frames of a merge, and what the files say that pixels do not.
pub(super) struct Opened {
    pub bracket: Arc<Bracket>,
    pub response: Response,
    /// What the report says of the response.
    origin: Value,
    /// Noise that the files note.
    noise: Option<NoiseModel>,
    /// Of each frame, linear RGB to XYZ relative to D50.
    pub to_xyz: Vec<Matrix>,
    metadata: Vec<Metadata>,
    /// Exposures are 2^EV, not seconds.
    relative: bool,
    notes: Vec<String>,
}

/// What the arguments say by themselves.
pub(super) struct Asked<'a> {
    args: &'a MergeArgs,
    times: Option<Vec<f64>>,
    values: Option<Vec<f64>>,
    settings: Settings,
    divisor: usize,
    /// A response that has a name.
    named: Option<Response>,
    /// One that stands in a file.
    response_file: Option<PathBuf>,
}

impl<'a> Asked<'a> {
    /// Refuses what can be refused without reading a file.
    pub fn of(args: &'a MergeArgs) -> anyhow::Result<Self> {
        let times = args.exposures.as_deref().map(|list| frames::exposure_times(list, &args.frames)).transpose()?;
        let values = args.photo.ev.as_deref().map(|list| frames::exposure_values(list, &args.frames)).transpose()?;
        let settings = settings(args)?;
        let divisor = args.scale.as_deref().map_or(Ok(1), given::divisor)?;
        frames::check(&args.frames)?;
        let word = args.response.as_deref().filter(|r| *r != "auto");
        let named = word.map(Response::named).transpose().map_err(|e| Usage(format!("--response: {e}")))?.flatten();
        let response_file = word.filter(|_| named.is_none()).map(PathBuf::from);
        Ok(Self { args, times, values, settings, divisor, named, response_file })
    }

    /// The outputs, none of which may be an input.
    pub fn outputs(&self) -> anyhow::Result<Targets> {
        let args = self.args;
        let mut inputs: Vec<_> = args.frames.iter().map(|p| ("frame", p.as_path())).collect();
        inputs.extend(self.response_file.as_deref().map(|p| ("response file", p)));
        inputs.extend(args.tsf.as_deref().map(|p| ("TSF file", p)));
        inputs.extend(args.photo.config.as_deref().map(|p| ("configuration", p)));
        let mut targets = vec![("--output", args.output.as_path())];
        targets.extend(args.preview.as_deref().map(|p| ("--preview", p)));
        targets.extend(args.report.as_deref().map(|p| ("--report", p)));
        targets.extend(args.photo.report_html.as_deref().map(|p| ("--report-html", p)));
        output::check_distinct(&targets, &inputs).map_err(|e| Usage(e.to_string()))?;
        let check = |p: &PathBuf| Output::check(p, args.overwrite);
        let checked = |p: &Option<PathBuf>| p.as_ref().map(check).transpose();
        let targets = Targets {
            linear: check(&args.output)?,
            preview: checked(&args.preview)?,
            report: checked(&args.report)?,
            page: checked(&args.photo.report_html)?,
        };
        // A folder or an input first: its name says nothing of a format.
        check_format(args)?;
        Ok(targets)
    }

    /// Reads the files that say how, not yet the frames.
    pub fn read(self) -> anyhow::Result<Job<'a>> {
        let args = self.args;
        let photo = PhotoSettings::of(args)?;
        let response = match &self.response_file {
            Some(path) => Some(given::read_response(path)?),
            None => self.named.clone(),
        };
        let tsf = args.tsf.as_deref().map(given::read_tsf).transpose()?;
        if let (Some(file), Some(path)) = (&tsf, &args.tsf) {
            given::check_tsf_names(file, path, &args.frames)?;
        }
        Ok(Job { asked: self, response, tsf, photo })
    }
}

impl Job<'_> {
    /// Reads the frames and finds their response.
    pub fn open(&self, events: &mut dyn FnMut(Event) -> bool) -> anyhow::Result<Opened> {
        let args = self.asked.args;
        events(Event::Progress { stage: "reading frames".into(), fraction: 0.0 });
        let mut loaded = frames::load(&args.frames, self.asked.times.clone().or(self.asked.values.clone()), self.photo.white)?;
        if self.asked.times.is_some() {
            for (noted, frame) in loaded.metadata.iter_mut().zip(loaded.bracket.frames()) {
                noted.exposure_time = Some(frame.exposure_time);
            }
        }
        let frames::Loaded { bracket, stated, to_xyz, metadata, noise, notes } = loaded;
        if let (Some(file), Some(path)) = (&self.tsf, &args.tsf) {
            given::check_tsfs(file, path, &bracket)?;
        }
        for note in &notes {
            events(Event::Warning(note.clone()));
        }
        if args.photo.absolute
            && let Some(i) = metadata.iter().position(|m| m.white_luminance().is_none())
        {
            let name = &bracket.frames()[i].name;
            return Err(Usage(format!(
                "--absolute: {name} does not note aperture, ISO speed and exposure time (EXIF); leave --absolute out"
            ))
            .into());
        }
        let relative = self.asked.values.is_some() || self.asked.times.is_none() && metadata.iter().any(|m| m.exposure_time.is_none());
        let linear = matches!(&stated, Some((_, Response::Linear)));
        if linear && let Some(word) = args.response.as_deref().filter(|w| *w != "linear") {
            return Err(Usage(format!("--response {word}: the frames are linear already; leave --response out")).into());
        }
        // A camera's JPEG has a tone curve of its own whatever its profile says.
        let jpeg = args.frames.iter().all(|p| ["jpg", "jpeg"].contains(&output::ending(p).as_str()));
        let stated = stated.filter(|_| linear || !jpeg && args.response.as_deref() != Some("auto"));
        let (stated_by, stated) = stated.map_or((None, None), |(what, response)| (Some(what), Some(response)));
        let by_file = self.response.is_none().then_some(stated_by).flatten();
        let chosen = super::response::choose(args, self.response.clone().or(stated), &bracket, events);
        let (response, mut origin) = (chosen.response, chosen.report);
        if let Some(what) = by_file {
            origin["origin"] = json!(format!("stated by the files: {what}"));
        }
        if args.frames.len() == self.asked.settings.exclude.len() + 1 {
            let text = "--exclude leaves one frame: what it clips or drowns in noise, no other frame can fill in";
            events(Event::Warning(text.into()));
        }
        Ok(Opened { bracket: Arc::new(bracket), response, origin, noise, to_xyz, metadata, relative, notes })
    }

    /// The settings for frames of full size.
    pub fn settings(&self, opened: &Opened) -> anyhow::Result<Settings> {
        let mut settings = self.asked.settings.clone();
        if settings.focal_px.is_none() {
            let (w, h) = opened.bracket.size();
            settings.focal_px = frames::focal_px(&self.asked.args.frames[0], w, h)?;
        }
        settings.noise = settings.noise.or(opened.noise);
        Ok(settings)
    }

    /// Writes all outputs of the merge of `bracket`, which is that of `opened` or a reduced one.
    pub fn write(
        &self,
        targets: &Targets,
        opened: &Opened,
        bracket: &Bracket,
        outcome: &Outcome,
        warnings: &[String],
        events: &mut dyn FnMut(Event) -> bool,
    ) -> anyhow::Result<String> {
        let (args, photo) = (self.asked.args, &self.photo);
        events(Event::Progress { stage: "writing".into(), fraction: 1.0 });
        let reference = &bracket.frames()[outcome.reference];
        let noted = &opened.metadata[outcome.reference];
        let radiometry = Radiometry { exposure_time: reference.exposure_time, frame: reference.name.clone() };
        let layers = if args.photo.layers { layers::layers(bracket, &opened.response, outcome) } else { Vec::new() };
        let own = &opened.to_xyz[outcome.reference];
        let in_primaries = |primaries: Primaries| {
            let mut image = outcome.irradiance.clone();
            let back = colour::inverse(&primaries.to_xyz()).expect("standard primaries");
            let outside = colour::convert(&mut image, &colour::product(&back, own));
            (image, outside)
        };
        let (mut linear, outside) = in_primaries(photo.primaries);
        if outside > OUTSIDE {
            events(Event::Warning(format!(
                "{:.1} % of the pixels have colours outside {}, which lose saturation; --primaries rec2020 or acescg holds them",
                100.0 * outside,
                photo.primaries.name()
            )));
        }
        let absolute = args.photo.absolute.then(|| noted.white_luminance()).flatten();
        if let Some(white) = absolute {
            linear = linear.map_planes(|p| p.map(|v| v * white as f32));
        }
        let mut outcome = std::borrow::Cow::Borrowed(outcome);
        if targets.page.is_some() || targets.report.is_some() {
            let noise_origin = match (self.asked.settings.noise, opened.noise) {
                (Some(_), _) => "given",
                (None, Some(_)) => "noted by the files",
                (None, None) => "estimated from the frames",
            };
            let outcome = outcome.to_mut();
            if let Some(report) = outcome.report.as_object_mut() {
                report.insert("response".into(), opened.origin.clone());
                report.insert("noise_origin".into(), json!(noise_origin));
                report.insert("exposure_notes".into(), json!(opened.notes));
                report.insert("warnings".into(), json!(warnings));
                report.insert(
                    "colour".into(),
                    json!({ "primaries": photo.primaries, "outside_share": outside, "white_cd_m2": noted.white_luminance(), "absolute": absolute.is_some() }),
                );
            }
        }

        // All are complete before the first is renamed.
        let (primaries, half, metadata) = (photo.primaries, args.photo.half, noted.clone());
        let style = exr::Style { primaries, half, metadata, absolute, relative: opened.relative, layers };
        let (staged, clipped) = targets.linear.stage_linear(&linear, &radiometry, &style)?;
        if clipped > OUTSIDE {
            events(Event::Warning(format!(
                "{:.1} % of the values are above 1, which 16-bit integers clip; leave --half out, or write OpenEXR",
                100.0 * clipped
            )));
        }
        let mut staged = vec![staged];
        if targets.preview.is_some() || targets.page.is_some() {
            let display = in_primaries(Primaries::Rec709).0;
            if let Some(target) = &targets.preview {
                let picture = photo.operator.apply(&display);
                staged.push(if args.photo.gain_map {
                    target.stage_gain_map(&picture, &display, JPEG_QUALITY, noted)?
                } else {
                    target.stage_picture(&picture, JPEG_QUALITY, noted)?
                });
            }
            if let Some(target) = &targets.page {
                let page = page::Page {
                    bracket,
                    response: &opened.response,
                    outcome: &outcome,
                    display: &display,
                    to_display: colour::product(&colour::inverse(&Primaries::Rec709.to_xyz()).expect("standard primaries"), own),
                    warnings,
                    divisor: self.asked.divisor,
                    settings: photo.listing(args),
                };
                staged.push(target.stage_text(&page.html())?);
            }
        }
        if let Some(target) = &targets.report {
            staged.push(target.stage_json(&outcome.report)?);
        }
        if interrupt::asked() {
            return Err(Error::Cancelled.into());
        }
        output::commit_all(staged)?;
        Ok(summary(args, bracket, outcome.reference, opened.relative))
    }
}

/// Quality of a JPEG preview.
const JPEG_QUALITY: u8 = 92;
/// Share of the pixels from which a loss is worth a warning.
const OUTSIDE: f64 = 1e-3;

/// The options of photographers' files, understood.
struct PhotoSettings {
    white: f32,
    primaries: Primaries,
    operator: Operator,
}

impl PhotoSettings {
    fn of(args: &MergeArgs) -> Result<Self, Usage> {
        let photo = &args.photo;
        let white = match &photo.white {
            None => 1.0,
            Some(word) => word
                .parse()
                .ok()
                .filter(|v: &f32| v.is_finite() && *v > 0.0)
                .ok_or_else(|| Usage(format!("--white: {word:?} is not a positive number")))?,
        };
        let primaries = match &photo.primaries {
            None => Primaries::default(),
            Some(word) => Primaries::named(word)
                .ok_or_else(|| Usage(format!("--primaries: {word:?} is none of {}", Primaries::ALL.map(Primaries::name).join(", "))))?,
        };
        let operator = match &photo.tonemap {
            None => Operator::default(),
            Some(words) => Operator::parse(words).map_err(|e| Usage(format!("--tonemap: {e}")))?,
        };
        let refuse = |option: &str, why: &str| Err(Usage(format!("{option}: {why}")));
        if photo.tonemap.is_some() && args.preview.is_none() {
            return refuse("--tonemap", "is for the picture of --preview; name one");
        }
        match &args.preview {
            Some(path) => {
                check_picture_name("--preview", path)?;
                check_gain_map(photo.gain_map, "--preview", path)?;
            }
            None if photo.gain_map => return refuse("--gain-map", "is for the picture of --preview; name one"),
            None => {}
        }
        Ok(Self { white, primaries, operator })
    }

    /// All settings of a run, as the page lists them.
    fn listing(&self, args: &MergeArgs) -> Vec<(String, String)> {
        let or = |v: &Option<String>, d: &str| v.clone().unwrap_or_else(|| d.to_string());
        let set = |v: bool| if v { "yes" } else { "no" }.to_string();
        vec![
            ("--output".into(), args.output.display().to_string()),
            ("--exposures".into(), or(&args.exposures, "from EXIF")),
            ("--ev".into(), or(&args.photo.ev, "-")),
            ("--response".into(), or(&args.response, "as the files state, else auto for JPEG, srgb otherwise")),
            ("--reference".into(), or(&args.reference, "longest sharp frame")),
            ("--sharp".into(), or(&args.sharp, "found out")),
            ("--exclude".into(), or(&args.exclude, "none")),
            ("--alpha".into(), or(&args.alpha, "0.3")),
            ("--tsf".into(), args.tsf.as_ref().map_or("estimated".into(), |p| p.display().to_string())),
            ("--white".into(), self.white.to_string()),
            ("--primaries".into(), self.primaries.name().into()),
            ("--half".into(), set(args.photo.half)),
            ("--absolute".into(), set(args.photo.absolute)),
            ("--layers".into(), set(args.photo.layers)),
            ("--tonemap".into(), self.operator.to_string()),
            ("--no-align".into(), set(args.no_align)),
            ("--keep-ghosts".into(), set(args.keep_ghosts)),
            ("--noise".into(), or(&args.noise, "as the files note it, else estimated")),
            ("--strict".into(), set(args.strict)),
            ("--prior".into(), args.prior.clone()),
            ("--interpolation".into(), args.interpolation.clone()),
            ("--lambda".into(), or(&args.lambda, "2.5")),
            ("--robust".into(), or(&args.robust, "1")),
        ]
    }
}

/// Pictures for the screen are PNG or JPEG.
pub(super) fn check_picture_name(option: &str, path: &Path) -> Result<(), Usage> {
    match output::ending(path).as_str() {
        "png" | "jpg" | "jpeg" => Ok(()),
        _ => Err(Usage(format!("{option}: {} ends with neither .png nor .jpg; name the format by the ending", path.display()))),
    }
}

/// Gain maps are for JPEG.
pub(super) fn check_gain_map(asked: bool, option: &str, path: &Path) -> Result<(), Usage> {
    if asked && !["jpg", "jpeg"].contains(&output::ending(path).as_str()) {
        return Err(Usage(format!("--gain-map: only JPEG holds a gain map; name the picture of {option} .jpg")));
    }
    Ok(())
}

fn summary(args: &MergeArgs, bracket: &Bracket, reference: usize, relative: bool) -> String {
    let (width, height) = bracket.size();
    let frame = &bracket.frames()[reference];
    let what = if args.photo.absolute { "cd/m2; white is that" } else { "1.0 is the white" };
    format!(
        "wrote {} ({width} x {height}; {what} of frame {}, {}, at {})",
        args.output.display(),
        reference + 1,
        frame.name,
        if relative { format!("{:+} EV", frame.exposure_time.log2()) } else { format!("{} s", frame.exposure_time) }
    )
}

fn settings(args: &MergeArgs) -> Result<Settings, Usage> {
    let n = args.frames.len();
    let mut settings = Settings { align: !args.no_align, deghost: !args.keep_ghosts, ..Settings::default() };
    if let Some(word) = &args.reference {
        settings.reference = Some(given::frame_number("--reference", word, n)?);
    }
    if let Some(list) = &args.sharp {
        settings.sharp = Some(given::frame_numbers("--sharp", list, n)?);
    }
    if let Some(list) = &args.exclude {
        settings.exclude = given::frame_numbers("--exclude", list, n)?;
    }
    if let Some(word) = &args.alpha {
        settings.alpha = word
            .parse()
            .ok()
            .filter(|a| (0.0..=1.0).contains(a))
            .ok_or_else(|| Usage(format!("--alpha: {word:?} is not a number from 0 to 1")))?;
    }
    if let Some(word) = &args.model {
        let names: Vec<&str> = Model::ALL.iter().map(|m| m.name()).collect();
        settings.model =
            Model::named(word).ok_or_else(|| Usage(format!("--model: {word:?} is not a model; choose one of {}", names.join(", "))))?;
    }
    if let Some(word) = &args.focal_px {
        let focal = word.parse().ok().filter(|f: &f64| f.is_finite() && *f > 0.0);
        settings.focal_px = Some(focal.ok_or_else(|| Usage(format!("--focal-px: {word:?} is not a positive number of pixels")))?);
    }
    for word in &args.patch {
        let pixel = word.split_once(',').and_then(|(x, y)| Some((x.trim().parse().ok()?, y.trim().parse().ok()?)));
        settings.patches.push(pixel.ok_or_else(|| Usage(format!("--patch: {word:?} is not a pixel such as 120,80")))?);
    }
    if let Some(word) = &args.psf_radius {
        let radius = word.parse().ok().filter(|r| (1..=200).contains(r));
        settings.psf_radius = Some(radius.ok_or_else(|| Usage(format!("--psf-radius: {word:?} is not a number of pixels from 1 to 200")))?);
    }
    if let Some(word) = &args.patch_size {
        let size = word.parse().ok().filter(|s| (16..=2000).contains(s));
        settings.patch_size = Some(size.ok_or_else(|| Usage(format!("--patch-size: {word:?} is not a number of pixels from 16 to 2000")))?);
    }
    let number = |option: &str, word: &Option<String>, (low, high): (f32, f32)| match word {
        None => Ok(None),
        Some(word) => match word.parse::<f32>().ok().filter(|v| (low..=high).contains(v)) {
            Some(v) => Ok(Some(v)),
            None => Err(Usage(format!("{option}: {word:?} is not a number from {low} to {high}"))),
        },
    };
    if let Some(lambda) = number("--lambda", &args.lambda, (0.01, 1000.0))? {
        settings.deblur.lambda = lambda;
    }
    if let Some(robust) = number("--robust", &args.robust, (0.0, 100.0))? {
        settings.deblur.robust = robust;
    }
    settings.noise = args.noise.as_deref().map(given::noise_level).transpose()?;
    settings.deblur.prior = if args.prior == "tv" { Prior::Tv } else { Prior::Collaborative };
    settings.deblur.interpolation = match args.interpolation.as_str() {
        "bilinear" => Interpolation::Bilinear,
        "six-point" => Interpolation::SixPoint,
        _ => Interpolation::Bicubic,
    };
    settings.deblur.memory_limit = args.memory_limit.as_deref().map(given::bytes).transpose()?;
    settings.blind = given::blind(args.blind.as_deref())?;
    if let Some(word) = args.blind.as_deref().filter(|w| matches!(*w, "joint" | "patches") && args.tsf.is_some()) {
        return Err(Usage(format!("--blind {word} estimates the TSFs that --tsf gives; leave one of them out")));
    }
    if settings.blind == Blind::Patches {
        let (radius, side) = (settings.psf_radius.unwrap_or(0), settings.patch_setup().side);
        if 4 * radius > side {
            return Err(Usage(format!(
                "--psf-radius {radius} is more than a quarter of a patch of {side} pixels; give --patch-size {} or more as well",
                4 * radius
            )));
        }
    } else if settings.patch_size.is_some() {
        return Err(Usage("--patch-size belongs to --blind patches; give both or none".into()));
    }
    let name = |i: usize| format!("frame {} ({})", i + 1, args.frames[i].display());
    if let Some(i) = settings.exclude.iter().find(|i| settings.sharp.as_ref().is_some_and(|s| s.contains(i))) {
        return Err(Usage(format!("--sharp and --exclude both name {}; name it in one of them", name(*i))));
    }
    if let Some(i) = settings.reference.filter(|i| settings.exclude.contains(i)) {
        return Err(Usage(format!("--exclude leaves out {}, which --reference names; choose another reference", name(i))));
    }
    if settings.exclude.len() == n {
        return Err(Usage(format!("--exclude leaves out all {}; keep at least one", frames::count(n, "frame"))));
    }
    Ok(settings)
}

/// The outputs, of which each can be written.
pub(super) struct Targets {
    linear: Output,
    preview: Option<Output>,
    report: Option<Output>,
    page: Option<Output>,
}

/// Refuses what the format of the output, by its ending, cannot hold.
fn check_format(args: &MergeArgs) -> Result<(), Usage> {
    let photo = &args.photo;
    let rec709 = photo.primaries.as_deref().is_none_or(|word| Primaries::named(word) == Some(Primaries::Rec709));
    let ending = output::ending(&args.output);
    let refuse = |option: &str, why: &str| Err(Usage(format!("{option}: {why}")));
    match ending.as_str() {
        "exr" | "tif" | "tiff" => {}
        "hdr" if photo.half => return refuse("--half", "Radiance HDR has one depth; leave --half out"),
        "hdr" if !rec709 => return refuse("--primaries", "Radiance HDR is Rec. 709; write OpenEXR or TIFF"),
        "hdr" => {}
        _ => return refuse("--output", "the name ends with neither .exr, .hdr, .tif nor .tiff; name the format by the ending"),
    }
    if photo.layers && ending != "exr" {
        return refuse("--layers", "only OpenEXR holds further channels; name the output .exr");
    }
    Ok(())
}
