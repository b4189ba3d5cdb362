//! What comes out: Figures 5, 7, 11 and 12, and the claim about sharpness.

use super::study::{SHAKEN, Shaking, Study, TIMES};
use super::{Lab, Report, sheet};
use crate::error::Result;
use crate::image::Rgb;
use crate::metrics::cpbd_of;
use crate::pipeline::Event;
use crate::synth::Drawn;
use image::RgbImage;

type Events<'a> = &'a mut dyn FnMut(Event) -> bool;

/// Upper left corners of the close-ups, as fractions of the frame: text in the light, text in the dark.
fn corners(scene: Drawn) -> [(f32, f32); 2] {
    match scene {
        Drawn::Room => [(0.72, 0.22), (0.03, 0.7)],
        Drawn::Chart => [(0.08, 0.4), (0.72, 0.2)],
        Drawn::Lamps => [(0.58, 0.56), (0.05, 0.74)],
        Drawn::Foliage => [(0.15, 0.4), (0.62, 0.73)],
        Drawn::Window => [(0.08, 0.45), (0.72, 0.1)],
    }
}

/// One column per picture: the whole above its close-ups.
fn columns(pictures: Vec<(String, RgbImage)>, scene: Drawn, cell: u32) -> RgbImage {
    let parts = corners(scene).map(|c| pictures.iter().map(|(_, p)| (String::new(), sheet::close_up(p, c))).collect::<Vec<_>>());
    let [a, b] = parts;
    sheet::sheet(&[pictures, a, b], cell)
}

const HEADING: &str = "| PU21-PSNR (dB) | dark half | PU21-SSIM | log RMSE | edges | sharpness (CPBD) |\n";

fn cells(study: &Study, image: &Rgb) -> Result<String> {
    let s = study.score(image)?;
    let sharpness = cpbd_of(&study.tone.apply(image));
    Ok(format!("{:.1} | {:.1} | {:.3} | {:.3} | {:.2} | {sharpness:.2}", s.pu_psnr, s.pu_dark, s.pu_ssim, s.log_rmse, s.edge_ratio))
}

/// Table of all methods on one bracket.
fn table(study: &Study) -> Result<String> {
    let mut out = format!("| method {HEADING}|---|---|---|---|---|---|---|\n");
    for (name, image) in study.methods() {
        out += &format!("| {name} | {} |\n", cells(study, &image)?);
    }
    out += &format!("| exposure fusion (a picture, no irradiance) | | | | | | {:.2} |", cpbd_of(&study.fused()));
    Ok(out)
}

/// The two shaken frames and what the methods made of the bracket.
fn pictures(study: &Study) -> Vec<(String, RgbImage)> {
    let mut out: Vec<(String, RgbImage)> = (SHAKEN..TIMES.len()).map(|i| (format!("FRAME OF {} S", TIMES[i]), study.photo(i))).collect();
    out.extend(study.methods().into_iter().skip(1).map(|(name, image)| (name.to_uppercase(), study.tone.apply(&image))));
    out
}

fn size(study: &Study) -> String {
    let (w, h) = study.made.bracket.size();
    format!("{w} x {h} pixels; 1/30, 1/8 and 1/5 s sharp, 1/2 and 2 s shaken; full well 4000 electrons, read noise 8, 8-bit sRGB")
}

pub(super) fn blurred(lab: &mut Lab, events: Events) -> Result<Report> {
    let study = lab.study(Drawn::Chart, Shaking::Grid, events)?;
    Ok(Report {
        title: "Figure 5: blurred higher exposures".into(),
        text: format!(
            "Scene chart, {}; TSFs on the paper's grid. 'Each deblurred' has the TSFs that were found with the sharp frames' help, which favours it over the \
             blind deconvolution that the paper compares with.",
            size(study)
        ),
        table: table(study)?,
        picture: columns(pictures(study), Drawn::Chart, 256),
    })
}

pub(super) fn six_d(lab: &mut Lab, events: Events) -> Result<Report> {
    let study = lab.study(Drawn::Room, Shaking::SixD, events)?;
    let widest = |f: fn(&crate::pose::Pose) -> f64| {
        let v = study.made.tsfs[TIMES.len() - 1].poses.iter().map(f);
        let (a, b) = v.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
        b - a
    };
    Ok(Report {
        title: "Figure 7: motion in six degrees of freedom, fitted by TSFs of three".into(),
        text: format!(
            "Scene room, {}; motion by eq. (2) at 2 m. During the 2 s frame the camera shifts the picture by {:.1} and {:.1} px, pitches by {:.2}, yaws by {:.2} \
             and rolls by {:.2} degrees, and moves 2 mm along its axis. The paper shows that the result stays sharp; it gives no figures.",
            size(study),
            widest(|p| p.t_x),
            widest(|p| p.t_y),
            widest(|p| p.theta_x_deg),
            widest(|p| p.theta_y_deg),
            widest(|p| p.theta_z_deg),
        ),
        table: table(study)?,
        picture: columns(pictures(study), Drawn::Room, 256),
    })
}

/// Scenes of Figure 11 and of the claim about sharpness.
const SEVERAL: [Drawn; 4] = [Drawn::Window, Drawn::Lamps, Drawn::Foliage, Drawn::Room];

pub(super) fn scenes(lab: &mut Lab, events: Events) -> Result<Report> {
    let mut out = format!("| scene | method {HEADING}|---|---|---|---|---|---|---|---|\n");
    let (mut rows, mut text) = (Vec::new(), String::new());
    for drawn in SEVERAL {
        let study = lab.study(drawn, Shaking::Tremor, events)?;
        for (name, image) in study.methods() {
            out += &format!("| {} | {name} | {} |\n", drawn.name(), cells(study, &image)?);
        }
        let unshaken = study.tone.apply(&study.joint.irradiance);
        let corner = corners(drawn)[1];
        rows.push(vec![
            (drawn.name().to_uppercase(), study.photo(1)),
            ("SHAKEN, 2 S".into(), study.photo(TIMES.len() - 1)),
            ("UNSHAKEN".into(), unshaken.clone()),
            ("SHAKEN, CLOSER".into(), sheet::close_up(&study.photo(TIMES.len() - 1), corner)),
            ("UNSHAKEN, CLOSER".into(), sheet::close_up(&unshaken, corner)),
        ]);
        text = size(study);
    }
    out.truncate(out.trim_end().len());
    Ok(Report {
        title: "Figure 11: more scenes".into(),
        text: format!("Scenes drawn by the program, {text}; tremor off every grid."),
        table: out,
        picture: sheet::sheet(&rows, 256),
    })
}

pub(super) fn tripod(lab: &mut Lab, events: Events) -> Result<Report> {
    let mut table =
        String::from("| scene | unshaken (dB) | tripod (dB) | unshaken against tripod (dB) | edges | SSIM |\n|---|---|---|---|---|---|\n");
    let (mut last, mut text) = (None, String::new());
    for drawn in [Drawn::Window, Drawn::Room] {
        let study = lab.study(drawn, Shaking::Tremor, events)?;
        let methods = study.methods();
        let (_, still) = &methods[methods.len() - 1];
        let (ours, ideal) = (study.score(&study.joint.irradiance)?, study.score(still)?);
        let between = crate::metrics::score(&study.joint.irradiance, still, &Default::default())?;
        table += &format!(
            "| {} | {:.1} | {:.1} | {:.1} | {:.2} | {:.3} |\n",
            drawn.name(),
            ours.pu_psnr,
            ideal.pu_psnr,
            between.pu_psnr,
            between.edge_ratio,
            between.pu_ssim
        );
        let mut pictures: Vec<(String, RgbImage)> = [0, 2, 3, 4].map(|i| (format!("FRAME OF {:.3} S", TIMES[i]), study.photo(i))).into();
        pictures.push(("UNSHAKEN".into(), study.tone.apply(&study.joint.irradiance)));
        pictures.push(("TRIPOD".into(), study.tone.apply(still)));
        last = Some(columns(pictures, drawn, 256));
        text = size(study);
    }
    table.truncate(table.trim_end().len());
    Ok(Report {
        title: "Figure 12: against a tripod".into(),
        text: format!(
            "{text}; tremor off every grid. The tripod's bracket has the same exposures, merged by Debevec's weights. Both are judged against the truth, and against each other."
        ),
        table,
        picture: last.unwrap_or_default(),
    })
}

pub(super) fn sharpness(lab: &mut Lab, events: Events) -> Result<Report> {
    let mut table =
        String::from("| scene | motion | exposure fusion | unshaken | ratio | truth, tone-mapped |\n|---|---|---|---|---|---|\n");
    let (mut ratios, mut rows) = (Vec::new(), Vec::new());
    let mut cases = vec![(Drawn::Chart, Shaking::Grid, "grid"), (Drawn::Room, Shaking::SixD, "6-D")];
    cases.extend(SEVERAL.map(|s| (s, Shaking::Tremor, "tremor")));
    for (drawn, shaking, kind) in cases {
        let study = lab.study(drawn, shaking, events)?;
        let (fused, ours) = (study.fused(), study.tone.apply(&study.joint.irradiance));
        let (a, b) = (cpbd_of(&fused), cpbd_of(&ours));
        let truth = cpbd_of(&study.tone.apply(&study.made.truth));
        table += &format!("| {} | {kind} | {a:.3} | {b:.3} | {:.2} | {truth:.3} |\n", drawn.name(), b / a.max(1e-3));
        ratios.push(b / a.max(1e-3));
        rows.push(vec![
            ("EXPOSURE FUSION".to_string(), fused.clone()),
            ("UNSHAKEN".into(), ours.clone()),
            ("FUSION, CLOSER".into(), sheet::close_up(&fused, corners(drawn)[0])),
            ("UNSHAKEN, CLOSER".into(), sheet::close_up(&ours, corners(drawn)[0])),
        ]);
    }
    let mean = ratios.iter().map(|r| r.ln()).sum::<f64>() / ratios.len() as f64;
    table += &format!("| mean (geometric) | | | | {:.2} | |", mean.exp());
    Ok(Report {
        title: "Sharpness against exposure fusion".into(),
        text: "CPBD (Narvekar and Karam 2011) of the tone-mapped result over that of exposure fusion (Mertens et al. 2007) of the same frames. The paper finds about \
               double with a measure of its own choice."
            .into(),
        table,
        picture: sheet::sheet(&rows, 256),
    })
}
