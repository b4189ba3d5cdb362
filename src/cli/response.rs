//! Which response a merge uses.

use super::args::MergeArgs;
use crate::exposure::Bracket;
use crate::pipeline::Event;
use crate::response::{self, Response};
use serde_json::{Value, json};

/// A response, and what the report says of it.
pub(super) struct Chosen {
    pub response: Response,
    pub report: Value,
}

/// The response of a merge. `given`: from the command line. Otherwise, and with `--response auto`, it is estimated from JPEG frames;
/// PNG and TIFF frames without a word on it are taken as sRGB, which is what programs write into them.
pub(super) fn choose(args: &MergeArgs, given: Option<Response>, bracket: &Bracket, events: &mut dyn FnMut(Event) -> bool) -> Chosen {
    let asked = args.response.as_deref() == Some("auto");
    let jpeg = args.frames.iter().all(|p| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("jpg") || e.eq_ignore_ascii_case("jpeg")));
    if given.is_none() && (asked || jpeg) {
        events(Event::Progress { stage: "estimating the response".into(), fraction: 0.0 });
        let found = response::automatic(bracket);
        if let Some(text) = &found.poor {
            events(Event::Warning(format!("{text}; 'unshaken calibrate' measures it")));
        }
        let mut report = report(&found.response, &format!("estimated from the frames: {}", found.method));
        report["deviation_ev"] = json!(found.deviation_ev);
        return Chosen { response: found.response, report };
    }
    if given.is_none() {
        let text = "no --response given: PNG and TIFF frames are taken as sRGB; if they hold a camera's own curve, --response auto estimates it \
                    and 'unshaken calibrate' measures it";
        events(Event::Warning(text.into()));
    }
    let origin = if given.is_some() { "given" } else { "assumed" };
    let used = given.unwrap_or(Response::Srgb);
    let report = report(&used, origin);
    Chosen { response: used, report }
}

fn report(response: &Response, origin: &str) -> Value {
    let table = |c: usize| -> Vec<f64> { (0..256).map(|k| response.inverse(c, f64::from(k) / 255.0)).collect() };
    json!({
        "name": response.name(),
        "origin": origin,
        "inverse": { "red": table(0), "green": table(1), "blue": table(2) },
    })
}
