//! Which response a merge uses, and whether the exposure times fit the pixels under it.

use super::args::MergeArgs;
use crate::error::{Error, Result};
use crate::exposure::Bracket;
use crate::pipeline::Event;
use crate::response::{self, ExposureCheck, Response};
use serde_json::{Value, json};

/// A response, what the report says of it, and why a result that rests on it is less than it should be.
pub(super) struct Chosen {
    pub response: Response,
    pub report: Value,
    pub degraded: Vec<String>,
}

/// The response of a merge. `given`: from the command line. Otherwise, and with `--response auto`, it is estimated from JPEG frames;
/// PNG and TIFF frames without a word on it are taken as sRGB, which is what programs write into them.
pub(super) fn choose(
    args: &MergeArgs,
    given: Option<Response>,
    bracket: &Bracket,
    events: &mut dyn FnMut(Event) -> bool,
) -> Result<Chosen> {
    let mut degraded = Vec::new();
    let asked = args.response.as_deref() == Some("auto");
    let jpeg = args.frames.iter().all(|p| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg")));
    if given.is_none() && (asked || jpeg) {
        events(Event::Progress { stage: "estimating the response".into(), fraction: 0.0 });
        match response::automatic(bracket) {
            Ok(found) => {
                if let Some(text) = &found.poor {
                    events(Event::Warning(format!("{text}; 'unshaken calibrate' measures it")));
                }
                degraded.extend(tell(&found.exposures, bracket, events));
                let report = report(&found.response, &format!("estimated from the frames: {}", found.method), &found.exposures);
                return Ok(Chosen { response: found.response, report, degraded });
            }
            Err(e) if asked => return Err(e),
            Err(Error::Bracket(text)) => {
                let text = format!("{text}; the frames are taken as sRGB");
                degraded.push(text.clone());
                events(Event::Warning(text));
            }
            Err(e) => return Err(e),
        }
    } else if given.is_none() {
        let text = "no --response given: PNG and TIFF frames are taken as sRGB; if they hold a camera's own curve, --response auto estimates it \
                    and 'unshaken calibrate' measures it";
        events(Event::Warning(text.into()));
    }
    let origin = if given.is_some() { "given" } else { "assumed" };
    let used = given.unwrap_or(Response::Srgb);
    let check = response::check_exposures(bracket, &used);
    degraded.extend(tell(&check, bracket, events));
    let report = report(&used, origin, &check);
    Ok(Chosen { response: used, report, degraded })
}

/// Warns of exposure times that the pixels contradict.
fn tell(check: &ExposureCheck, bracket: &Bracket, events: &mut dyn FnMut(Event) -> bool) -> Option<String> {
    let text = check.warning(bracket)?;
    events(Event::Warning(text.clone()));
    Some(text)
}

fn report(response: &Response, origin: &str, check: &ExposureCheck) -> Value {
    let table = |c: usize| -> Vec<f64> { (0..256).map(|k| response.inverse(c, f64::from(k) / 255.0)).collect() };
    json!({
        "name": response.name(),
        "origin": origin,
        "inverse": { "red": table(0), "green": table(1), "blue": table(2) },
        "exposure_difference_ev": check.difference_ev,
        "exposure_deviation_ev": check.deviation_ev,
    })
}
