//! Who may import whom: the `crate::` paths of the sources against a table.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Names, each with the names that it may use.
type Table = &'static [(&'static str, &'static [&'static str])];

/// Module: what it may name of the crate, as `module` or, where only some items may pass, `module::Item`.
const TABLE: Table = &[
    // What everything else speaks of.
    ("error", &[]),
    ("image", &["error"]),
    ("pose", &[]),
    ("exposure", &["error", "image"]),
    // Mathematics without images.
    ("fft", &[]),
    ("maths", &[]),
    ("random", &["maths"]),
    ("nonnegative", &[]),
    ("robust", &[]),
    ("sampling", &["image"]),
    // The stages before the solver: none knows a GPU.
    ("response", &["error", "image", "exposure", "mask::CLIPPED", "noise", "robust::precision"]),
    ("noise", &["image", "exposure", "pose::project", "random::Random", "response::Response", "kernels::NOISE_STEPS"]),
    ("photometry", &["image::Rgb", "exposure::Frame", "mask::CLIPPED", "noise::FrameNoise", "pose::project", "robust::precision"]),
    ("mask", &["image", "exposure", "pose"]),
    ("hot", &["error::Result", "image", "exposure", "noise", "pose::nearest_pixel", "register", "random::Random", "response::Response"]),
    ("ghosts", &["image", "exposure", "mask", "noise", "pose::project", "sampling"]),
    ("merge", &["image", "exposure", "mask", "noise", "pose"]),
    ("baseline", &["error", "image", "exposure", "response", "mask", "merge", "noise", "gpu", "deblur", "tsf::Tsf", "kernels::Kernels"]),
    ("channels", &["image", "exposure", "mask", "merge", "noise"]),
    ("register", &["image", "pose", "exposure", "noise", "mask", "fft", "sampling"]),
    ("psf", &["image", "fft", "nonnegative"]),
    ("tsf", &["error", "image", "pose", "psf", "fft", "nonnegative", "sampling"]),
    ("blind", &["image", "mask", "merge", "pose", "psf", "random", "sampling", "tsf"]),
    // The device, its operators, the solver.
    ("gpu", &["error"]),
    ("kernels", &["error", "gpu", "pose::project", "tsf::Interpolation", "tsf::Tap", "tsf::TapSet", "tsf::WARP_COST"]),
    ("collaborative", &["image", "pose::project", "sampling"]),
    ("deblur", &["error", "image", "pose", "collaborative", "gpu", "kernels", "sampling", "tsf::Interpolation", "tsf::TapSet", "tsf::Tsf"]),
    // All stages in order. Of the kernels it only opens the set.
    (
        "pipeline",
        &[
            "error",
            "image",
            "pose",
            "exposure",
            "response",
            "noise",
            "photometry",
            "channels",
            "ghosts",
            "hot",
            "mask",
            "merge",
            "register",
            "psf",
            "tsf",
            "blind",
            "gpu",
            "deblur",
            "kernels::Kernels",
            "kernels::STILL",
            "kernels::UNSEEN",
        ],
    ),
    // Brackets with known truth: never an estimator.
    ("synth", &["error", "image", "maths", "pose", "random", "exposure", "response", "tsf::Tsf", "tsf::TsfEntry", "tsf::TsfFile"]),
    // Colours.
    ("colour", &["image"]),
    // What a result rests on.
    ("layers", &["image", "pose::nearest_pixel", "exposure", "response", "mask::CLIPPED", "pipeline::Outcome"]),
    // Judges and pictures.
    ("metrics", &["error", "image"]),
    ("tonemap", &["error", "image"]),
    // The paper's experiments: brackets, the pipeline, baselines, judges.
    (
        "experiments",
        &[
            "error",
            "image",
            "pose",
            "exposure",
            "response",
            "baseline",
            "metrics",
            "tonemap",
            "synth",
            "random",
            "pipeline",
            "noise",
            "mask",
            "merge::gradient_level",
            "register::Registrar",
            "psf",
            "tsf",
        ],
    ),
    // The edges of the program.
    ("io", &["error", "image", "colour", "mask::CLIPPED", "exposure", "response", "tsf::Tsf", "tsf::TsfEntry", "tsf::TsfFile"]),
    (
        "cli",
        &[
            "error",
            "image",
            "exposure",
            "noise::NoiseModel",
            "response",
            "baseline",
            "experiments",
            "colour",
            "layers",
            "merge::resampled",
            "deblur::Prior",
            "io",
            "pipeline",
            "metrics",
            "tonemap",
            "synth",
            "random",
            "preview",
            "gpu::list_adapters",
            "tsf::Interpolation",
            "tsf::Model",
            "tsf::Tsf",
            "tsf::TsfEntry",
            "tsf::TsfFile",
        ],
    ),
    // The window: asks the pipeline, draws with its kernel, never estimates. `cli` hands itself in.
    (
        "preview",
        &[
            "error",
            "image",
            "pose",
            "exposure",
            "response",
            "noise",
            "mask",
            "baseline",
            "colour",
            "layers",
            "io",
            "pipeline",
            "tonemap",
            "gpu",
            "kernels::DeviceRgb",
            "kernels::Display",
            "kernels::DisplayParams",
            "kernels::Part",
            "kernels::Place",
            "tsf::Model",
            "tsf::Tsf",
            "tsf::TsfEntry",
            "tsf::TsfFile",
            "tsf::extent",
        ],
    ),
    ("lib", &[]),
    ("main", &["cli"]),
];

/// The files of some modules' folders, from the bottom up, each with what it may name of its folder: files, which must stand before it, so that
/// no two need each other, and items of the module's head.
const WITHIN: &[(&str, Table)] = &[
    (
        "kernels",
        &[
            // What an operator is given.
            ("scratch", &[]),
            ("geometry", &[]),
            ("tables", &[]),
            // The designs of K: neither knows the other, nor who chooses.
            ("bands", &["scratch", "geometry", "tables"]),
            ("tiles", &["scratch", "geometry", "tables"]),
            ("blur", &["scratch", "geometry", "tables", "bands", "tiles"]),
            // The other operators, and the window's kernels.
            ("linear", &["DeviceRgb"]),
            ("data", &["linear"]),
            ("display", &["DeviceRgb"]),
        ],
    ),
    (
        "preview",
        &[
            ("words", &[]),
            ("shortcuts", &[]),
            ("device", &[]),
            ("program", &[]),
            ("session", &[]),
            // What takes time, and what comes of it.
            ("worker", &["program", "session"]),
            ("canvas", &["worker"]),
            ("pictures", &["worker"]),
            // What every part of the window shows and changes; the parts do not know the window.
            ("state", &["words", "program", "session", "worker", "canvas", "pictures"]),
            ("messages", &["state"]),
            ("export", &["worker", "state"]),
            ("blur", &["worker", "canvas", "state"]),
            ("main_view", &["worker", "canvas", "state", "blur"]),
            ("controls", &["words", "shortcuts", "session", "worker", "state", "export", "blur"]),
            ("strip", &["words", "state", "controls"]),
            (
                "app",
                &[
                    "words",
                    "shortcuts",
                    "device",
                    "program",
                    "session",
                    "worker",
                    "canvas",
                    "state",
                    "messages",
                    "export",
                    "blur",
                    "main_view",
                    "controls",
                    "strip",
                ],
            ),
        ],
    ),
];

/// The code of a source: no comments, no strings' contents that matter, one line.
fn code(source: &str) -> String {
    let lines = source.lines().map(|l| l.split("//").next().unwrap_or_default());
    lines.collect::<Vec<_>>().join(" ").split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Every path after `prefix` (`crate::`) as `module` or `module::item`; braces are opened.
fn paths(source: &str, prefix: &str) -> BTreeSet<String> {
    let code = code(source);
    let mut found = BTreeSet::new();
    for (at, _) in code.match_indices(prefix) {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_') {
            continue;
        }
        for tree in branches(&code[at + prefix.len()..]) {
            let (module, rest) = tree.split_once("::").unwrap_or((&tree, ""));
            let items = if rest.is_empty() { vec![String::new()] } else { branches(rest) };
            for item in items {
                let item = item.split("::").next().unwrap_or_default();
                let item = item.split(" as ").next().unwrap_or_default();
                let whole = item.is_empty() || item == "self";
                found.insert(if whole { module.to_string() } else { format!("{module}::{item}") });
            }
        }
    }
    found
}

/// The paths at the head of `text`: one, or those between its braces.
fn branches(text: &str) -> Vec<String> {
    let Some(inner) = text.strip_prefix('{') else {
        // One path, up to the first character that no path holds, with the group of braces that may end it.
        let end = text.find(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':' || c == '*')).unwrap_or(text.len());
        let group = if text[..end].ends_with("::") && text[end..].starts_with('{') { closing(&text[end..]) } else { 0 };
        return vec![text[..end + group].trim_end_matches(':').to_string()];
    };
    let (mut depth, mut parts) = (0, vec![String::new()]);
    for c in inner[..closing(text) - 2].chars() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(String::new());
                continue;
            }
            _ => {}
        }
        parts.last_mut().expect("never empty").push(c);
    }
    parts.iter().map(|p| p.trim().to_string()).filter(|p| !p.is_empty()).collect()
}

/// Bytes up to and with the brace that closes the one `text` begins with.
fn closing(text: &str) -> usize {
    let mut depth = 0;
    for (i, c) in text.char_indices() {
        depth += match c {
            '{' => 1,
            '}' => -1,
            _ => 0,
        };
        if depth == 0 {
            return i + 1;
        }
    }
    text.len()
}

/// What `sources` (module, text) import against `table`, one line each.
fn violations(sources: &[(String, String)], table: Table) -> Vec<String> {
    let table: BTreeMap<_, _> = table.iter().copied().collect();
    let mut found = Vec::new();
    for (module, text) in sources {
        let Some(allowed) = table.get(module.as_str()) else {
            found.push(format!("{module} has no line in the table of layers"));
            continue;
        };
        // The binary names the library by its name.
        for path in paths(text, "crate::").union(&paths(text, "unshaken::")) {
            let other = path.split("::").next().unwrap_or_default();
            if other != module && !allowed.contains(&other) && !allowed.contains(&path.as_str()) {
                found.push(format!("{module} may not import {path}"));
            }
        }
    }
    found
}

/// What the files of the module `folder` (name, text) import of each other against `files`, one line each, and what is wrong with `files`.
fn violations_within(folder: &str, sources: &[(String, String)], files: Table) -> Vec<String> {
    let mut found = Vec::new();
    for (i, (file, allowed)) in files.iter().enumerate() {
        if let Some(late) = files[i..].iter().find(|(f, _)| allowed.contains(f)) {
            found.push(format!("{folder}/{file} is allowed {}, which does not come before it", late.0));
        }
    }
    for (file, text) in sources {
        let Some((_, allowed)) = files.iter().find(|(f, _)| f == file) else {
            found.push(format!("{folder}/{file} has no line in the table of files"));
            continue;
        };
        for path in paths(text, "super::").union(&paths(text, &format!("crate::{folder}::"))) {
            let other = path.split("::").next().unwrap_or_default();
            if !allowed.contains(&other) {
                found.push(format!("{folder}/{file} may not import {path}"));
            }
        }
    }
    found
}

/// All sources below `folder` with the module that each belongs to.
fn sources(folder: &Path, module: Option<&str>, into: &mut Vec<(String, String)>) {
    for entry in std::fs::read_dir(folder).expect("the sources") {
        let path = entry.expect("readable").path();
        let stem = path.file_stem().expect("a name").to_str().expect("ASCII").to_string();
        let module = module.unwrap_or(&stem);
        if path.is_dir() {
            sources(&path, Some(module), into);
        } else if path.extension().is_some_and(|e| e == "rs") {
            into.push((module.to_string(), std::fs::read_to_string(&path).expect("text")));
        }
    }
}

#[test]
fn modules_import_what_their_layer_allows() {
    let mut all = Vec::new();
    sources(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src")), None, &mut all);
    assert!(all.len() > 15, "only {} sources found", all.len());
    let found = violations(&all, TABLE);
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn files_of_a_module_import_what_their_layer_allows() {
    for (folder, files) in WITHIN {
        let mut found = Vec::new();
        for entry in std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("src").join(folder)).expect("the sources") {
            let path = entry.expect("readable").path();
            let name = path.file_stem().expect("a name").to_str().expect("ASCII").to_string();
            // The head of the module knows all its files, and hands on what of them is known outside.
            if name != "mod" {
                found.push((name, std::fs::read_to_string(&path).expect("text")));
            }
        }
        assert_eq!(found.len(), files.len(), "{folder}");
        let found = violations_within(folder, &found, files);
        assert!(found.is_empty(), "{}", found.join("\n"));
    }
}

#[test]
fn a_wrong_import_within_a_module_is_found() {
    let files: Table = &[("below", &[]), ("above", &["below", "Name"])];
    let check = |file: &str, text: &str| violations_within("kernels", &[(file.into(), text.into())], files);
    for (file, text) in [
        ("below", "use super::above::Thing;"),
        ("below", "use super::{above, Name};"),
        ("below", "fn f() -> crate::kernels::above::Thing {}"),
        ("above", "use super::*;"),
        ("beside", ""),
    ] {
        assert!(!check(file, text).is_empty(), "{file}: {text}");
    }
    for (file, text) in
        [("above", "use super::{Name, below::{Thing, Other}};"), ("below", "// super::above\npub(super) fn f() {}\nuse crate::gpu::Gpu;")]
    {
        assert_eq!(check(file, text), Vec::<String>::new(), "{file}: {text}");
    }
    let circle: Table = &[("one", &["other"]), ("other", &["one"])];
    assert_eq!(violations_within("kernels", &[], circle).len(), 1);
}

#[test]
fn a_wrong_import_is_found_however_it_is_written() {
    let check = |module: &str, text: &str| violations(&[(module.into(), text.into())], TABLE);
    for (module, text) in [
        ("synth", "use crate::deblur::solve;"),
        ("synth", "use crate::tsf::estimate;"),
        ("synth", "use crate::{image::Rgb, photometry};"),
        ("gpu", "use crate::{\n    error::Error,\n    image::{Plane, Rgb},\n};"),
        ("gpu", "fn f() { crate::kernels::channels(); }"),
        ("kernels", "use crate::tsf::{Interpolation, Tsf};"),
        ("kernels", "pub use crate::deblur;"),
        ("pipeline", "use crate::kernels::{Kernels, Blur};"),
        ("pipeline", "use crate::kernels::*;"),
        ("cli", "use crate::kernels;"),
        ("error", "use crate::image::Plane as P;"),
        ("main", "use unshaken::gpu::Gpu;"),
        ("helpers", ""),
    ] {
        assert!(!check(module, text).is_empty(), "{module}: {text}");
    }
    for (module, text) in [
        ("gpu", "// use crate::image;\n/// [`crate::deblur::solve`]\nuse crate::error::{Error, Result};"),
        ("kernels", "use crate::tsf::{Interpolation, Tap, TapSet};\nuse crate::gpu::{self, Gpu};"),
        ("synth", "use crate::{error::Result, tsf::{Tsf, TsfFile}, synth::scene};"),
        ("pipeline", "let k = crate::kernels::Kernels::new(gpu);"),
        ("main", "fn main() { unshaken::cli::main() }"),
    ] {
        assert_eq!(check(module, text), Vec::<String>::new(), "{module}: {text}");
    }
}

/// Judgements are made of numbers: not of images, and not of what the rest of the pipeline has.
#[test]
fn judgements_know_nothing_but_numbers() {
    let mut all = Vec::new();
    sources(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/src/pipeline/judge")), Some("judge"), &mut all);
    assert!(all.len() >= 2);
    for (_, text) in all {
        assert!(paths(&text, "crate::").is_empty(), "{:?}", paths(&text, "crate::"));
        for path in paths(&text, "super::") {
            let own = ["Judgement", "Kind", "*", "blur", "pair"];
            assert!(own.contains(&path.split("::").next().unwrap_or_default()), "super::{path}");
        }
    }
}

#[test]
fn the_oracles_know_nothing_of_the_kernels() {
    let mut all = Vec::new();
    sources(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/oracle")), Some("oracle"), &mut all);
    assert!(all.len() >= 4);
    for (_, text) in all {
        let imports = paths(&text, "unshaken::");
        assert!(!imports.iter().any(|p| ["kernels", "deblur", "gpu"].contains(&p.split("::").next().unwrap_or_default())), "{imports:?}");
    }
}
