//! Words of the window: what the engine says in those of the command line, and exposure times as they are typed and read.

/// Options of `merge`, and what sets them in the window.
pub const CONTROLS: [(&str, &str); 17] = [
    ("--exposures", "the times below the thumbnails"),
    ("--exclude", "what is left out"),
    ("--sharp", "\"sharp\" below the thumbnails"),
    ("--no-align", "\"Register the frames\" switched off"),
    ("--keep-ghosts", "\"Remove ghosts\" switched off"),
    ("--blind", "\"No frame sharp\""),
    ("--scale", "\"Size\""),
    ("--memory-limit", "\"GPU memory\""),
    ("--response", "\"Response\""),
    ("--model", "\"Camera motion\""),
    ("--prior", "\"Prior\""),
    ("--lambda", "\"Smoothness, lambda\""),
    ("--robust", "\"Robust weights\""),
    ("--alpha", "\"Mask taper, alpha\""),
    ("--reference", "\"Reference frame\""),
    ("--overwrite", "\"Replace files that exist\""),
    ("--half", "\"16 bits instead of 32\""),
];

/// `text` with the window's controls in place of the options that it names; options that only the command line has stay.
pub fn in_window(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = rest.find("--") {
        out.push_str(&rest[..at]);
        let end = rest[at + 2..].find(|c: char| !(c.is_ascii_lowercase() || c == '-')).map_or(rest.len(), |e| at + 2 + e);
        let option = &rest[at..end];
        out.push_str(CONTROLS.iter().find(|(o, _)| *o == option).map_or(option, |(_, control)| control));
        rest = &rest[end..];
    }
    out + rest
}

/// Seconds from what a user types: `1/30` or `0.2`.
pub fn seconds(text: &str) -> Option<f64> {
    let text = text.trim().trim_end_matches('s').trim();
    let value = match text.split_once('/') {
        Some((a, b)) => a.trim().parse::<f64>().ok()? / b.trim().parse::<f64>().ok()?,
        None => text.parse().ok()?,
    };
    (value.is_finite() && value > 0.0).then_some(value)
}

/// An exposure time as photographers write it.
pub fn time(seconds: f64) -> String {
    let inverse = 1.0 / seconds;
    if seconds < 0.3 && (inverse - inverse.round()).abs() < 0.02 * inverse {
        format!("1/{} s", inverse.round())
    } else {
        let text = format!("{seconds:.3}");
        format!("{} s", text.trim_end_matches('0').trim_end_matches('.'))
    }
}
