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

/// Stroke in pixels below which a blur is none: what is left of sharp frames between the pixels passes for one of up to that.
const NONE: f64 = 2.0;
/// Standard deviation of the excess of frames that did not move beyond its standard error, at 1, 1/2, 1/4 of the size: mosaic and engine differ most between neighbours, few pixels are
/// left at a quarter. With these, the mean below has a standard deviation of 1.1 in its own standard errors over 157 comparisons of sharp frames of random brackets.
const SYSTEMATIC: [f64; 3] = [0.06, 0.025, 0.06];
/// Weighted mean of the excess, in its standard errors, above which a frame moved: two of those 157 comparisons came above it (3.4 and 3.8), sharp photographs to 2.6; of 121 frames that moved 31 stay
/// below, ten of which moved by more than 3 px beside ones that are mostly noise.
const MOVED: f64 = 2.7;

/// How much better a motion explains one frame than one pose does, less the same the other way round.
#[derive(Clone, Copy, Debug)]
struct Excess {
    /// ln of a ratio of squared residuals: the mean over the sizes, each weighted by the inverse of its variance.
    mean: f64,
    /// Its standard error.
    error: f64,
    /// Stroke in pixels of the motion at the size that says most.
    stroke: f64,
}

/// `of` less `against` over all sizes. Sizes at which only one of the two tells count where no size has both.
fn excess(of: &[Option<BlurEvidence>], against: &[Option<BlurEvidence>]) -> Option<Excess> {
    let both = |k: usize| against.get(k).copied().flatten();
    let paired = (0..of.len()).any(|k| of[k].is_some() && both(k).is_some());
    let (mut sum, mut weights, mut most) = (0.0, 0.0, (f64::MIN, 0.0));
    for (k, (e, systematic)) in of.iter().zip(SYSTEMATIC).enumerate() {
        let (Some(e), back) = (*e, both(k)) else { continue };
        if paired && back.is_none() {
            continue;
        }
        // A blur that explains less than one pose does is nothing to take off.
        let (taken, error) = back.map_or((0.0, 0.0), |b| (b.value().max(0.0), b.still_error));
        let value = if e.stroke > NONE { e.value() } else { 0.0 };
        let weight = 1.0 / (e.still_error.powi(2) + error.powi(2) + systematic.powi(2));
        let said = (value - taken) * weight;
        (sum, weights) = (sum + said, weights + weight);
        most = if said > most.0 { (said, e.stroke) } else { most };
    }
    (weights > 0.0).then(|| Excess { mean: sum / weights, error: weights.powf(-0.5), stroke: most.1 })
}

impl Excess {
    fn says_moved(&self) -> bool {
        self.mean > MOVED * self.error
    }

    fn judgement(&self) -> Judgement {
        let (kind, reason) = if self.says_moved() {
            (Kind::Moved, format!("a motion of {:.1} px explains it {:.0} % better than none", self.stroke, 100.0 * self.mean.exp_m1()))
        } else {
            (Kind::Stationary, "no motion explains it better than none".into())
        };
        Judgement::by(kind, COMPARED, self.mean, MOVED * self.error, reason)
    }
}

impl Pair {
    /// The judgement of the other frame where this one shows that it moved.
    pub fn other_moved(&self) -> Option<Judgement> {
        excess(&self.backward, &self.forward).filter(Excess::says_moved).map(|e| e.judgement())
    }

    /// The judgement of the frame; `None` where nothing tells.
    pub fn judgement(&self) -> Option<Judgement> {
        excess(&self.forward, &self.backward).map(|e| e.judgement())
    }
}

pub(super) const COMPARED: &str = "ln of the held-out residual of one pose, or of nothing, over that of a motion, less the same of the other frame beside this one, mean of three sizes";

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
    fn all_sizes_count_by_how_much_they_tell() {
        let still = evidence(0.01, 0.01, 1.0);
        let (mosaic, weak, chance) = (evidence(0.14, 0.02, 4.0), evidence(0.12, 0.02, 3.6), evidence(0.25, 0.08, 64.0));
        assert_eq!(kind(&[mosaic, still, still], &[still, still, still]), Some(Kind::Stationary), "at one size only");
        assert_eq!(
            kind(&[still, weak, None], &[still, still, None]),
            Some(Kind::Moved),
            "averaged pixels differ by little else than motion"
        );
        assert_eq!(kind(&[still, still, chance], &[still, still, still]), Some(Kind::Stationary), "what few pixels tell is outweighed");
        assert_eq!(
            kind(&[weak, None, None], &[still, still, still]),
            kind(&[weak, None, None], &[still, None, None]),
            "sizes that one lacks"
        );
        assert_eq!(kind(&[weak, mosaic, None], &[still, None, None]), Some(Kind::Stationary), "the other way round is not known there");
    }

    #[test]
    fn a_short_frame_moved_if_a_longer_one_shows_it() {
        let pair = |value: f64| Pair { forward: vec![evidence(0.02, 0.02, 3.0)], backward: vec![evidence(value, 0.03, 6.0)] };
        assert!(pair(0.15).other_moved().is_none());
        let found = pair(0.6).other_moved().unwrap();
        let line = 2.7 * (0.02f64.powi(2) + 0.03f64.powi(2) + 0.06f64.powi(2)).sqrt();
        assert_eq!((found.kind, found.line.map(|l| (l - line).abs() < 1e-12)), (Kind::Moved, Some(true)));
    }

    #[test]
    fn the_margin_is_the_distance_from_the_line() {
        let pair = Pair { forward: vec![evidence(0.9, 0.08, 6.0)], backward: vec![evidence(0.1, 0.0, 3.0)] };
        let found = pair.judgement().unwrap();
        assert!((found.value.unwrap() - 0.8).abs() < 1e-12 && (found.line.unwrap() - 0.27).abs() < 1e-12, "{found:?}");
        assert!((found.margin.unwrap() - 0.53).abs() < 1e-12, "{found:?}");
    }
}
