//! TSF files, and the TSFs that stand in a report.
#![no_main]

use libfuzzer_sys::fuzz_target;
use unshaken::tsf::TsfFile;

fuzz_target!(|text: &str| {
    let Ok(file) = TsfFile::parse(text) else { return };
    for file in [file.reduced(2), file] {
        for entry in &file.frames {
            if let Ok(Some(tsf)) = file.find(&entry.frame, entry.width, entry.height) {
                let sum: f64 = tsf.poses.iter().map(|p| p.weight).sum();
                assert!((sum - 1.0).abs() < 1e-6, "weights sum to {sum}");
                assert!(tsf.centre().is_finite());
            }
        }
    }
});
