//! OpenEXR frames: our checks and attributes around the reader.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::Path;

fuzz_target!(|bytes: &[u8]| {
    if bytes.len() < 4 {
        return;
    }
    // The magic number, without which the file goes elsewhere.
    let bytes = [&[0x76, 0x2f, 0x31, 0x01], &bytes[4..]].concat();
    let Ok(frame) = unshaken::io::input::decode(Path::new("a.exr"), bytes, 1.0) else { return };
    let (width, height) = frame.intensity.size();
    assert!(frame.intensity.0.iter().all(|p| p.data.len() == width * height && p.data.iter().all(|v| (0.0..=1.0).contains(v))));
    let _ = frame.metadata.exif_block();
});
