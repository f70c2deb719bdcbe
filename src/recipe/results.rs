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

/// The results of the steps of a recipe, its pictures and meshes. Each run forgets what it did not use.
#[derive(Default)]
pub struct Results {
    /// What stands for each key, and whether it was asked for.
    identities: HashMap<Key, (Identity, bool)>,
    made: u64,
    steps: HashMap<Identity, Made>,
    /// The last pictures of each file, one an input, and whether they were asked for.
    pictures: HashMap<PathBuf, (Vec<Redraw>, bool)>,
    /// The last mesh of each file, and whether it was asked for.
    meshes: HashMap<PathBuf, (Remesh, bool)>,
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
        let pictures = self.pictures.values().flat_map(|(pictures, _)| pictures).map(Redraw::bytes);
        let meshes = self.meshes.values().map(|(mesh, _)| mesh.bytes());
        self.most.is_none_or(|most| steps.chain(pictures).chain(meshes).fold(bytes, u64::saturating_add) <= most)
    }

    /// Has something done with the last pictures of a file.
    pub(super) fn with_pictures<T>(&mut self, path: &Path, draw: impl FnOnce(&mut Vec<Redraw>) -> T) -> T {
        let (mut pictures, _) = self.pictures.remove(path).unwrap_or_default();
        let drawn = draw(&mut pictures);
        if self.has_room(pictures.iter().map(Redraw::bytes).sum()) {
            self.pictures.insert(path.into(), (pictures, true));
        }
        drawn
    }

    /// Has something done with the last mesh of a file.
    pub(super) fn with_mesh<T>(&mut self, path: &Path, write: impl FnOnce(&mut Remesh) -> T) -> T {
        let (mut mesh, _) = self.meshes.remove(path).unwrap_or_default();
        let written = write(&mut mesh);
        if self.has_room(mesh.bytes()) {
            self.meshes.insert(path.into(), (mesh, true));
        }
        written
    }

    /// Notes that the last pictures or the last mesh of a file are still those that are wanted.
    pub(super) fn keep_last(&mut self, path: &Path) {
        if let Some(pictures) = self.pictures.get_mut(path) {
            pictures.1 = true;
        }
        if let Some(mesh) = self.meshes.get_mut(path) {
            mesh.1 = true;
        }
    }

    /// Forgets what was not used since this was called last. To be called when a recipe has run for all frames.
    pub fn forget_unused(&mut self) {
        self.steps.retain(|_, made| std::mem::take(&mut made.is_used));
        self.pictures.retain(|_, (_, is_used)| std::mem::take(is_used));
        self.meshes.retain(|_, (_, is_used)| std::mem::take(is_used));
        self.identities.retain(|_, (_, is_used)| std::mem::take(is_used));
    }
}
