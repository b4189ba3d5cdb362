//! What the workers make of frames and solutions to be looked at: asked for once, kept until it is of something else. Knows neither what is
//! shown of it nor where.

use super::worker::{Overlay, OverlayKey, Picture, Ready, Solved, Toned, Toning, Workers};
use crate::tonemap::Operator;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Frames, overlays and toned pictures.
#[derive(Default)]
pub struct Pictures {
    frames: BTreeMap<usize, Picture>,
    asked_frames: BTreeSet<usize>,
    overlays: BTreeMap<OverlayKey, Overlay>,
    asked_overlays: BTreeSet<OverlayKey>,
    /// The pictures shown, as the operator tones them that looks at surroundings.
    tones: Vec<Toned>,
    asked_tones: Option<Toning>,
}

impl Pictures {
    /// Forgets all: they are of other frames.
    pub fn forget(&mut self) {
        *self = Self::default();
    }

    /// Forgets the overlays: they are of another solution.
    pub fn forget_overlays(&mut self) {
        self.overlays.clear();
        self.asked_overlays.clear();
    }

    /// Hears that the picture of frame `i` is there.
    pub fn hear_frame(&mut self, i: usize, picture: Picture) {
        self.frames.insert(i, picture);
    }

    /// Hears that an overlay is there, which may be forgotten already.
    pub fn hear_overlay(&mut self, key: OverlayKey, overlay: Overlay) {
        if self.asked_overlays.contains(&key) {
            self.overlays.insert(key, overlay);
        }
    }

    /// Hears that a toned picture is there.
    pub fn hear_toned(&mut self, toned: Toned) {
        self.tones.retain(|t| t.of != toned.of);
        self.tones.push(toned);
    }

    /// Frame `i` of those that are `ready`; asked for where it is not there.
    pub fn frame(&mut self, workers: &Workers, ready: Arc<Ready>, i: usize) -> Option<Picture> {
        if i < ready.opened.bracket.frames().len() && self.asked_frames.insert(i) {
            workers.frame(ready, i);
        }
        self.frames.get(&i).cloned()
    }

    /// The overlay `key` of `solved`; asked for where it is not there.
    pub fn overlay(&mut self, workers: &Workers, key: OverlayKey, solved: Arc<Solved>) -> Option<Overlay> {
        if self.asked_overlays.insert(key) {
            workers.overlay(key, solved);
        }
        self.overlays.get(&key).cloned()
    }

    /// `picture` as `operator` tones it. Toned with other parameters it is still closer than what treats all pixels alike.
    pub fn toned(&self, picture: &Picture, operator: &Operator) -> Option<&Picture> {
        self.tones.iter().find(|t| t.of == *picture && t.operator.name() == operator.name()).map(|t| &t.picture)
    }

    /// Asks for those of `pictures` that are not toned by `operator` yet; says so where there are any, and that they are shown as `plain` until
    /// then.
    pub fn tone(
        &mut self,
        workers: &Workers,
        operator: &Operator,
        plain: &Operator,
        pictures: &[Option<Picture>; 2],
        ready: &Ready,
    ) -> Option<String> {
        let shown: Vec<&Picture> = pictures.iter().flatten().collect();
        self.tones.retain(|t| shown.contains(&&t.of));
        // What the solver works on is another before it could be toned.
        let (still, changing): (Vec<&Picture>, Vec<&Picture>) = shown.into_iter().partition(|p| p.version == 0);
        let done = |p: &Picture| self.tones.iter().any(|t| t.of == *p && t.operator == *operator);
        let mut wanted: Vec<Picture> = still.into_iter().filter(|p| !done(p)).cloned().collect();
        wanted.dedup();
        let name = operator.name();
        if wanted.is_empty() {
            return (!changing.is_empty()).then(|| format!("{name} follows when it is solved; until then {}", plain.name()));
        }
        let asked = self.asked_tones.as_ref().is_some_and(|a| a.operator == *operator && wanted.iter().all(|p| a.pictures.contains(p)));
        if !asked {
            let toning = Toning { operator: operator.clone(), pictures: wanted, to_display: ready.opened.to_display };
            self.asked_tones = Some(toning.clone());
            workers.tone(toning);
        }
        Some(format!("{name} is being computed ..."))
    }
}
