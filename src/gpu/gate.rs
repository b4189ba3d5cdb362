//! Submissions of several threads to one device, which one of them may hold back.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Longest that submissions are held back: whoever shut the gate may have no more turn in which to open it, as a window that is
/// minimised.
const HELD: Duration = Duration::from_secs(1);

/// What submissions to a shared device pass, open unless somebody needs the device to come idle: a window's surface can be configured
/// only while nothing is submitted.
#[derive(Debug, Default)]
pub struct Gate {
    shut: Mutex<bool>,
    opened: Condvar,
}

impl Gate {
    /// Holds submissions back until [`Gate::open`], for a second at most. One that is being made is waited for.
    pub fn shut(&self) {
        *self.shut.lock().unwrap_or_else(PoisonError::into_inner) = true;
    }

    /// Lets submissions pass again.
    pub fn open(&self) {
        *self.shut.lock().unwrap_or_else(PoisonError::into_inner) = false;
        self.opened.notify_all();
    }

    /// Waits until submissions may pass; until the guard is dropped the gate cannot be shut.
    pub fn pass(&self) -> MutexGuard<'_, bool> {
        let shut = self.shut.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut shut, waited) = self.opened.wait_timeout_while(shut, HELD, |shut| *shut).unwrap_or_else(PoisonError::into_inner);
        if waited.timed_out() {
            // It was forgotten.
            *shut = false;
        }
        shut
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::mpsc;
    use std::time::Instant;

    fn passes(gate: &Arc<Gate>) -> mpsc::Receiver<Duration> {
        let (sender, receiver) = mpsc::channel();
        let (gate, start) = (gate.clone(), Instant::now());
        std::thread::spawn(move || {
            drop(gate.pass());
            sender.send(start.elapsed()).unwrap();
        });
        receiver
    }

    #[test]
    fn a_shut_gate_holds_until_it_is_opened_or_a_second_is_over() {
        let gate = Arc::new(Gate::default());
        assert!(passes(&gate).recv().unwrap() < HELD / 2, "open");
        gate.shut();
        let waiting = passes(&gate);
        assert!(waiting.recv_timeout(Duration::from_millis(300)).is_err(), "shut");
        gate.open();
        assert!(waiting.recv().unwrap() < HELD, "opened");
        gate.shut();
        assert!(passes(&gate).recv().unwrap() >= HELD, "forgotten");
        assert!(passes(&gate).recv().unwrap() < HELD / 2, "and no longer shut");
    }
}
