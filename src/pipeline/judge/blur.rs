//! Whether a frame moved: how much better its best motion explains parts of it that the motion was not fitted to than no motion does.

use super::{Judgement, Kind};

/// Mean over blocks of the frame of the logarithm of a ratio of held-out squared residuals, in which the scale of the noise cancels.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlurEvidence {
    /// Of one pose over the best motion.
    pub still: f64,
    /// Its standard error.
    pub still_error: f64,
    /// Of no structure at all over the best motion.
    pub blank: f64,
    /// Length of that motion, pixels: an even stroke of the same standard deviation.
    pub stroke: f64,
}

impl BlurEvidence {
    /// How much better the motion explains the frame than the better of one pose and nothing at all: a motion that explains less than nothing is none.
    pub(super) fn value(&self) -> f64 {
        self.still.min(self.blank)
    }
}

/// Logarithm of the ratio above which a frame moved.
const MOVED: f64 = 0.10;
/// Standard errors by which it has to be above 0.
const SIGNIFICANT: f64 = 2.0;
/// Stroke in pixels below which a blur is none: what the denoised scene is sharper or softer than the frame passes for one of up to that.
const NONE: f64 = 1.5;
/// Logarithm of the ratio below which no motion explains more than nothing does: blurs of random brackets came to 0.4 and more, one found beside a frame drowned in noise to -0.2.
const NOTHING: f64 = 0.05;

impl BlurEvidence {
    fn line(&self) -> f64 {
        MOVED.max(SIGNIFICANT * self.still_error)
    }
}

/// The judgement of a frame of which a motion was found.
pub(crate) fn blurred(e: &BlurEvidence) -> Judgement {
    let line = e.line();
    let compared = "ln of the held-out residual of one pose, or of nothing, over that of a motion";
    if e.value() > line && e.stroke > NONE {
        let reason = format!("a motion of {:.1} px explains it {:.0} % better than none", e.stroke, 100.0 * e.value().exp_m1());
        return Judgement::by(Kind::Moved, compared, e.value(), line, reason);
    }
    let reason = if e.value() > line {
        format!("a motion of {:.1} px at most explains it better than none", e.stroke)
    } else {
        "no motion explains it better than none".into()
    };
    Judgement::by(Kind::Stationary, compared, e.value(), line, reason)
}

/// Whether the motion explains the frame no better than nothing does: the frame shows another scene, or what it is compared with is too noisy to tell.
pub(crate) fn explains_nothing(e: &BlurEvidence) -> bool {
    e.blank < NOTHING
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(still: f64, still_error: f64, blank: f64, stroke: f64) -> Kind {
        blurred(&BlurEvidence { still, still_error, blank, stroke }).kind
    }

    #[test]
    fn a_frame_moved_if_a_motion_explains_it_better_than_none_and_than_nothing() {
        assert_eq!(kind(1.9, 0.2, 3.0, 5.0), Kind::Moved);
        assert_eq!(kind(0.02, 0.03, 1.4, 4.0), Kind::Stationary);
        assert_eq!(kind(2.1, 0.3, -0.6, 14.0), Kind::Stationary, "it explains less than nothing does");
        assert_eq!(kind(0.4, 0.25, 1.0, 5.0), Kind::Stationary, "by chance");
        assert_eq!(kind(0.6, 0.1, 2.2, 1.0), Kind::Stationary, "a blur of a pixel is what denoising makes of sharp frames");
    }

    #[test]
    fn the_margin_is_the_distance_from_the_line() {
        let found = blurred(&BlurEvidence { still: 1.9, still_error: 0.2, blank: 3.0, stroke: 5.0 });
        assert!((found.margin.unwrap() - 1.5).abs() < 1e-12 && found.line == Some(0.4), "{found:?}");
    }
}
