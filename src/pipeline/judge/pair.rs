//! Which of two frames moved: how much better a motion explains the one from the other than one pose does, less the same the other way round.

use super::blur::BlurEvidence;
use super::{Judgement, Kind};

/// What two frames say of each other, at 1, 1/2, 1/4 of their size; `None` where one has too little texture that the other shows.
#[derive(Clone, Debug)]
pub(crate) struct Pair {
    /// Of the frame beside the other.
    pub forward: Vec<Option<BlurEvidence>>,
    /// Of the other beside the frame.
    pub backward: Vec<Option<BlurEvidence>>,
}

/// Stroke below which a blur is none, in pixels of the size at which it was found: what is left of sharp frames between the pixels passes for one of up to that.
const NONE: f64 = 2.0;
/// Excess, ln of a ratio, and its standard errors above which a frame moved. Of 100 sharp frames of random brackets four came above 0.15, of a real bracket by night one to 0.12; frames that
/// moved by more than 4 px were above 0.2.
const MOVED: (f64, f64) = (0.15, 2.0);
/// The same for a frame beside one that was exposed longer: that is rare, and camera noise reduction softens short frames. Sharp frames came up to 0.21 where four standard errors were
/// less, short frames that moved by more than 3 px beside a sharp longer one from 0.26 and 5 standard errors.
const MOVED_WHILE_SHORTER: (f64, f64) = (0.24, 4.8);

/// How much better a motion explains one frame, by the size that says so most clearly.
#[derive(Clone, Copy, Debug)]
struct Excess {
    value: f64,
    line: f64,
    stroke: f64,
}

impl Excess {
    fn clearness(&self) -> f64 {
        self.value / self.line
    }
}

/// `of` less `against`, size by size. Sizes at which only one of the two tells count where no size has both.
fn excess(of: &[Option<BlurEvidence>], against: &[Option<BlurEvidence>], line: (f64, f64)) -> Option<Excess> {
    let both = |k: usize| against.get(k).copied().flatten();
    let paired = (0..of.len()).any(|k| of[k].is_some() && both(k).is_some());
    let one = |(k, e): (usize, &Option<BlurEvidence>)| {
        let (e, back) = ((*e)?, both(k));
        if paired && back.is_none() {
            return None;
        }
        // A blur that explains less than one pose does is nothing to take off.
        let (taken, error) = back.map_or((0.0, 0.0), |b| (b.value().max(0.0), b.still_error));
        let value = if e.stroke > NONE * f64::from(1u32 << k) { e.value() - taken } else { 0.0 };
        Some(Excess { value, line: line.0.max(line.1 * e.still_error.hypot(error)), stroke: e.stroke })
    };
    of.iter().enumerate().filter_map(one).max_by(|a, b| a.clearness().total_cmp(&b.clearness()))
}

impl Pair {
    /// The judgement of the other frame where this one shows that it moved.
    pub fn other_moved(&self) -> Option<Judgement> {
        excess(&self.backward, &self.forward, MOVED_WHILE_SHORTER).filter(|e| e.clearness() > 1.0).map(|e| moved(&e))
    }

    /// The judgement of the frame; `None` where nothing tells.
    pub fn judgement(&self) -> Option<Judgement> {
        let e = excess(&self.forward, &self.backward, MOVED)?;
        Some(if e.clearness() > 1.0 {
            moved(&e)
        } else {
            Judgement::by(Kind::Stationary, COMPARED, e.value, e.line, "no motion explains it better than none".into())
        })
    }
}

const COMPARED: &str =
    "ln of the held-out residual of one pose, or of nothing, over that of a motion, less the same of the other frame beside this one";

fn moved(e: &Excess) -> Judgement {
    let reason = format!("a motion of {:.1} px explains it {:.0} % better than none", e.stroke, 100.0 * e.value.exp_m1());
    Judgement::by(Kind::Moved, COMPARED, e.value, e.line, reason)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn evidence(still: f64, still_error: f64, stroke: f64) -> Option<BlurEvidence> {
        Some(BlurEvidence { still, still_error, blank: 3.0, stroke })
    }

    fn kind(forward: &[Option<BlurEvidence>], backward: &[Option<BlurEvidence>]) -> Option<Kind> {
        Pair { forward: forward.to_vec(), backward: backward.to_vec() }.judgement().map(|j| j.kind)
    }

    #[test]
    fn what_both_ways_have_in_common_is_no_motion() {
        assert_eq!(kind(&[evidence(0.7, 0.08, 3.0)], &[evidence(0.69, 0.08, 2.4)]), Some(Kind::Stationary));
        assert_eq!(kind(&[evidence(0.7, 0.08, 3.0)], &[evidence(0.05, 0.02, 2.4)]), Some(Kind::Moved));
        assert_eq!(kind(&[evidence(0.4, 0.25, 5.0)], &[evidence(0.0, 0.0, 0.0)]), Some(Kind::Stationary), "by chance");
        assert_eq!(kind(&[evidence(0.6, 0.1, 1.2)], &[evidence(0.0, 0.0, 0.0)]), Some(Kind::Stationary), "a blur of a pixel is none");
        assert_eq!(kind(&[None, None], &[evidence(0.5, 0.1, 6.0)]), None);
    }

    #[test]
    fn a_blur_has_to_be_seen_at_the_size_that_shows_it() {
        let (fine, coarse) = (evidence(0.05, 0.02, 6.0), evidence(0.5, 0.1, 6.0));
        let still = evidence(0.01, 0.01, 1.0);
        assert_eq!(kind(&[fine, coarse, None], &[still, still, None]), Some(Kind::Moved));
        assert_eq!(kind(&[fine, None, coarse], &[still, None, still]), Some(Kind::Stationary), "1.5 px at a quarter of the size");
        assert_eq!(kind(&[fine, coarse, None], &[still, None, None]), Some(Kind::Stationary), "the other way round is not known there");
    }

    #[test]
    fn a_short_frame_moved_if_a_longer_one_shows_it_beyond_doubt() {
        let pair = |value: f64| Pair { forward: vec![evidence(0.02, 0.02, 3.0)], backward: vec![evidence(value, 0.03, 6.0)] };
        assert!(pair(0.19).other_moved().is_none());
        let found = pair(0.6).other_moved().unwrap();
        assert_eq!((found.kind, found.line), (Kind::Moved, Some(0.24)));
    }
}
