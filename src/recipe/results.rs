//! What steps have made, kept from one run of a recipe to the next.
//!
//! A step is known by what its result depends on: its operator and parameters, the files that it reads as they are on the disk, and the steps
//! that it takes results of, known in the same way. One that is known and kept need not run again.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::run::{Slot, StepReport};
use crate::mesh::Remesh;
use crate::render::Redraw;

/// When a file was changed last, and its size; `None` if it is not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Stamp(Option<(SystemTime, u64)>);

impl Stamp {
    /// Of a file.
    pub fn of(path: &Path) -> Self {
        let facts = std::fs::metadata(path).ok();
        Self(facts.and_then(|facts| Some((facts.modified().ok()?, facts.len()))))
    }
}

/// All that the result of a step depends on.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct Key {
    /// Operator and parameters.
    pub what: String,
    /// The results that it takes, in their order, and then the steps that write files it reads.
    pub steps: Vec<Identity>,
    /// The files that it takes or reads, in their order.
    pub files: Vec<(PathBuf, Stamp)>,
}

/// Stands for a key; the same for the same one.
pub(super) type Identity = u64;

/// The results of the steps of a recipe, and what its files were written from. Each run forgets what it did not use.
#[derive(Default)]
pub struct Results {
    /// What stands for each key, and whether it was asked for.
    identities: HashMap<Key, (Identity, bool)>,
    made: u64,
    steps: HashMap<Identity, Made>,
    /// What each file was written from last.
    outputs: HashMap<PathBuf, LastOutput>,
    /// Most bytes of results that are kept; all if not given.
    most: Option<u64>,
}

/// What a step has made.
pub(super) struct Made {
    pub slot: Option<Slot>,
    pub report: StepReport,
    /// The files that it wrote, as they were when it had.
    pub files: Vec<(PathBuf, Stamp)>,
    bytes: u64,
    is_used: bool,
}

/// What a file was written from: its next content takes from this what has not changed.
#[derive(Default)]
pub(super) struct LastOutput {
    /// Of a picture, one an input.
    pub pictures: Vec<Redraw>,
    /// Of a mesh.
    pub mesh: Remesh,
    is_used: bool,
}

impl LastOutput {
    fn bytes(&self) -> u64 {
        self.pictures.iter().map(Redraw::bytes).sum::<u64>() + self.mesh.bytes()
    }
}

impl Results {
    /// Results of which at most so many bytes are kept; what is beyond is made again.
    pub fn within(most: Option<u64>) -> Self {
        Self { most, ..Self::default() }
    }

    pub(super) fn identity(&mut self, key: Key) -> Identity {
        let known = self.identities.entry(key).or_insert_with(|| {
            self.made += 1;
            (self.made, true)
        });
        known.1 = true;
        known.0
    }

    /// What a step has made, unless its files have been changed since.
    pub(super) fn get(&mut self, step: Identity) -> Option<&Made> {
        let made = self.steps.get_mut(&step)?;
        made.is_used = true;
        made.files.iter().all(|(path, stamp)| Stamp::of(path) == *stamp).then_some(made)
    }

    pub(super) fn keep(&mut self, step: Identity, slot: Option<&Slot>, report: &StepReport, files: &[PathBuf]) {
        self.steps.remove(&step);
        // Pages that several results share are counted for each of them.
        let bytes = slot.map_or(0, |slot| slot.level_set.grid().bytes());
        if self.has_room(bytes) {
            let files = files.iter().map(|path| (path.clone(), Stamp::of(path))).collect();
            self.steps.insert(step, Made { slot: slot.cloned(), report: report.clone(), files, bytes, is_used: true });
        }
    }

    fn has_room(&self, bytes: u64) -> bool {
        let steps = self.steps.values().map(|made| made.bytes);
        let outputs = self.outputs.values().map(LastOutput::bytes);
        self.most.is_none_or(|most| steps.chain(outputs).fold(bytes, u64::saturating_add) <= most)
    }

    /// Has a file written from what it was written from last.
    pub(super) fn with_last<T>(&mut self, path: &Path, write: impl FnOnce(&mut LastOutput) -> T) -> T {
        let mut last = self.outputs.remove(path).unwrap_or_default();
        let written = write(&mut last);
        last.is_used = true;
        if self.has_room(last.bytes()) {
            self.outputs.insert(path.into(), last);
        }
        written
    }

    /// Notes that the last content of a file is still the one that is wanted.
    pub(super) fn keep_last(&mut self, path: &Path) {
        if let Some(last) = self.outputs.get_mut(path) {
            last.is_used = true;
        }
    }

    /// Forgets what was not used since this was called last. To be called when a recipe has run for all frames.
    pub fn forget_unused(&mut self) {
        self.steps.retain(|_, made| std::mem::take(&mut made.is_used));
        self.outputs.retain(|_, last| std::mem::take(&mut last.is_used));
        self.identities.retain(|_, (_, is_used)| std::mem::take(is_used));
    }
}
