//! What the frames are, decided from numbers alone: no image, no device, no report. Each judgement says what was compared, the line and the margin.

mod blur;
mod pair;

pub(super) use blur::{BlurEvidence, blurred, explains_nothing};
pub(super) use pair::Pair;

use serde::Serialize;

/// What a frame is taken for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Kind {
    /// It was not moved while it was exposed.
    Stationary,
    /// It was.
    Moved,
    /// It shows something else, or nothing.
    OtherScene,
    /// The user left it out.
    Excluded,
}

/// ln of a ratio of residuals: strokes of 3 px and more bring that much to frames that are not drowned in noise.
const TOLD: f64 = 0.1;

/// What was decided of a frame, and by how much.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Judgement {
    pub kind: Kind,
    /// What was compared: a quantity's name.
    pub compared: &'static str,
    /// Its value, the line that decides, and how far the value is on the side of the decision, in the same unit; `None` where the user decided.
    pub value: Option<f64>,
    pub line: Option<f64>,
    pub margin: Option<f64>,
    /// In words.
    pub reason: String,
}

impl Judgement {
    /// What the user said.
    pub fn given(kind: Kind) -> Self {
        let reason = match kind {
            Kind::Stationary => "sharp by option",
            Kind::Excluded => "left out",
            _ => "blurred by option",
        };
        Self { kind, compared: "option", value: None, line: None, margin: None, reason: reason.into() }
    }

    /// The frame that is taken for stationary before any other.
    pub fn first() -> Self {
        let reason = "the others are judged beside it, and none of them shows that it moved".into();
        Self { kind: Kind::Stationary, compared: "exposure time", value: None, line: None, margin: None, reason }
    }

    /// Of a frame in which nothing tells whether it moved.
    pub fn untold() -> Self {
        let reason = "too little in it that the others show as well to tell whether it moved: its light counts where it lies".into();
        Self { kind: Kind::Stationary, compared: "nothing", value: None, line: None, margin: None, reason }
    }

    /// Whether it is that of a stationary frame beside another one in which a motion that explains [`TOLD`] of it would have been seen.
    pub fn agrees(&self) -> bool {
        self.kind == Kind::Stationary && self.compared == pair::COMPARED && self.line.is_some_and(|line| line < TOLD)
    }

    /// By on which side of `line` the `value` is.
    pub fn by(kind: Kind, compared: &'static str, value: f64, line: f64, reason: String) -> Self {
        Self { kind, compared, value: Some(value), line: Some(line), margin: Some((value - line).abs()), reason }
    }
}

/// The judgement of the first stationary frame of a bracket after it was asked whether it moved as well: its own blur where all frames may move has a stroke of so many pixels, which
/// counts from `line` on. Where that is `founded`, the joint estimate of all blurs decides.
pub(super) fn doubted(stroke_px: f64, line: f64, founded: bool) -> Judgement {
    let reason = if founded {
        format!("the estimate of all blurs, of which its own would have {stroke_px:.1} px, does not explain the frames better")
    } else {
        "no blur of its own explains the frames better".into()
    };
    Judgement::by(Kind::Stationary, "stroke in pixels of its own blur where all frames may move", stroke_px, line, reason)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_agree_where_a_motion_would_have_been_seen() {
        let beside = |kind, line| Judgement::by(kind, pair::COMPARED, 0.01, line, String::new());
        assert!(beside(Kind::Stationary, 0.08).agrees());
        assert!(!beside(Kind::Stationary, 0.3).agrees(), "noise would hide it");
        assert!(!beside(Kind::Moved, 0.08).agrees());
        assert!(!Judgement::first().agrees() && !Judgement::untold().agrees(), "compared with nothing");
    }
}
