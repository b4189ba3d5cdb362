//! Figure 10: frames far apart, and how many features match between sharp frames and between blurred ones.

use super::outcomes::{columns, corners, pictures, table};
use super::study::{Events, Exposures, Method, Shaking, Study, seconds};
use super::{Lab, Report};
use crate::error::Result;
use crate::exposure::Bracket;
use crate::image::Rgb;
use crate::noise;
use crate::register::Registrar;
use crate::response::Response;
use crate::synth::Drawn;

/// Width in pixels of the frames that features are counted in: those of the reconstruction are too small to have many.
const LARGE: usize = 640;

/// Writing in the light and in the shadow: every frame shows some of it.
const SCENE: Drawn = Drawn::Chart;

/// (first, second, matches, those that agree with the motion) of every pair of frames.
fn matches(bracket: &Bracket, sharp: &[bool]) -> Vec<(usize, usize, usize, usize)> {
    let exposures: Vec<Rgb> = bracket.frames().iter().map(|f| noise::exposure(f, &Response::Srgb)).collect();
    let level = noise::estimate(bracket.frames(), &exposures, &Response::Srgb);
    let curves = noise::curves(bracket.frames(), &Response::Srgb, &level);
    let n = bracket.frames().len();
    let pairs = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
    pairs
        .map(|(i, j)| {
            let (matches, inliers) = Registrar::new(bracket.frames(), &exposures, &curves, i).matches(j, sharp[j]);
            (i, j, matches, inliers)
        })
        .collect()
}

pub(super) fn run(lab: &mut Lab, events: Events) -> Result<Report> {
    let key = (SCENE, Exposures::Apart, Shaking::Tremor);
    let large = Study::photographed(key, LARGE, lab.seed)?;
    let study = lab.study(key, events)?;
    let methods = [Method::Merge, Method::Sharp, Method::Denoised, Method::Unshaken, Method::Tripod];
    let times = study.times();
    let mut out = format!("| pair, {LARGE} px wide | kind | matches | that agree |\n|---|---|---|---|\n");
    let kind = |i: usize, j: usize| match (study.made.sharp[i], study.made.sharp[j]) {
        (true, true) => "sharp, sharp",
        (false, false) => "blurred, blurred",
        _ => "sharp, blurred",
    };
    for (i, j, found, agree) in matches(&large.bracket, &large.sharp) {
        let pair = format!("{} and {}", seconds(times[i]), seconds(times[j])).to_lowercase();
        out += &format!("| {pair} | {} | {found} | {agree} |\n", kind(i, j));
    }
    out += &format!("\n{}", table(study, &methods, events)?);
    let (w, h) = study.made.bracket.size();
    let corner = 0.5 * (w as f64).hypot(h as f64);
    let moved = study.made.tsfs.iter().map(|t| {
        let m = t.mean();
        format!("{:.0} px", m.t_x.hypot(m.t_y) + m.theta_z_deg.abs().to_radians() * corner)
    });
    // As the paper's (d): the same places of all frames show different things.
    let picture = columns(pictures(study, 0, &methods[2..], events)?, corners(SCENE), 256);
    Ok(Report {
        title: "Figure 10: frames far apart".into(),
        text: format!(
            "Scene {}, {}; the frames' farthest pixels are displaced by {}. SIFT features match between two frames by themselves (the merge registers \
             the blurred ones against all sharp ones together). The paper finds more than 100 matches between sharp frames and about 25 between blurred ones. \
             'Frames merged' are not registered.",
            SCENE.name(),
            study.camera,
            moved.collect::<Vec<_>>().join(", ")
        ),
        table: out,
        picture,
    })
}
