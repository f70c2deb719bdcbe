//! Two sides that do the same thing, run in turn.

use std::time::Instant;

use glam::IVec3;

use super::Input;
use super::difference::{Difference, bvh};
use crate::error::Result;
use crate::grid::Transform;
use crate::levelset::LevelSet;
use crate::mesh::TriangleMesh;
use crate::vdb::reference::ReferenceGrid;

/// Both sides of a row. What is not part of the operation (copies, conversions, releasing old grids) is not timed.
pub(super) trait Contest {
    /// Runs ours; milliseconds.
    fn ours(&mut self) -> Result<f64>;

    /// Runs OpenVDB's; milliseconds.
    fn theirs(&mut self) -> Result<f64>;

    /// Compares the results of the last runs.
    fn difference(&self) -> Result<Difference>;
}

/// Changes a grid.
type Change<Grid> = dyn Fn(&mut Grid) -> Result<()>;
/// Makes a grid of another.
type Make<Grid> = dyn Fn(&Grid) -> Result<Grid>;

/// What a side does to a grid.
pub(super) enum Operation<Grid> {
    /// Changes it.
    InPlace(Box<Change<Grid>>),
    /// Makes a new one.
    New(Box<Make<Grid>>),
}

impl<Grid> Operation<Grid> {
    /// Changes a grid.
    pub fn in_place(operation: impl Fn(&mut Grid) -> Result<()> + 'static) -> Self {
        Self::InPlace(Box::new(operation))
    }

    /// Makes a new grid.
    pub fn new(operation: impl Fn(&Grid) -> Result<Grid> + 'static) -> Self {
        Self::New(Box::new(operation))
    }

    fn run(&self, mut grid: Grid) -> Result<(Grid, f64)> {
        match self {
            Self::InPlace(operation) => {
                let ms = timed(|| operation(&mut grid))?.1;
                Ok((grid, ms))
            }
            Self::New(operation) => timed(|| operation(&grid)),
        }
    }
}

/// How two grids are held against each other.
pub(super) enum Judge {
    /// Voxel by voxel.
    Equal,
    /// Both against the mesh (in index space) that they were made of, and voxel by voxel where both have one sign: above this
    /// tolerance in voxels they count as apart.
    Mesh { mesh: TriangleMesh, tolerance: f64 },
    /// Voxel by voxel where this holds.
    EqualAt(Box<dyn Fn(IVec3) -> bool>),
    /// Both against the distance to the polygonised input, less this offset (in voxels).
    Truth { offset: f64 },
}

/// A contest of operations on a copy of the input.
pub(super) struct GridContest<'a> {
    input: &'a Input<'a>,
    reference: ReferenceGrid,
    judge: Judge,
    ours: Operation<LevelSet>,
    theirs: Operation<ReferenceGrid>,
    /// The last results.
    results: (Option<LevelSet>, Option<ReferenceGrid>),
}

impl<'a> GridContest<'a> {
    /// A contest on `input`.
    pub fn boxed(
        input: &'a Input<'a>,
        judge: Judge,
        ours: Operation<LevelSet>,
        theirs: Operation<ReferenceGrid>,
    ) -> Result<Box<dyn Contest + 'a>> {
        let reference = ReferenceGrid::from_level_set(input.level_set)?;
        Ok(Box::new(Self { input, reference, judge, ours, theirs, results: (None, None) }))
    }
}

impl Contest for GridContest<'_> {
    fn ours(&mut self) -> Result<f64> {
        self.results.0 = None;
        let (result, ms) = self.ours.run(unshared(self.input.level_set))?;
        self.results.0 = Some(result);
        Ok(ms)
    }

    fn theirs(&mut self) -> Result<f64> {
        self.results.1 = None;
        let (result, ms) = self.theirs.run(self.reference.duplicate()?)?;
        self.results.1 = Some(result);
        Ok(ms)
    }

    fn difference(&self) -> Result<Difference> {
        let (Some(ours), Some(theirs)) = &self.results else { return Ok(Difference::default()) };
        let theirs = theirs.to_level_set()?;
        Ok(match &self.judge {
            Judge::Equal => Difference::between(ours, &theirs, |_, _, _| true),
            Judge::Mesh { mesh, tolerance } => {
                Difference::to_mesh(ours, &theirs, &bvh(mesh, &Transform::uniform(1.0)), *tolerance)
            }
            Judge::EqualAt(counts) => Difference::between(ours, &theirs, |ijk, _, _| counts(ijk)),
            Judge::Truth { offset } => {
                Difference::to_truth(ours, &theirs, self.input.truth()?, self.input.level_set, *offset)
            }
        })
    }
}

/// A copy that shares nothing with the original, as OpenVDB's deep copy.
fn unshared(level_set: &LevelSet) -> LevelSet {
    LevelSet::new(level_set.grid().deep_copy(), *level_set.transform())
}

/// The result of `f` and the milliseconds it took.
pub(super) fn timed<T>(f: impl FnOnce() -> Result<T>) -> Result<(T, f64)> {
    let began = Instant::now();
    let result = f()?;
    Ok((result, began.elapsed().as_secs_f64() * 1e3))
}
