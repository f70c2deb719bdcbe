//! The table of rows: operators, schemes and tolerances are fixed, so that figures of different grids and days compare.

use glam::Vec3;

use super::Input;
use super::contest::{Contest, GridContest, Judge, Operation};
use super::files::{Reading, Writing};
use super::polygons::Polygonising;
use crate::error::{EditError, Result};
use crate::grid::{Transform, offset_to_local};
use crate::levelset::{LevelSet, sweep_distance};
use crate::mesh::{MeshToLevelSet, Rebuild, mesh_to_level_set, rebuild};
use crate::ops::csg::{CsgOperation, csg};
use crate::ops::morphology::offset;
use crate::ops::smooth::{Smooth, SmoothMethod, smooth};
use crate::ops::{EvolutionOptions, Like, RegionSpecs, Scheme};
use crate::pde::{
    self, MorphOptions, SolverOptions, Until, UpwindScheme, WenoEpsilon, morph_towards, renormalize, track,
};
use crate::region::Primitive;
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

const FILTER: &str = "width 1, HJ-WENO5, RK1, 3";

/// All rows, in order.
pub(super) const CASES: &[Case] = &[
    Case { operator: "mean-curvature", scheme: FIRST_STEP, tolerance: 1e-5, contest: mean_curvature },
    Case {
        operator: "masked-mean-curvature",
        scheme: "8 % of the surface, one step and track, first order, RK1, 1; compared where the weight is 1, five voxels inside",
        tolerance: 1e-5,
        contest: masked_mean_curvature,
    },
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
    Case { operator: "offset-pde", scheme: "one voxel, HJ-WENO5, RK1, 3", tolerance: 1e-4, contest: offset_by_flow },
    Case {
        operator: "offset",
        scheme: "one voxel: exact, against HJ-WENO5, RK1, 3",
        tolerance: 0.05,
        contest: exact_offset,
    },
    Case { operator: "gaussian", scheme: FILTER, tolerance: 1e-4, contest: gaussian },
    Case { operator: "mean", scheme: FILTER, tolerance: 1e-4, contest: mean },
    Case { operator: "median", scheme: FILTER, tolerance: 1e-4, contest: median },
    Case {
        operator: "morph",
        scheme: "towards a copy one voxel larger, time 1, HJ-WENO5, RK2; track HJ-WENO5, RK1, 3",
        tolerance: 1e-3,
        contest: morph,
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
        operator: "sweep",
        scheme: "distances again in the same band, first order, against sdfToSdf",
        tolerance: 0.5,
        contest: sweep,
    },
    Case {
        operator: "sweep-outwards",
        scheme: "band three voxels wider, first order, against dilateSdf",
        tolerance: 1.0,
        contest: sweep_outwards,
    },
    Case {
        operator: "mesh-to-level-set",
        scheme: "half width of the input, closed; both against the mesh",
        tolerance: FROM_MESH,
        contest: from_mesh,
    },
    Case {
        operator: "level-set-to-mesh",
        scheme: "against volumeToMesh, adaptivity 0; distance of its vertices",
        tolerance: 1.0,
        contest: |input| Polygonising::boxed(input),
    },
    Case { operator: "read", scheme: "blosc, float", tolerance: 0.0, contest: |input| Reading::boxed(input) },
    Case {
        operator: "write",
        scheme: "blosc, float; ours flushed and verified",
        tolerance: 0.0,
        contest: |input| Writing::boxed(input),
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
    GridContest::boxed(input, Judge::Equal, Operation::in_place(ours), theirs)
}

/// One step of a smoothing flow, or one application of a filter.
fn flow<'a>(
    input: &'a Input<'a>,
    method: SmoothMethod,
    evolution: EvolutionOptions,
    filter: Filter,
    tracker: Tracker,
) -> Sides<'a> {
    let evolution = EvolutionOptions { iterations: Some(1), ..evolution };
    let (params, run) = (Smooth { method, evolution, ..Smooth::default() }, input.run.clone());
    same(input, move |grid| smooth(grid, &params, &run).map(drop), filter, tracker)
}

fn first_order() -> EvolutionOptions {
    EvolutionOptions { scheme: Some(Scheme::First), ..EvolutionOptions::default() }
}

fn mean_curvature<'a>(input: &'a Input<'a>) -> Sides<'a> {
    flow(input, SmoothMethod::Curvature, first_order(), Filter::MeanCurvature(1), FIRST)
}

/// The part of the surface that a masked row works on.
const MASKED: f64 = 0.08;

/// In a sphere around the highest voxel. OpenVDB renormalises everywhere, ours where the region acts.
fn masked_mean_curvature<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let (grid, transform) = (input.level_set.grid(), *input.level_set.transform());
    let mut voxels = Vec::new();
    for &id in grid.leaves() {
        voxels.extend(grid.mask(id).iter().map(|o| transform.voxel_to_world(grid.origin(id) + offset_to_local(o))));
    }
    let Some(&centre) = voxels.iter().max_by(|a, b| a.z.total_cmp(&b.z)) else {
        return Err(EditError::parameter("crosscheck", "only", "masked-mean-curvature", "a level set with a surface"));
    };
    let mut distances: Vec<f64> = voxels.iter().map(|voxel| voxel.distance(centre)).collect();
    distances.sort_by(f64::total_cmp);
    let radius = distances[(distances.len() as f64 * MASKED) as usize];
    let spec = format!("sphere center={},{},{} radius={radius}", centre.x, centre.y, centre.z);
    let evolution = EvolutionOptions { iterations: Some(1), region: RegionSpecs(vec![spec]), ..first_order() };
    let region = evolution.region.on(input.level_set, input.run)?;
    let mut weights = input.level_set.clone();
    weights.grid_mut().update_all(|id, values, _| {
        let origin = grid.origin(id);
        for (offset, value) in values.0.iter_mut().enumerate() {
            let xyz = transform.voxel_to_world(origin + offset_to_local(offset));
            *value = region.as_ref().map_or(1.0, |region| region.weight(xyz));
        }
    });
    let weights = ReferenceGrid::from_level_set(&weights)?;
    let inside = Primitive::DEFAULT_SOFT[0] * radius - 5.0 * transform.voxel_size();
    let counts = move |ijk| transform.voxel_to_world(ijk).distance(centre) < inside;
    let (params, run) = (Smooth { evolution, ..Smooth::default() }, input.run.clone());
    GridContest::boxed(
        input,
        Judge::EqualAt(Box::new(counts)),
        Operation::in_place(move |grid| smooth(grid, &params, &run).map(drop)),
        Operation::in_place(move |grid: &mut ReferenceGrid| grid.mean_curvature_masked(&weights, &FIRST)),
    )
}

fn laplacian<'a>(input: &'a Input<'a>) -> Sides<'a> {
    flow(input, SmoothMethod::Laplacian, first_order(), Filter::Laplacian(1), FIRST)
}

fn like_openvdb() -> EvolutionOptions {
    EvolutionOptions { like: Some(Like::OpenVdb), ..EvolutionOptions::default() }
}

fn mean_curvature_default<'a>(input: &'a Input<'a>) -> Sides<'a> {
    flow(input, SmoothMethod::Curvature, like_openvdb(), Filter::MeanCurvature(1), Tracker::default())
}

fn gaussian<'a>(input: &'a Input<'a>) -> Sides<'a> {
    flow(input, SmoothMethod::Gaussian, like_openvdb(), Filter::Gaussian(1), Tracker::default())
}

fn mean<'a>(input: &'a Input<'a>) -> Sides<'a> {
    flow(input, SmoothMethod::Mean, like_openvdb(), Filter::Mean(1), Tracker::default())
}

fn median<'a>(input: &'a Input<'a>) -> Sides<'a> {
    flow(input, SmoothMethod::Median, like_openvdb(), Filter::Median(1), Tracker::default())
}

fn offset_by_flow<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let (voxel, run) = (input.level_set.voxel_size(), input.run.clone());
    same(
        input,
        move |grid| pde::offset(grid, voxel, None, &SolverOptions::OPENVDB, &run).map(drop),
        Filter::Offset(voxel as f32),
        Tracker::default(),
    )
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
    GridContest::boxed(
        input,
        Judge::Truth { offset: 1.0 },
        Operation::new(move |grid| offset(grid, voxel, &run)),
        Operation::in_place(move |grid: &mut ReferenceGrid| {
            grid.apply(Filter::Offset(voxel as f32), &Tracker::default())
        }),
    )
}

fn morph<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let target = offset(input.level_set, input.level_set.voxel_size(), input.run)?;
    let reference = ReferenceGrid::from_level_set(&target)?;
    let run = input.run.clone();
    let ours = move |grid: &mut LevelSet| {
        morph_towards(grid, &target, None, Until::Time(1.0), &MorphOptions::OPENVDB, &run).map(drop)
    };
    let theirs = move |grid: &mut ReferenceGrid| {
        grid.morph(&reference, 1.0, ReferenceScheme::HjWeno5, 2, &Tracker::default()).map(drop)
    };
    GridContest::boxed(input, Judge::Equal, Operation::in_place(ours), Operation::in_place(theirs))
}

fn csg_union<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let shifted = shifted(input.level_set)?;
    let (reference, run) = (ReferenceGrid::from_level_set(&shifted)?, input.run.clone());
    GridContest::boxed(
        input,
        Judge::Equal,
        Operation::new(move |grid| csg(grid, &[&shifted], CsgOperation::Union, &run)),
        Operation::new(move |grid: &ReferenceGrid| grid.csg(&reference, Csg::Union)),
    )
}

fn exact_rebuild<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let run = input.run.clone();
    GridContest::boxed(
        input,
        Judge::Truth { offset: 0.0 },
        Operation::new(move |grid| rebuild(grid, &Rebuild::band(3.0), &run)),
        Operation::new(|grid: &ReferenceGrid| grid.rebuild(0.0, 3.0)),
    )
}

fn sweep<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let (half_width, run) = (input.level_set.half_width(), input.run.clone());
    GridContest::boxed(
        input,
        Judge::Truth { offset: 0.0 },
        Operation::new(move |grid| sweep_distance(grid, half_width, &run)),
        Operation::new(|grid: &ReferenceGrid| grid.sweep(1)),
    )
}

fn sweep_outwards<'a>(input: &'a Input<'a>) -> Sides<'a> {
    let (half_width, run) = (input.level_set.half_width() + 3.0, input.run.clone());
    GridContest::boxed(
        input,
        Judge::Truth { offset: 0.0 },
        Operation::new(move |grid| sweep_distance(grid, half_width, &run)),
        Operation::new(|grid: &ReferenceGrid| grid.sweep_outwards(3, 1)),
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
    GridContest::boxed(
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
