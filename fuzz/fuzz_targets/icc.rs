//! ICC profiles of frames.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(profile) = unshaken::io::icc::parse(bytes) {
        for z in [0.0, 0.3, 1.0] {
            let light = profile.response.inverse(0, z);
            assert!(light.is_finite() && (-1e-9..=1.0 + 1e-9).contains(&light), "{z}: {light}");
        }
        assert!(unshaken::colour::inverse(&profile.to_xyz).is_some());
    }
});
