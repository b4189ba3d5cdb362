//! How much of a merge is done.

/// What stages say is done of the whole, such that none says less than those before: where frames turn out to be others than they were taken for most is
/// done once more, and what is left of the whole is left for that.
#[derive(Debug, Default)]
pub(super) struct Progress {
    /// What was said last, and what was told for it.
    last: (f32, f32),
    /// The same at the first of the stages that are under way.
    first: (f32, f32),
}

impl Progress {
    /// Part of the whole, 0..=1, that is told where a stage says `fraction`.
    pub(super) fn at(&mut self, fraction: f32) -> f32 {
        if fraction < self.last.0 {
            self.first = (fraction, self.last.1);
        }
        let (said, told) = self.first;
        let part = if said < 1.0 { ((fraction - said) / (1.0 - said)).min(1.0) } else { 1.0 };
        self.last = (fraction, told + (1.0 - told) * part);
        self.last.1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_done_once_more_takes_what_is_left() {
        let mut progress = Progress::default();
        let said = [0.02, 0.10, 0.40, 0.40, 0.03, 0.40, 0.99, 0.03, 1.0];
        let told = said.map(|f| progress.at(f));
        assert_eq!(told[..4], said[..4], "as it was said while nothing is done once more");
        assert!(told.windows(2).all(|w| w[1] >= w[0]), "{told:?}");
        assert!((told[5] - (0.4 + 0.6 * 0.37 / 0.97)).abs() < 1e-6, "{told:?}");
        assert_eq!(told[8], 1.0);
    }
}
