//! Response files.
#![no_main]

use libfuzzer_sys::fuzz_target;
use unshaken::response::{Response, ResponseFile};

fuzz_target!(|text: &str| {
    let _ = Response::named(text);
    if let Ok(file) = ResponseFile::parse(text) {
        let response = file.response();
        for z in [0.0, 0.5, 1.0] {
            assert!(response.inverse(1, z).is_finite() && response.inverse_slope(1, z, 1.0 / 255.0).is_finite());
        }
    }
});
