//! Reading and writing: ours, through the bridge, against a program that calls OpenVDB itself.

use std::path::PathBuf;
use std::time::Instant;

use super::contest::{Contest, timed};
use super::difference::Difference;
use super::{Input, median};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::vdb::reference::ReferenceGrid;
use crate::vdb::{Compression, GridToWrite, WriteOptions, open, write};

/// A folder that goes away with the row, and a file in it for each side.
struct Files {
    _folder: tempfile::TempDir,
    ours: PathBuf,
    theirs: PathBuf,
}

impl Files {
    fn new() -> Result<Self> {
        let failed = |e: std::io::Error| EditError::output(std::env::temp_dir(), e.to_string());
        let folder = tempfile::tempdir().map_err(failed)?;
        let [ours, theirs] = ["ours.vdb", "theirs.vdb"].map(|name| folder.path().join(name));
        Ok(Self { _folder: folder, ours, theirs })
    }
}

fn leaves(input: &Input) -> f64 {
    input.level_set.grid().leaves().len().max(1) as f64
}

/// A file into a level set, against the same file into an OpenVDB grid with all its voxels.
pub(super) struct Reading<'a> {
    input: &'a Input<'a>,
    files: Files,
    ours: Option<LevelSet>,
    theirs: Option<ReferenceGrid>,
}

impl<'a> Reading<'a> {
    pub fn boxed(input: &'a Input<'a>) -> Result<Box<dyn Contest + 'a>> {
        let files = Files::new()?;
        ReferenceGrid::from_level_set(input.level_set)?.write(&files.ours, &WriteOptions::default())?;
        Ok(Box::new(Self { input, files, ours: None, theirs: None }))
    }
}

impl Contest for Reading<'_> {
    fn ours(&mut self) -> Result<f64> {
        self.ours = None;
        let (read, ms) = timed(|| {
            let mut file = open(&self.files.ours, self.input.run)?;
            file.take_level_set(None, false).map(|read| (file, read))
        })?;
        self.ours = Some(read.1.level_set);
        Ok(ms)
    }

    fn theirs(&mut self) -> Result<f64> {
        self.theirs = None;
        let (grid, ms) = timed(|| ReferenceGrid::read(&self.files.ours, *self.input.level_set.transform()))?;
        self.theirs = Some(grid);
        Ok(ms)
    }

    fn difference(&self) -> Result<Difference> {
        let (Some(ours), Some(theirs)) = (&self.ours, &self.theirs) else { return Ok(Difference::default()) };
        let mut difference = Difference::between(ours, &theirs.to_level_set()?, |_, _, _| true);
        difference.leaves = Some(leaves(self.input));
        Ok(difference)
    }
}

/// A flushed and verified file, against OpenVDB's plain write of a grid that it holds already.
pub(super) struct Writing<'a> {
    input: &'a Input<'a>,
    files: Files,
    reference: ReferenceGrid,
}

impl<'a> Writing<'a> {
    pub fn boxed(input: &'a Input<'a>) -> Result<Box<dyn Contest + 'a>> {
        let reference = ReferenceGrid::from_level_set(input.level_set)?;
        Ok(Box::new(Self { input, files: Files::new()?, reference }))
    }
}

impl Contest for Writing<'_> {
    fn ours(&mut self) -> Result<f64> {
        let grid = GridToWrite { level_set: self.input.level_set, name: None, replaces: None };
        let options = WriteOptions { compression: Some(Compression::Blosc), ..WriteOptions::default() };
        Ok(timed(|| write(&self.files.ours, &[grid], None, &options))?.1)
    }

    fn theirs(&mut self) -> Result<f64> {
        Ok(timed(|| self.reference.write(&self.files.theirs, &WriteOptions::default()))?.1)
    }

    fn difference(&self) -> Result<Difference> {
        let [ours, theirs] = [&self.files.ours, &self.files.theirs]
            .map(|path| ReferenceGrid::read(path, *self.input.level_set.transform())?.to_level_set());
        let mut difference = Difference::between(&ours?, &theirs?, |_, _, _| true);
        difference.leaves = Some(leaves(self.input));
        // What the bridge itself adds to a write, without flushing and verifying.
        let mut copies = Vec::new();
        for _ in 0..3 {
            let began = Instant::now();
            let copy = ReferenceGrid::from_level_set(self.input.level_set)?;
            copies.push(began.elapsed().as_secs_f64() * 1e6);
            drop(copy);
        }
        difference.copy_us_a_leaf = Some(median(&copies) / leaves(self.input));
        Ok(difference)
    }
}
