//! The table of rows: operators, schemes and tolerances are fixed, so that figures of different grids and days compare.

use glam::Vec3;

use super::Input;
use super::contest::{Contest, GridContest, Judge, Operation};
use crate::error::{EditError, Result};
use crate::grid::Transform;
use crate::levelset::LevelSet;
use crate::mesh::{MeshToLevelSet, Rebuild, mesh_to_level_set, rebuild};
use crate::ops::csg::{CsgOperation, csg};
use crate::ops::morphology::offset;
use crate::ops::smooth::{Smooth, SmoothMethod, smooth};
use crate::ops::{EvolutionOptions, Like, Scheme};
use crate::pde::{SolverOptions, UpwindScheme, WenoEpsilon, renormalize, track};
use crate::vdb::reference::{Csg, Filter, ReferenceGrid, ReferenceScheme, Tracker};

/// A row of the table.
pub(super) struct Case {
    /// The operation.
    pub operator: &'static str,
    /// Numerical scheme on both sides.
    pub scheme: &'static str,
    /// What the difference may be, in voxels.
    pub tolerance: f64,
    /// Makes both sides ready.
    pub contest: for<'a> fn(&'a Input<'a>) -> Result<Box<dyn Contest + 'a>>,
}

const FIRST_STEP: &str = "one step and track, first order, RK1, 1";

/// All rows, in order.
pub(super) const CASES: &[Case] = &[
    Case { operator: "mean-curvature", scheme: FIRST_STEP, tolerance: 1e-5, contest: mean_curvature },
    Case { operator: "laplacian", scheme: FIRST_STEP, tolerance: 1e-5, contest: laplacian },
    Case {
        operator: "mean-curvature-default",
        scheme: "one step and track, HJ-WENO5, RK1, 3",
        tolerance: 1e-5,
        contest: mean_curvature_default,
    },
    Case { operator: "normalize-first", scheme: "first order, RK1, 1", tolerance: 1e-5, contest: normalize_first },
    Case { operator: "normalize-weno5", scheme: "HJ-WENO5, RK1, 1", tolerance: 1e-5, contest: normalize_weno5 },
    Case { operator: "track", scheme: "HJ-WENO5, RK1, 3", tolerance: 1e-5, contest: whole_track },
    Case {
        operator: "offset",
        scheme: "one voxel: exact, against HJ-WENO5, RK1, 3",
        tolerance: 0.05,
        contest: exact_offset,
    },
    Case {
        operator: "csg-union",
        scheme: "with a copy shifted by half its size, against csgUnionCopy",
        tolerance: 0.0,
        contest: csg_union,
    },
    Case {
        operator: "rebuild",
        scheme: "half width 3, against levelSetRebuild",
        tolerance: 0.05,
        contest: exact_rebuild,
    },
    Case {
        operator: "mesh-to-level-set",
        scheme: "half width of the input, closed; both against the mesh",
        tolerance: FROM_MESH,
        contest: from_mesh,
    },
];

/// What a distance to a mesh may be off, in voxels.
const FROM_MESH: f64 = 1e-3;

const FIRST: Tracker = Tracker { scheme: ReferenceScheme::First, runge_kutta: 1, normalizations: 1 };
const WENO5: Tracker = Tracker { scheme: ReferenceScheme::HjWeno5, runge_kutta: 1, normalizations: 1 };

type Sides<'a> = Result<Box<dyn Contest + 'a>>;

/// Both sides of an operation that computes the same thing.
fn same<'a>(
    input: &'a Input<'a>,
    ours: impl Fn(&mut LevelSet) -> Result<()> + 'static,
    filter: Filter,
    tracker: Tracker,
) -> Sides<'a> {
    let theirs = Operation::in_place(move |grid: &mut ReferenceGrid| grid.apply(filter, &tracker));
    GridContest::new(input, Judge::Equal, Operation::in_place(ours), theirs)
}

/// One step of a smoothing flow.
fn flow<'a>(
    input: &'a Input<'a>,
    method: SmoothMethod,
    evolution: EvolutionOptions,
    filter: Filter,
    tracker: Tracker,
) -> Sides<'a> {
    let evolution = EvolutionOptions { iterations: Some(1), ..evolution };
    let (params, run) = (Smooth { method, evolution }, input.run.clone());
    same(input, move |grid| smooth(grid, &params, &run).map(drop), filter, tracker)
}

fn first_order() -> EvolutionOptions {
    EvolutionOptions { scheme: Some(Scheme::First), ..EvolutionOptions::default() }
}

fn mean_curvature<'a>(input: &'a Input<'a>) -> Sides<'a> {
    flow(input, SmoothMethod::Curvature, first_order(), Filter::MeanCurvature(1), FIRST)
}

fn laplacian<'a>(input: &'a Input<'a>) -> Sides<'a> {
    flow(input, SmoothMethod::Laplacian, first_order(), Filter::Laplacian(1), FIRST)
}

fn mean_curvature_default<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let like = EvolutionOptions { like: Some(Like::OpenVdb), ..EvolutionOptions::default() };
    flow(input, SmoothMethod::Curvature, like, Filter::MeanCurvature(1), Tracker::default())
}

fn normalize_first<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let run = input.run.clone();
    same(input, move |grid| renormalize(grid, &SolverOptions::FIRST_ORDER, &run), Filter::Normalize, FIRST)
}

fn normalize_weno5<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let solver = SolverOptions {
        scheme: UpwindScheme::HjWeno5,
        weno_epsilon: WenoEpsilon::OPENVDB,
        ..SolverOptions::FIRST_ORDER
    };
    let run = input.run.clone();
    same(input, move |grid| renormalize(grid, &solver, &run), Filter::Normalize, WENO5)
}

fn whole_track<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let run = input.run.clone();
    same(input, move |grid| track(grid, &SolverOptions::OPENVDB, &run), Filter::Track, Tracker::default())
}

fn exact_offset<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let (voxel, run) = (input.level_set.voxel_size(), input.run.clone());
    GridContest::new(
        input,
        Judge::Truth { offset: 1.0 },
        Operation::new(move |grid| offset(grid, voxel, &run)),
        Operation::in_place(move |grid: &mut ReferenceGrid| {
            grid.apply(Filter::Offset(voxel as f32), &Tracker::default())
        }),
    )
}

fn csg_union<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let shifted = shifted(input.level_set)?;
    let reference = ReferenceGrid::from_level_set(&shifted)?;
    GridContest::new(
        input,
        Judge::Equal,
        Operation::new(move |grid| Ok(csg(grid, &shifted, CsgOperation::Union))),
        Operation::new(move |grid: &ReferenceGrid| grid.csg(&reference, Csg::Union)),
    )
}

fn exact_rebuild<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let run = input.run.clone();
    GridContest::new(
        input,
        Judge::Truth { offset: 0.0 },
        Operation::new(move |grid| rebuild(grid, &Rebuild::band(3.0), &run)),
        Operation::new(|grid: &ReferenceGrid| grid.rebuild(0.0, 3.0)),
    )
}

fn from_mesh<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let (voxel_size, half_width) = (input.level_set.voxel_size(), input.level_set.half_width());
    let mesh = match input.source {
        Some(mesh) => mesh.clone(),
        None => input.surface()?.clone(),
    };
    let (points, triangles): (Vec<Vec3>, _) =
        (mesh.positions.iter().map(|p| p.as_vec3()).collect(), mesh.triangles.clone());
    let (params, run) = (MeshToLevelSet { half_width, ..MeshToLevelSet::new(voxel_size) }, input.run.clone());
    let mut in_voxels = mesh.clone();
    in_voxels.positions.iter_mut().for_each(|p| *p /= voxel_size);
    GridContest::new(
        input,
        Judge::Mesh { mesh: in_voxels, tolerance: FROM_MESH },
        Operation::new(move |_| Ok(mesh_to_level_set(&mesh, &params, &run)?.0)),
        Operation::new(move |_: &ReferenceGrid| {
            ReferenceGrid::from_mesh(&points, &triangles, Transform::uniform(voxel_size), half_width)
        }),
    )
}

/// A copy half its size away, by whole voxels.
fn shifted(level_set: &LevelSet) -> Result<LevelSet> {
    let (lo, hi) = level_set.grid().active_bounds().unwrap_or_default();
    let steps = (hi - lo) / 2;
    let world = level_set.transform().to_world().matrix3 * steps.as_dvec3();
    let moved = level_set.moved(glam::DAffine3::from_translation(world));
    moved.ok().and_then(|m| m.renamed(level_set.transform())).ok_or_else(|| EditError::Unmet {
        operation: "crosscheck".into(),
        problem: "the level set could not be shifted by whole voxels".into(),
    })
}
