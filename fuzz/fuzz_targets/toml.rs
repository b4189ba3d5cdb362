//! Manifests of batches, and configurations.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Ok(names) = unshaken::cli::manifest_brackets(text) {
        assert!(names.iter().all(|n| !n.contains(['/', '\\', '\0'])));
    }
    let _ = unshaken::cli::configured_options(text);
});
