//! What cameras note: read, understood as exposures of a bracket, written into a result, and read again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::path::PathBuf;
use unshaken::io::metadata;

fuzz_target!(|bytes: &[u8]| {
    let noted = metadata::read_bytes(bytes);
    let files = [(PathBuf::from("a.jpg"), &noted), (PathBuf::from("b.jpg"), &noted)];
    if let Ok((times, _)) = metadata::exposures(&files) {
        assert!(times.iter().all(|t| t.is_finite() && *t > 0.0), "{times:?}");
    }
    assert!(noted.white_luminance().is_none_or(f64::is_finite));
    let _ = noted.taken.as_deref().and_then(metadata::seconds);
    if let Some(block) = noted.exif_block() {
        let again = metadata::read_bytes(&block);
        assert_eq!((noted.artist, noted.exposure_time.map(f64::to_bits)), (again.artist, again.exposure_time.map(f64::to_bits)));
    }
});
