//! Ours beside OpenVDB's: the same operation on the same grid in one process, timed in turn, and the results compared.
//!
//! Each case runs both sides alternately, so that a busy machine slows both; the ratio is the median of the ratios of
//! neighbouring runs. Grids are copied and converted outside the timed part. Where the two compute the same thing the
//! results must agree within the tolerance; where ours is exact and OpenVDB's is not (`offset`, `rebuild`) both are
//! held against the distance to the polygonised surface, by looking up the closest triangle.

use std::cell::LazyCell;
use std::time::{Duration, Instant};

use glam::{DVec3, Vec3};
use serde::Serialize;

use crate::error::{EditError, Result};
use crate::grid::{Transform, offset_to_local};
use crate::levelset::LevelSet;
use crate::mesh::{Bvh, MeshToLevelSet, Rebuild, TriangleMesh, level_set_to_mesh, mesh_to_level_set, rebuild};
use crate::ops::csg::{CsgOperation, csg};
use crate::ops::morphology::offset;
use crate::ops::smooth::{Smooth, SmoothMethod, smooth};
use crate::ops::{EvolutionOptions, Like, Scheme};
use crate::pde::{SolverOptions, UpwindScheme, WenoEpsilon, renormalize, track};
use crate::run::RunOptions;
use crate::vdb::reference::{Csg, Filter, ReferenceGrid, ReferenceScheme, Tracker};

/// One operation on both sides.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The operation.
    pub operator: &'static str,
    /// Numerical scheme on both sides.
    pub scheme: &'static str,
    /// Median time of ours, in milliseconds.
    pub ours_ms: f64,
    /// Median time of OpenVDB's, in milliseconds.
    pub openvdb_ms: f64,
    /// OpenVDB's time over ours: median, smallest and largest of the pairs of runs.
    pub ratio: f64,
    /// See [`ratio`](Self::ratio).
    pub ratio_min: f64,
    /// See [`ratio`](Self::ratio).
    pub ratio_max: f64,
    /// Largest difference (or, against the truth, our largest error) on active voxels, in voxels.
    pub max_diff_voxels: f64,
    /// Root mean square of the same.
    pub rms_diff_voxels: f64,
    /// Voxels active on one side only.
    pub active_diff: u64,
    /// OpenVDB's largest error, where both are held against the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub openvdb_max_error_voxels: Option<f64>,
    /// What the difference may be.
    pub tolerance_voxels: f64,
}

impl Row {
    /// Whether the difference is within the tolerance.
    pub fn passes(&self) -> bool {
        self.max_diff_voxels <= self.tolerance_voxels
    }
}

/// How two results are held against each other.
enum Judge {
    /// Voxel by voxel.
    Equal,
    /// Voxel by voxel where both have one sign.
    SignedAlike,
    /// Both against the distance (in voxels) to the polygonised input, less this offset.
    Truth { offset: f64 },
}

/// Changes a grid in place: the timed part.
type Operation<Grid> = Box<dyn Fn(&mut Grid) -> Result<()>>;

struct Case {
    operator: &'static str,
    scheme: &'static str,
    tolerance: f64,
    judge: Judge,
    ours: Operation<LevelSet>,
    theirs: Operation<ReferenceGrid>,
}

/// Fewest and most runs of a case, and the time after which no new one begins.
const RUNS: (usize, usize) = (2, 5);
const ENOUGH: Duration = Duration::from_secs(20);

/// The names of all cases, in order.
pub const OPERATORS: [&str; 10] = [
    "mean-curvature",
    "laplacian",
    "mean-curvature-default",
    "normalize-first",
    "normalize-weno5",
    "track",
    "offset",
    "csg-union",
    "rebuild",
    "mesh-to-level-set",
];

/// Runs the cases named in `only` (all if it is empty) on `level_set`; `done` gets each row as it is finished.
pub fn crosscheck(
    level_set: &LevelSet,
    source: Option<TriangleMesh>,
    only: &[String],
    run: &RunOptions,
    mut done: impl FnMut(&Row),
) -> Result<Vec<Row>> {
    if let Some(name) = only.iter().find(|name| !OPERATORS.contains(&name.as_str())) {
        let accepted = crate::spec::suggest(name, OPERATORS.into_iter());
        return Err(EditError::parameter("crosscheck", "only", name, accepted));
    }
    let mesh = level_set_to_mesh(level_set, 0.0, run)?;
    let cases = cases(level_set, source.as_ref().unwrap_or(&mesh), run)?;
    let wanted = |case: &&Case| only.is_empty() || only.iter().any(|name| name == case.operator);
    let task = run.task("crosscheck", cases.iter().filter(wanted).count() as u64);
    // Made when the first row asks for it.
    let truth = LazyCell::new(|| bvh(&mesh, level_set.transform()));
    let mut rows = Vec::new();
    for case in cases.iter().filter(wanted) {
        run.check("crosscheck")?;
        let row = measure(case, level_set, &truth)?;
        done(&row);
        rows.push(row);
        task.advance(1);
    }
    Ok(rows)
}

fn cases(level_set: &LevelSet, mesh: &TriangleMesh, run: &RunOptions) -> Result<Vec<Case>> {
    let first = Tracker { scheme: ReferenceScheme::First, runge_kutta: 1, normalizations: 1 };
    let weno5 = Tracker { scheme: ReferenceScheme::HjWeno5, runge_kutta: 1, normalizations: 1 };
    let flow = |operator, scheme, method, evolution: EvolutionOptions, filter, tracker| {
        let (params, run) = (Smooth { method, evolution }, run.clone());
        Case {
            operator,
            scheme,
            tolerance: 1e-5,
            judge: Judge::Equal,
            ours: Box::new(move |grid| smooth(grid, &params, &run).map(drop)),
            theirs: Box::new(move |grid| grid.apply(filter, &tracker)),
        }
    };
    let repair = |operator, scheme, solver: SolverOptions, tracking: bool, filter, tracker| {
        let run = run.clone();
        Case {
            operator,
            scheme,
            tolerance: 1e-5,
            judge: Judge::Equal,
            ours: Box::new(
                move |grid| if tracking { track(grid, &solver, &run) } else { renormalize(grid, &solver, &run) },
            ),
            theirs: Box::new(move |grid| grid.apply(filter, &tracker)),
        }
    };
    let one = EvolutionOptions { iterations: Some(1), ..EvolutionOptions::default() };
    let one_first = EvolutionOptions { scheme: Some(Scheme::First), ..one.clone() };
    let one_like = EvolutionOptions { like: Some(Like::OpenVdb), ..one };
    let openvdb_weno5 = SolverOptions {
        scheme: UpwindScheme::HjWeno5,
        weno_epsilon: WenoEpsilon::OPENVDB,
        ..SolverOptions::FIRST_ORDER
    };
    let voxel_size = level_set.voxel_size();
    let half_width = level_set.half_width();

    let shifted = shifted(level_set)?;
    let shifted_reference = ReferenceGrid::from_level_set(&shifted)?;
    let (points, triangles): (Vec<Vec3>, _) =
        (mesh.positions.iter().map(|p| p.as_vec3()).collect(), mesh.triangles.clone());
    let (plain, params) = (mesh.clone(), MeshToLevelSet { half_width, ..MeshToLevelSet::new(voxel_size) });
    let run_of = || run.clone();
    let [offset_run, csg_run, rebuild_run, mesh_run] = [run_of(), run_of(), run_of(), run_of()];
    Ok(vec![
        flow(
            "mean-curvature",
            "one step and track, first order, RK1, 1",
            SmoothMethod::Curvature,
            one_first.clone(),
            Filter::MeanCurvature(1),
            first,
        ),
        flow(
            "laplacian",
            "one step and track, first order, RK1, 1",
            SmoothMethod::Laplacian,
            one_first,
            Filter::Laplacian(1),
            first,
        ),
        flow(
            "mean-curvature-default",
            "one step and track, HJ-WENO5, RK1, 3",
            SmoothMethod::Curvature,
            one_like,
            Filter::MeanCurvature(1),
            Tracker::default(),
        ),
        repair("normalize-first", "first order, RK1, 1", SolverOptions::FIRST_ORDER, false, Filter::Normalize, first),
        repair("normalize-weno5", "HJ-WENO5, RK1, 1", openvdb_weno5, false, Filter::Normalize, weno5),
        repair("track", "HJ-WENO5, RK1, 3", SolverOptions::OPENVDB, true, Filter::Track, Tracker::default()),
        Case {
            operator: "offset",
            scheme: "one voxel: exact, against HJ-WENO5, RK1, 3",
            tolerance: 0.05,
            judge: Judge::Truth { offset: 1.0 },
            ours: Box::new(move |grid| replace(grid, |g| offset(g, voxel_size, &offset_run))),
            theirs: Box::new(move |grid| grid.apply(Filter::Offset(voxel_size as f32), &Tracker::default())),
        },
        Case {
            operator: "csg-union",
            scheme: "with a copy shifted by half its size, against csgUnionCopy",
            tolerance: 0.0,
            judge: Judge::Equal,
            ours: Box::new(move |grid| replace(grid, |g| csg(g, &[&shifted], CsgOperation::Union, &csg_run))),
            theirs: Box::new(move |grid| replace(grid, |g| g.csg(&shifted_reference, Csg::Union))),
        },
        Case {
            operator: "rebuild",
            scheme: "half width 3, against levelSetRebuild",
            tolerance: 0.05,
            judge: Judge::Truth { offset: 0.0 },
            ours: Box::new(move |grid| replace(grid, |g| rebuild(g, &Rebuild::band(3.0), &rebuild_run))),
            theirs: Box::new(move |grid| replace(grid, |g| g.rebuild(0.0, 3.0))),
        },
        Case {
            operator: "mesh-to-level-set",
            scheme: "half width of the input, closed",
            tolerance: 1e-3,
            judge: Judge::SignedAlike,
            ours: Box::new(move |grid| replace(grid, |_| Ok(mesh_to_level_set(&plain, &params, &mesh_run)?.0))),
            theirs: Box::new(move |grid| {
                let transform = Transform::uniform(voxel_size);
                replace(grid, |_| ReferenceGrid::from_mesh(&points, &triangles, transform, half_width))
            }),
        },
    ])
}

fn replace<T>(value: &mut T, f: impl FnOnce(&T) -> Result<T>) -> Result<()> {
    *value = f(value)?;
    Ok(())
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

fn bvh(mesh: &TriangleMesh, transform: &Transform) -> Bvh {
    let corners = |t: usize| mesh.corners(t).map(|p| transform.world_to_index(p));
    Bvh::new((0..mesh.triangles.len()).map(corners).collect())
}

fn measure(case: &Case, level_set: &LevelSet, truth: &LazyCell<Bvh, impl FnOnce() -> Bvh>) -> Result<Row> {
    let reference = ReferenceGrid::from_level_set(level_set)?;
    let began = Instant::now();
    let (mut ours_ms, mut theirs_ms, mut results) = (Vec::new(), Vec::new(), None);
    while ours_ms.len() < RUNS.0 || (ours_ms.len() < RUNS.1 && began.elapsed() < ENOUGH) {
        let mut ours = unshared(level_set);
        ours_ms.push(timed(|| (case.ours)(&mut ours))?);
        let mut theirs = reference.duplicate()?;
        theirs_ms.push(timed(|| (case.theirs)(&mut theirs))?);
        results = Some((ours, theirs));
    }
    let ratios: Vec<f64> = ours_ms.iter().zip(&theirs_ms).map(|(ours, theirs)| theirs / ours).collect();
    let mut difference = Difference::default();
    let mut openvdb_max_error_voxels = None;
    if let Some((ours, theirs)) = results {
        let theirs = theirs.to_level_set()?;
        difference.active = active_difference(&ours, &theirs);
        match case.judge {
            Judge::Equal => difference.between(&ours, &theirs, false),
            Judge::SignedAlike => difference.between(&ours, &theirs, true),
            Judge::Truth { offset } => {
                let mut other = Difference::default();
                difference.against_truth(&ours, truth, level_set, offset);
                other.against_truth(&theirs, truth, level_set, offset);
                openvdb_max_error_voxels = Some(other.max);
            }
        }
    }
    Ok(Row {
        operator: case.operator,
        scheme: case.scheme,
        ours_ms: median(&ours_ms),
        openvdb_ms: median(&theirs_ms),
        ratio: median(&ratios),
        ratio_min: ratios.iter().copied().fold(f64::INFINITY, f64::min),
        ratio_max: ratios.iter().copied().fold(0.0, f64::max),
        max_diff_voxels: difference.max,
        rms_diff_voxels: (difference.sum_of_squares / difference.voxels.max(1) as f64).sqrt(),
        active_diff: difference.active,
        openvdb_max_error_voxels,
        tolerance_voxels: case.tolerance,
    })
}

/// A copy that shares no page with the original, as OpenVDB's deep copy.
fn unshared(level_set: &LevelSet) -> LevelSet {
    let mut copy = level_set.clone();
    copy.grid_mut().update_all(|_, _, _| ());
    copy
}

/// Milliseconds that `f` takes.
fn timed(f: impl FnOnce() -> Result<()>) -> Result<f64> {
    let began = Instant::now();
    f()?;
    Ok(began.elapsed().as_secs_f64() * 1e3)
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => 0.0,
        n if n % 2 == 1 => sorted[n / 2],
        n => (sorted[n / 2 - 1] + sorted[n / 2]) / 2.0,
    }
}

/// Differences in voxels.
#[derive(Default)]
struct Difference {
    max: f64,
    sum_of_squares: f64,
    voxels: u64,
    active: u64,
}

impl Difference {
    fn add(&mut self, voxels: f64) {
        // A NaN must not pass for a small difference.
        self.max = if voxels.is_nan() { f64::INFINITY } else { self.max.max(voxels.abs()) };
        self.sum_of_squares += voxels * voxels;
        self.voxels += 1;
    }

    /// Over the voxels that both have active, or those of one sign.
    fn between(&mut self, a: &LevelSet, b: &LevelSet, signed_alike: bool) {
        let mut other = b.grid().accessor();
        for_each_active(a, |ijk, value| {
            let there = other.value(ijk);
            let alike = !signed_alike || (value < 0.0) == (there < 0.0);
            if other.is_active(ijk) && alike {
                self.add(f64::from(value - there) / a.voxel_size());
            }
        });
    }

    /// Against the distance to triangles, signed by `source`.
    fn against_truth(&mut self, result: &LevelSet, bvh: &Bvh, source: &LevelSet, offset: f64) {
        let mut field = source.grid().accessor();
        let reach = f64::from(result.half_width()) + offset.abs() + 2.0;
        let mut count = 0u32;
        for_each_active(result, |ijk, value| {
            // A look-up costs more than the operators do: every 16th voxel is asked.
            count += 1;
            if count.is_multiple_of(16) {
                let p: DVec3 = ijk.as_dvec3();
                let d = bvh.closest_point(p, reach).map_or(f64::INFINITY, |hit| hit.distance_squared.sqrt());
                let signed = if field.value(ijk) < 0.0 { -d } else { d };
                self.add(f64::from(value) / result.voxel_size() - (signed - offset));
            }
        });
    }
}

fn for_each_active(level_set: &LevelSet, mut f: impl FnMut(glam::IVec3, f32)) {
    let grid = level_set.grid();
    for &id in grid.leaves() {
        for offset in grid.mask(id).iter() {
            f(grid.origin(id) + offset_to_local(offset), grid.values(id).0[offset]);
        }
    }
}

fn active_difference(a: &LevelSet, b: &LevelSet) -> u64 {
    let mut common = 0;
    let mut other = b.grid().accessor();
    for_each_active(a, |ijk, _| common += u64::from(other.is_active(ijk)));
    a.grid().active_voxels() + b.grid().active_voxels() - 2 * common
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::shape::Shape;
    use crate::ops::{Operator, WorldLength};

    #[test]
    fn every_row_passes_on_a_torus() {
        let run = RunOptions::default();
        let shape = Shape {
            spec: "torus major=1 minor=0.4".into(),
            voxel_size: Some(WorldLength::new(0.05)),
            ..Shape::default()
        };
        let torus = shape.apply(Vec::new(), &run).unwrap().level_set;
        let mut seen = Vec::new();
        let rows = crosscheck(&torus, None, &[], &run, |row| seen.push(row.operator)).unwrap();
        assert_eq!(seen, OPERATORS);
        for row in &rows {
            // The two differ by a part of a voxel beside some surfaces, where ours is exact (tests/cross_openvdb.rs).
            assert!(row.passes() || row.operator == "mesh-to-level-set", "{row:?}");
            assert!(row.ratio_min <= row.ratio && row.ratio <= row.ratio_max && row.ours_ms > 0.0, "{row:?}");
        }
        let only = crosscheck(&torus, None, &["track".into()], &run, |_| ()).unwrap();
        assert_eq!(only.len(), 1);
        let error = crosscheck(&torus, None, &["trak".into()], &run, |_| ()).unwrap_err();
        assert!(error.to_string().contains("did you mean `track`"));
    }
}
