//! JPEG, PNG and TIFF frames with their orientation, profile and EXIF data.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::Path;

fuzz_target!(|bytes: &[u8]| {
    let bytes = bytes.to_vec();
    let Ok(frame) = unshaken::io::input::decode(Path::new("a.jpg"), bytes, 1.0) else { return };
    let (width, height) = frame.intensity.size();
    assert!(frame.intensity.0.iter().all(|p| p.data.len() == width * height && p.data.iter().all(|v| (0.0..=1.0).contains(v))));
    let _ = frame.metadata.exif_block();
});
