//! An open device that remembers what earlier merges found, so that a changed setting runs only the stages that it touches.

use crate::gpu::Gpu;
use crate::kernels::Kernels;
use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Results that are kept, over all stages and sizes.
const KEPT: usize = 96;
/// Bytes of planes among them: two runs of a bracket of five frames of 12 MP, so that an edit can be taken back at no cost.
const ROOM: usize = 3 << 30;

/// The device, its kernels, and what earlier merges found out.
pub struct Engine {
    gpu: Gpu,
    kernels: Option<Kernels>,
    memo: Memo,
    pub(super) stop: Option<Arc<AtomicBool>>,
}

impl Engine {
    /// An engine that forgets each merge.
    pub fn new(gpu: Gpu) -> Self {
        Self { gpu, kernels: None, memo: Memo::default(), stop: None }
    }

    /// An engine that remembers: it holds several planes per frame in memory.
    pub fn remembering(gpu: Gpu) -> Self {
        Self { memo: Memo { remembers: true, ..Memo::default() }, ..Self::new(gpu) }
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Long steps look at `stop` themselves from now on: a merge ends, as cancelled, soon after it is set.
    pub fn stops_at(&mut self, stop: Arc<AtomicBool>) {
        self.stop = Some(stop);
    }

    /// Forgets everything, for other frames.
    pub fn forget(&mut self) {
        self.memo.kept.clear();
    }

    /// Stages that a merge ran since the last [`Engine::forget_run`], by name.
    pub fn ran(&self) -> &[String] {
        &self.memo.ran
    }

    /// Empties the list of [`Engine::ran`].
    pub fn forget_run(&mut self) {
        self.memo.ran.clear();
    }

    pub(super) fn parts(&mut self) -> (&Gpu, &Kernels, &mut Memo) {
        let kernels = self.kernels.get_or_insert_with(|| Kernels::new(&self.gpu));
        (&self.gpu, kernels, &mut self.memo)
    }
}

/// What one stage found and said.
struct Kept {
    key: String,
    bytes: usize,
    found: Box<dyn Any + Send>,
    said: Vec<String>,
}

/// Results of stages under all that they depend on.
#[derive(Default)]
pub(super) struct Memo {
    remembers: bool,
    /// What the next stages depend on; `None`: nothing is remembered.
    key: Option<String>,
    /// The latest last.
    kept: Vec<Kept>,
    said: Vec<String>,
    ran: Vec<String>,
}

impl Memo {
    /// A merge begins, which depends on `key`.
    pub fn begin(&mut self, key: Option<String>) {
        self.key = key.filter(|_| self.remembers);
        self.said.clear();
    }

    /// What comes depends on this as well.
    pub fn depends(&mut self, settings: &impl Debug) {
        if let Some(key) = &mut self.key {
            key.push_str(&format!(" {settings:?}"));
        }
    }

    /// Something is said to the user.
    pub fn hear(&mut self, text: &str) {
        if self.key.is_some() {
            self.said.push(text.into());
        }
    }

    /// How much has been said.
    pub fn said(&self) -> usize {
        self.said.len()
    }

    /// What `stage` found when everything was as it is now, and what it said.
    pub fn recall<T: Clone + 'static>(&mut self, stage: &str) -> Option<(T, Vec<String>)> {
        let key = format!("{}|{stage}", self.key.as_ref()?);
        let at = self.kept.iter().position(|k| k.key == key)?;
        let kept = self.kept.remove(at);
        let found = kept.found.downcast_ref::<T>().cloned().map(|f| (f, kept.said.clone()));
        self.kept.push(kept);
        found
    }

    /// Keeps what `stage` found, which is some `bytes` large, and all that was said after the first `before`.
    pub fn keep<T: Clone + Send + 'static>(&mut self, stage: &str, found: &T, before: usize, bytes: usize) {
        let Some(key) = &self.key else { return };
        self.ran.push(stage.split('{').next().unwrap_or(stage).trim().into());
        let (key, said) = (format!("{key}|{stage}"), self.said[before.min(self.said.len())..].to_vec());
        if bytes > ROOM / 2 {
            return;
        }
        self.kept.push(Kept { key, bytes, found: Box::new(found.clone()), said });
        while self.kept.len() > KEPT || self.kept.iter().map(|k| k.bytes).sum::<usize>() > ROOM {
            self.kept.remove(0);
        }
    }
}
