//! Our operators against OpenVDB's own tools on the same grids, with the tolerances of `crosscheck`'s table.
#![cfg(feature = "openvdb")]

use glam::{DVec3, IVec3};
use vdb_edit::LevelSet;
use vdb_edit::grid::Transform;
use vdb_edit::mesh::{MeshToLevelSet, mesh_to_level_set, read};
use vdb_edit::ops::csg::{CsgOperation, csg};
use vdb_edit::ops::smooth::{Smooth, SmoothMethod, smooth};
use vdb_edit::ops::{EvolutionOptions, Like, Scheme};
use vdb_edit::pde::{SolverOptions, UpwindScheme, WenoEpsilon, renormalize, track};
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::reference::{Csg, Filter, ReferenceGrid, ReferenceScheme, Tracker};

/// A sphere, a torus and two scanned models, none of them centred on a voxel.
fn subjects() -> Vec<(&'static str, LevelSet)> {
    let run = RunOptions::default();
    let sphere = LevelSet::from_distance(
        Transform::uniform(0.05),
        3.0,
        (IVec3::splat(-50), IVec3::splat(50)),
        |p| (p - DVec3::new(0.3, -0.2, 0.1)).length() - 40.0,
        &run,
    );
    let torus = LevelSet::from_distance(
        Transform::uniform(0.02),
        3.0,
        (IVec3::splat(-60), IVec3::splat(60)),
        |p| (p.x.hypot(p.y) - 40.3).hypot(p.z - 0.4) - 12.7,
        &run,
    );
    let model = |name: &str, voxels: f64| {
        let path = format!("{}/assets/{name}", env!("CARGO_MANIFEST_DIR"));
        let mesh = read(path.as_ref()).unwrap().mesh;
        let (lo, hi) = mesh.bounding_box().unwrap();
        let params = MeshToLevelSet::new((hi - lo).max_element() / voxels);
        mesh_to_level_set(&mesh, &params, &run).unwrap().0
    };
    vec![
        ("sphere", sphere.unwrap()),
        ("torus", torus.unwrap()),
        ("spot", model("spot.obj", 120.0)),
        ("goathead", model("goathead.obj", 100.0)),
    ]
}

/// Largest difference on voxels that both have active, in voxels, and the number of voxels active in one only.
fn difference(a: &LevelSet, b: &LevelSet) -> (f64, u64) {
    let mut worst = 0f64;
    let mut only = 0u64;
    let mut other = b.grid().accessor();
    for &id in a.grid().leaves() {
        for offset in a.grid().mask(id).iter() {
            let ijk = a.grid().origin(id) + vdb_edit::grid::offset_to_local(offset);
            if other.is_active(ijk) {
                worst = worst.max(f64::from(a.grid().values(id).0[offset] - other.value(ijk)).abs() / a.voxel_size());
            } else {
                only += 1;
            }
        }
    }
    // What is left of b's active voxels has no partner in a.
    let common = a.grid().active_voxels() - only;
    (worst, only + (b.grid().active_voxels() - common))
}

fn assert_same(name: &str, ours: &LevelSet, theirs: &LevelSet, tolerance: f64) {
    let (worst, active) = difference(ours, theirs);
    println!("{name}: {worst:.2e} voxels, {active} active voxels differ");
    assert!(worst <= tolerance, "{name}: {worst} voxels");
    assert_eq!(active, 0, "{name}: active voxels");
}

fn reference(level_set: &LevelSet, filter: Filter, tracker: Tracker) -> LevelSet {
    let mut grid = ReferenceGrid::from_level_set(level_set).unwrap();
    grid.apply(filter, &tracker).unwrap();
    grid.to_level_set().unwrap()
}

const FIRST: Tracker = Tracker { scheme: ReferenceScheme::First, runge_kutta: 1, normalizations: 1 };

fn smoothed(level_set: &LevelSet, method: SmoothMethod, evolution: EvolutionOptions) -> LevelSet {
    let mut ours = level_set.clone();
    smooth(&mut ours, &Smooth { method, evolution }, &RunOptions::default()).unwrap();
    ours
}

#[test]
fn curvature_and_laplacian_steps_with_track() {
    let first = EvolutionOptions { iterations: Some(1), scheme: Some(Scheme::First), ..EvolutionOptions::default() };
    let like = EvolutionOptions { iterations: Some(1), like: Some(Like::OpenVdb), ..EvolutionOptions::default() };
    for (name, level_set) in subjects() {
        let ours = smoothed(&level_set, SmoothMethod::Curvature, first.clone());
        assert_same(name, &ours, &reference(&level_set, Filter::MeanCurvature(1), FIRST), 1e-5);
        let ours = smoothed(&level_set, SmoothMethod::Laplacian, first.clone());
        assert_same(name, &ours, &reference(&level_set, Filter::Laplacian(1), FIRST), 1e-5);
        let ours = smoothed(&level_set, SmoothMethod::Curvature, like.clone());
        assert_same(name, &ours, &reference(&level_set, Filter::MeanCurvature(1), Tracker::default()), 1e-5);
    }
}

#[test]
fn renormalisation_and_track() {
    let run = RunOptions::default();
    for (name, level_set) in subjects() {
        // A field that is no distance any more: renormalisation has something to do.
        let bumpy = smoothed(
            &level_set,
            SmoothMethod::Laplacian,
            EvolutionOptions { iterations: Some(3), normalizations: Some(0), ..EvolutionOptions::default() },
        );
        for order in 1..=3 {
            for (scheme, reference_scheme) in
                [(UpwindScheme::First, ReferenceScheme::First), (UpwindScheme::HjWeno5, ReferenceScheme::HjWeno5)]
            {
                let integrator = [
                    vdb_edit::pde::TimeIntegrator::TvdRk1,
                    vdb_edit::pde::TimeIntegrator::TvdRk2,
                    vdb_edit::pde::TimeIntegrator::TvdRk3,
                ][order - 1];
                let solver =
                    SolverOptions { scheme, integrator, normalizations: 1, weno_epsilon: WenoEpsilon::OPENVDB };
                let theirs = Tracker { scheme: reference_scheme, runge_kutta: order as u32, normalizations: 1 };
                let mut ours = bumpy.clone();
                renormalize(&mut ours, &solver, &run).unwrap();
                assert_same(name, &ours, &reference(&bumpy, Filter::Normalize, theirs), 1e-5);
                let mut ours = bumpy.clone();
                track(&mut ours, &solver, &run).unwrap();
                assert_same(name, &ours, &reference(&bumpy, Filter::Track, theirs), 1e-5);
            }
        }
        let mut ours = bumpy.clone();
        track(&mut ours, &SolverOptions::OPENVDB, &run).unwrap();
        assert_same(name, &ours, &reference(&bumpy, Filter::Track, Tracker::default()), 1e-5);
    }
}

#[test]
fn csg_is_the_same_to_the_last_bit() {
    for (name, a) in subjects() {
        // Half its size away.
        let (lo, hi) = a.grid().active_bounds().unwrap();
        let shift = (hi - lo).as_dvec3() * a.voxel_size() / 2.0;
        let whole = (shift / a.voxel_size()).round() * a.voxel_size();
        let b = a.moved(glam::DAffine3::from_translation(whole)).unwrap().renamed(a.transform()).unwrap();
        let (ra, rb) = (ReferenceGrid::from_level_set(&a).unwrap(), ReferenceGrid::from_level_set(&b).unwrap());
        for (ours, theirs) in [
            (CsgOperation::Union, Csg::Union),
            (CsgOperation::Intersection, Csg::Intersection),
            (CsgOperation::Difference, Csg::Difference),
        ] {
            let result = csg(&a, &b, ours);
            let reference = ra.csg(&rb, theirs).unwrap().to_level_set().unwrap();
            assert_same(&format!("{name} {ours:?}"), &result, &reference, 0.0);
            // Signs away from the band as well.
            let mut there = reference.grid().accessor();
            for i in 0..20_000i32 {
                let ijk = lo + (hi - lo) * 3 / 2 * IVec3::new(i % 27, i / 27 % 27, i / 729) / 27;
                assert_eq!(result.grid().voxel(ijk).0 < 0.0, there.value(ijk) < 0.0, "{name} {ours:?} {ijk}");
            }
        }
    }
}
