//! Ctrl-C, and SIGTERM: stop, leave no partial file, exit with 130.

use crate::io::output;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Exit code of an interrupted run, as shells count it.
pub(super) const INTERRUPTED: u8 = 130;

/// Long enough for the work between two events to end by itself on small pictures; longer, and it is cut off.
const GRACE: Duration = Duration::from_secs(2);

static ASKED: AtomicBool = AtomicBool::new(false);

/// Whether the user asked to stop.
pub(super) fn asked() -> bool {
    ASKED.load(Ordering::SeqCst)
}

/// Listens from now on. Where the system does not let us, the default stays: the program dies at once.
pub(super) fn listen() {
    let _ = ctrlc::set_handler(|| {
        // A second time: at once.
        if ASKED.swap(true, Ordering::SeqCst) {
            leave();
        }
        std::thread::spawn(|| {
            std::thread::sleep(GRACE);
            leave();
        });
    });
}

/// Removes what is half-written and ends the process.
fn leave() -> ! {
    output::abandon();
    std::process::exit(i32::from(INTERRUPTED))
}
