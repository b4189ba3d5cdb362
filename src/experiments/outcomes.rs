//! What comes out: Figures 5 to 9, 11 and 12, photographs, and the claim about sharpness.

use super::study::{Events, Exposures, Method, Shaking, Study, seconds};
use super::{Lab, Report, sheet};
use crate::error::{Error, Result};
use crate::image::Rgb;
use crate::metrics::cpbd_of;
use crate::pose::Pose;
use crate::synth::Drawn;
use image::RgbImage;

/// Upper left corners of the close-ups, as fractions of the frame: text in the light, text in the dark.
pub(super) fn corners(scene: Drawn) -> [(f32, f32); 2] {
    match scene {
        Drawn::Room => [(0.72, 0.22), (0.03, 0.7)],
        Drawn::Chart => [(0.08, 0.4), (0.72, 0.2)],
        Drawn::Lamps => [(0.58, 0.56), (0.05, 0.74)],
        Drawn::Foliage => [(0.15, 0.4), (0.62, 0.73)],
        Drawn::Window => [(0.08, 0.45), (0.72, 0.1)],
    }
}

/// One column per picture: the whole above its close-ups.
pub(super) fn columns(pictures: Vec<(String, RgbImage)>, corners: [(f32, f32); 2], cell: u32) -> RgbImage {
    let parts = corners.map(|c| pictures.iter().map(|(_, p)| (String::new(), sheet::close_up(p, c))).collect::<Vec<_>>());
    let [a, b] = parts;
    sheet::sheet(&[pictures, a, b], cell)
}

const HEADING: &str = "| PU21-PSNR (dB) | dark half | PU21-SSIM | log RMSE | edges | sharpness (CPBD) |\n";

fn cells(study: &Study, method: Method, image: &Rgb) -> Result<String> {
    let s = study.score(method, image)?;
    let sharpness = cpbd_of(&study.tone.apply(image));
    Ok(format!("{:.1} | {:.1} | {:.3} | {:.3} | {:.2} | {sharpness:.2}", s.pu_psnr, s.pu_dark, s.pu_ssim, s.log_rmse, s.edge_ratio))
}

/// Table of the `methods` on one bracket.
pub(super) fn table(study: &Study, methods: &[Method], events: Events) -> Result<String> {
    let mut out = format!("| method {HEADING}|---|---|---|---|---|---|---|\n");
    for &m in methods {
        let image = study.result(m, events)?;
        out += &format!("| {} | {} |\n", m.name(), cells(study, m, &image)?);
    }
    out += &format!("| exposure fusion (a picture, no irradiance) | | | | | | {:.2} |", cpbd_of(&study.fused()));
    Ok(out)
}

/// The frames from `first` on, and what the `methods` made of the bracket.
pub(super) fn pictures(study: &Study, first: usize, methods: &[Method], events: Events) -> Result<Vec<(String, RgbImage)>> {
    let frames = study.times().into_iter().enumerate().skip(first);
    let mut out: Vec<(String, RgbImage)> = frames.map(|(i, t)| (format!("FRAME OF {}", seconds(t)), study.photo(i))).collect();
    for &m in methods {
        out.push((m.name().to_uppercase(), study.tone.apply(&study.result(m, events)?)));
    }
    Ok(out)
}

/// What every experiment of the sharp-and-shaken kind compares.
const ALL: [Method; 7] = [Method::Merge, Method::Sharp, Method::Denoised, Method::Naive, Method::Uniform, Method::Unshaken, Method::Tripod];
/// Without a sharp frame.
const SHAKEN: [Method; 4] = [Method::Merge, Method::Uniform, Method::Unshaken, Method::Tripod];

/// What must be said when nothing was deblurred.
fn warning(study: &Study) -> &'static str {
    if study.fell_back() { " The blurs were not found: the result is a merge, as the program's warning says." } else { "" }
}

pub(super) fn blurred(lab: &mut Lab, events: Events) -> Result<Report> {
    let study = lab.study((Drawn::Chart, Exposures::Sharp3, Shaking::Grid), events)?;
    Ok(Report {
        title: "Figure 5: blurred higher exposures".into(),
        text: format!(
            "Scene chart, {}; TSFs on the paper's grid. 'Each deblurred' has the TSFs that were found with the sharp frames' help, which favours it over the \
             blind deconvolution that the paper compares with. 'Uniform blur only' is the program restricted to translations.",
            study.camera
        ),
        table: table(study, &ALL, events)?,
        picture: columns(
            pictures(study, study.shaken(), &[Method::Denoised, Method::Naive, Method::Unshaken, Method::Tripod], events)?,
            corners(Drawn::Chart),
            256,
        ),
    })
}

pub(super) fn all_shaken(lab: &mut Lab, events: Events) -> Result<Report> {
    let study = lab.study((Drawn::Chart, Exposures::Shaken3, Shaking::Grid), events)?;
    Ok(Report {
        title: "Figure 6: all frames blurred".into(),
        text: format!(
            "Scene chart, {}; TSFs on the paper's grid. 'Uniform blur only' stands in for the method of Lu et al. (2009), whose program is not published: \
             the program with the translations of the TSFs that it found with roll. Where the scene lies is not known: each result is judged against the \
             truth shifted and turned to it.{}",
            study.camera,
            warning(study)
        ),
        table: table(study, &SHAKEN, events)?,
        picture: columns(pictures(study, 0, &SHAKEN, events)?, corners(Drawn::Chart), 256),
    })
}

pub(super) fn six_d(lab: &mut Lab, events: Events) -> Result<Report> {
    let study = lab.study((Drawn::Room, Exposures::Sharp3, Shaking::SixD), events)?;
    let last = study.times().len() - 1;
    let widest = |f: fn(&Pose) -> f64| {
        let v = study.made.tsfs[last].poses.iter().map(f);
        let (a, b) = v.fold((f64::MAX, f64::MIN), |(a, b), x| (a.min(x), b.max(x)));
        b - a
    };
    let mut rows = vec![pictures(study, study.shaken(), &[Method::Denoised, Method::Unshaken, Method::Tripod], events)?];
    for c in corners(Drawn::Room) {
        rows.push(rows[0].iter().map(|(_, p)| (String::new(), sheet::close_up(p, c))).collect());
    }
    // The parameters over time, as the paper's Figure 7 (b).
    let paths = (study.shaken()..=last).flat_map(|i| {
        let (tsf, nearing) = (&study.made.tsfs[i], &study.motions[i].nearing);
        let of = |f: fn(&Pose) -> f64| tsf.poses.iter().map(f).collect::<Vec<f64>>();
        // Eq. (2): t_z as the growth of the picture at half its width, pixels.
        let growth = nearing.iter().map(|n| n * 0.5 * study.made.truth.width() as f64).collect();
        let name = |what: &str| format!("{what}, {}", seconds(study.times()[i]));
        [
            (name("T_X, T_Y, T_Z"), sheet::graph(&[of(|p| p.t_x), of(|p| p.t_y), growth])),
            (name("PITCH, YAW, ROLL"), sheet::graph(&[of(|p| p.theta_x_deg), of(|p| p.theta_y_deg), of(|p| p.theta_z_deg)])),
        ]
    });
    rows.push(paths.collect());
    Ok(Report {
        title: "Figure 7: motion in six degrees of freedom, fitted by TSFs of three".into(),
        text: format!(
            "Scene room, {}; motion by eq. (2) at 2 m. During the 2 s frame the camera shifts the picture by {:.1} and {:.1} px, pitches by {:.2}, yaws by {:.2} \
             and rolls by {:.2} degrees, and moves 2 mm along its axis (last row of the picture: red, green and blue are x, y and z). The paper shows that the result stays sharp; it gives no figures. \
             The program may use pitch and yaw as well where that explains a frame better.",
            study.camera,
            widest(|p| p.t_x),
            widest(|p| p.t_y),
            widest(|p| p.theta_x_deg),
            widest(|p| p.theta_y_deg),
            widest(|p| p.theta_z_deg),
        ),
        table: table(study, &ALL, events)?,
        picture: sheet::sheet(&rows, 256),
    })
}

pub(super) fn photographs(lab: &mut Lab, all_shaken: bool, events: Events) -> Result<Report> {
    let (drawn, exposures) = if all_shaken { (Drawn::Room, Exposures::JpegShaken) } else { (Drawn::Foliage, Exposures::Jpeg) };
    let study = lab.study((drawn, exposures, Shaking::Turning), events)?;
    let methods: &[Method] = if all_shaken { &SHAKEN } else { &ALL };
    let shown: &[Method] = if all_shaken { &SHAKEN } else { &[Method::Denoised, Method::Uniform, Method::Unshaken, Method::Tripod] };
    Ok(Report {
        title: if all_shaken { "Figure 9: photographs, all blurred" } else { "Figure 8: photographs, the longest blurred" }.into(),
        text: format!(
            "Scene {}, {}; the camera mostly turns (pitch, yaw and roll){}. The paper's photographs are not published; these frames go through what a \
             camera does to them, and the program knows the exposure times and that curve.{}",
            drawn.name(),
            study.camera,
            if all_shaken { "" } else { ", and every frame lies up to a hundredth of its width off" },
            warning(study)
        ),
        table: table(study, methods, events)?,
        picture: columns(pictures(study, 0, shown, events)?, corners(drawn), 256),
    })
}

pub(super) fn office(lab: &mut Lab, events: Events) -> Result<Report> {
    let Some(study) = lab.photographed(events)? else {
        return Err(Error::Input("the experiment office needs photographs; name a folder with a bracket from a tripod".into()));
    };
    Ok(Report {
        title: "A photographed scene".into(),
        text: format!(
            "The camera's curve is calibrated from a bracket photographed from a tripod (Debevec and Malik 1997), the bracket merged, and the irradiance photographed again \
             with synthetic shake through that curve: {}; smooth tremor. The program is given the curve.",
            study.camera
        ),
        table: table(study, &ALL, events)?,
        picture: columns(
            pictures(study, study.times().len() - 2, &[Method::Merge, Method::Denoised, Method::Unshaken, Method::Tripod], events)?,
            [(0.1, 0.3), (0.6, 0.5)],
            256,
        ),
    })
}

/// Scenes of Figure 11 and of the claim about sharpness.
const SEVERAL: [Drawn; 4] = [Drawn::Window, Drawn::Lamps, Drawn::Foliage, Drawn::Room];

pub(super) fn scenes(lab: &mut Lab, events: Events) -> Result<Report> {
    let methods = [Method::Merge, Method::Sharp, Method::Denoised, Method::Unshaken, Method::Tripod];
    let mut out = format!("| scene | method {HEADING}|---|---|---|---|---|---|---|---|\n");
    let (mut rows, mut text) = (Vec::new(), String::new());
    for drawn in SEVERAL {
        let study = lab.study((drawn, Exposures::Sharp3, Shaking::Tremor), events)?;
        for m in methods {
            let image = study.result(m, events)?;
            out += &format!("| {} | {} | {} |\n", drawn.name(), m.name(), cells(study, m, &image)?);
        }
        let last = study.times().len() - 1;
        let unshaken = study.tone.apply(&study.joint.irradiance);
        let corner = corners(drawn)[1];
        rows.push(vec![
            (drawn.name().to_uppercase(), study.photo(1)),
            ("SHAKEN, 2 S".into(), study.photo(last)),
            ("UNSHAKEN".into(), unshaken.clone()),
            ("SHAKEN, CLOSER".into(), sheet::close_up(&study.photo(last), corner)),
            ("UNSHAKEN, CLOSER".into(), sheet::close_up(&unshaken, corner)),
        ]);
        text = study.camera.clone();
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
        let study = lab.study((drawn, Exposures::Sharp3, Shaking::Tremor), events)?;
        let still = study.result(Method::Tripod, events)?;
        let (ours, ideal) = (study.score(Method::Unshaken, &study.joint.irradiance)?, study.score(Method::Tripod, &still)?);
        let between = crate::metrics::score(&study.joint.irradiance, &still, &Default::default())?;
        table += &format!(
            "| {} | {:.1} | {:.1} | {:.1} | {:.2} | {:.3} |\n",
            drawn.name(),
            ours.pu_psnr,
            ideal.pu_psnr,
            between.pu_psnr,
            between.edge_ratio,
            between.pu_ssim
        );
        let times = study.times();
        let mut pictures: Vec<(String, RgbImage)> =
            [0, 2, 3, 4].map(|i| (format!("FRAME OF {}", seconds(times[i])), study.photo(i))).into();
        pictures.push(("UNSHAKEN".into(), study.tone.apply(&study.joint.irradiance)));
        pictures.push(("TRIPOD".into(), study.tone.apply(&still)));
        last = Some(columns(pictures, corners(drawn), 256));
        text = study.camera.clone();
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
    let mut cases = vec![
        (Drawn::Chart, Exposures::Sharp3, Shaking::Grid, "grid"),
        (Drawn::Chart, Exposures::Shaken3, Shaking::Grid, "grid, all shaken"),
        (Drawn::Room, Exposures::Sharp3, Shaking::SixD, "6-D"),
    ];
    cases.extend(SEVERAL.map(|s| (s, Exposures::Sharp3, Shaking::Tremor, "tremor")));
    for (drawn, exposures, shaking, kind) in cases {
        let study = lab.study((drawn, exposures, shaking), events)?;
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
