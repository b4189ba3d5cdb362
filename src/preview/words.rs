//! What the engine says in the words of the command line, in those of the window.

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
