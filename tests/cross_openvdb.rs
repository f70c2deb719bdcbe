//! Our operators against OpenVDB's own tools on the same grids, with the tolerances of `crosscheck`'s table.
#![cfg(feature = "openvdb")]

use glam::{DVec3, IVec3};
use vdb_edit::LevelSet;
use vdb_edit::grid::Transform;
use vdb_edit::mesh::{
    Bvh, MeshToLevelSet, Rebuild, TriangleMesh, WindingNumber, level_set_to_mesh, mesh_to_level_set, read, rebuild,
};
use vdb_edit::ops::csg::{CsgOperation, csg};
use vdb_edit::ops::morphology::offset;
use vdb_edit::ops::smooth::{Smooth, SmoothMethod, smooth};
use vdb_edit::ops::{EvolutionOptions, Like, Scheme};
use vdb_edit::pde::{self, SolverOptions, UpwindScheme, WenoEpsilon, renormalize, track};
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::reference::{Csg, Filter, ReferenceGrid, ReferenceMesh, ReferenceScheme, Tracker};

/// The name of a subject and its distance function, in voxels.
type Exact = (&'static str, fn(DVec3) -> f64);

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
    smooth(&mut ours, &Smooth { method, evolution, ..Smooth::default() }, &RunOptions::default()).unwrap();
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
fn filters_with_track() {
    let first =
        EvolutionOptions { scheme: Some(Scheme::First), normalizations: Some(1), ..EvolutionOptions::default() };
    let like = EvolutionOptions { like: Some(Like::OpenVdb), ..EvolutionOptions::default() };
    for (name, level_set) in subjects() {
        for (method, width, filter) in [
            (SmoothMethod::Mean, 1, Filter::Mean(1)),
            (SmoothMethod::Mean, 3, Filter::Mean(3)),
            (SmoothMethod::Gaussian, 1, Filter::Gaussian(1)),
            (SmoothMethod::Median, 1, Filter::Median(1)),
            (SmoothMethod::Median, 2, Filter::Median(2)),
        ] {
            for (evolution, tracker) in [(&first, FIRST), (&like, Tracker::default())] {
                let params = Smooth { method, width: Some(width), evolution: evolution.clone(), ..Smooth::default() };
                let mut ours = level_set.clone();
                smooth(&mut ours, &params, &RunOptions::default()).unwrap();
                let name = format!("{name} {filter:?}");
                assert_same(&name, &ours, &reference(&level_set, filter, tracker), 1e-4);
            }
        }
    }
}

#[test]
fn offsets_by_the_flow() {
    for (name, level_set) in subjects() {
        for voxels in [1.0, -1.0, 0.7] {
            let distance = voxels * level_set.voxel_size();
            let mut ours = level_set.clone();
            pde::offset(&mut ours, distance, None, &SolverOptions::OPENVDB, &RunOptions::default()).unwrap();
            let theirs = reference(&level_set, Filter::Offset(distance as f32), Tracker::default());
            assert_same(&format!("{name} {voxels}"), &ours, &theirs, 1e-4);
        }
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

/// Two and three operands; three at once as OpenVDB's two after each other.
#[test]
fn csg_is_the_same_to_the_last_bit() {
    for (name, a) in subjects() {
        // Half its size away, along the diagonal and along x.
        let (lo, hi) = a.grid().active_bounds().unwrap();
        let moved = |shift: DVec3| {
            let whole = (shift / 2.0).round() * a.voxel_size();
            a.moved(glam::DAffine3::from_translation(whole)).unwrap().renamed(a.transform()).unwrap()
        };
        let size = (hi - lo).as_dvec3();
        let (b, c) = (moved(size), moved(size.with_y(0.0).with_z(3.0)));
        let [ra, rb, rc] = [&a, &b, &c].map(|level_set| ReferenceGrid::from_level_set(level_set).unwrap());
        for (ours, theirs) in [
            (CsgOperation::Union, Csg::Union),
            (CsgOperation::Intersection, Csg::Intersection),
            (CsgOperation::Difference, Csg::Difference),
        ] {
            let of_two = ra.csg(&rb, theirs).unwrap();
            let of_three = of_two.csg(&rc, theirs).unwrap();
            for (others, reference) in [(&[&b][..], of_two), (&[&b, &c], of_three)] {
                let name = format!("{name} {ours:?} of {}", 1 + others.len());
                let result = csg(&a, others, ours, &RunOptions::default()).unwrap();
                let reference = reference.to_level_set().unwrap();
                assert_same(&name, &result, &reference, 0.0);
                // Signs away from the band as well.
                let mut there = reference.grid().accessor();
                for i in 0..20_000i32 {
                    let ijk = lo + (hi - lo) * 3 / 2 * IVec3::new(i % 27, i / 27 % 27, i / 729) / 27;
                    assert_eq!(result.grid().voxel(ijk).0 < 0.0, there.value(ijk) < 0.0, "{name} {ijk}");
                }
            }
        }
    }
}

/// Distance in voxels, at a position in index space, to the surface of the first two subjects.
fn sphere_distance(p: DVec3) -> f64 {
    (p - DVec3::new(0.3, -0.2, 0.1)).length() - 40.0
}

fn torus_distance(p: DVec3) -> f64 {
    (p.x.hypot(p.y) - 40.3).hypot(p.z - 0.4) - 12.7
}

/// Largest error of the voxels within `reach` voxels of the surface, in voxels.
fn error_to(truth: impl Fn(DVec3) -> f64, reach: f64, level_set: &LevelSet) -> f64 {
    let grid = level_set.grid();
    let mut worst = 0f64;
    for &id in grid.leaves() {
        for at in grid.mask(id).iter() {
            let exact = truth((grid.origin(id) + vdb_edit::grid::offset_to_local(at)).as_dvec3());
            if exact.abs() <= reach {
                worst = worst.max((f64::from(grid.values(id).0[at]) / level_set.voxel_size() - exact).abs());
            }
        }
    }
    worst
}

/// One voxel outwards and inwards: our exact offset and OpenVDB's flow, both against the truth.
///
/// Ours is bound by the polygons that it measures from: 3/8 h²κ inside the surface at most, 0.03 voxel on the torus, whose
/// tightest curvature is 1/12.7. OpenVDB's flow has no such bound to hold it to; it is asked to agree roughly, which
/// shows that both move the same way by the same length.
#[test]
fn offsets_by_one_voxel_against_the_truth() {
    let exact: [Exact; 2] = [("sphere", sphere_distance), ("torus", torus_distance)];
    for ((name, truth), (_, level_set)) in exact.into_iter().zip(subjects()) {
        for sign in [1.0, -1.0] {
            let moved = |p: DVec3| truth(p) - sign;
            let distance = sign * level_set.voxel_size();
            let ours = error_to(moved, 2.5, &offset(&level_set, distance, &RunOptions::default()).unwrap());
            let theirs = reference(&level_set, Filter::Offset(distance as f32), Tracker::default());
            let theirs = error_to(moved, 2.5, &theirs);
            println!("{name}, offset by {sign} voxel: error {ours:.1e} voxels, of OpenVDB's flow {theirs:.1e}");
            assert!(ours <= 0.375 / 11.7, "{name}: {ours}");
            assert!(theirs <= 0.2, "{name}: OpenVDB's {theirs}");
        }
    }
}

/// The band anew from the zero set: both against the truth, 0.05 voxel (the tolerance of `crosscheck`).
#[test]
fn rebuild_against_the_truth() {
    let exact: [Exact; 2] = [("sphere", sphere_distance), ("torus", torus_distance)];
    for ((name, truth), (_, level_set)) in exact.into_iter().zip(subjects()) {
        let ours = rebuild(&level_set, &Rebuild::band(3.0), &RunOptions::default()).unwrap();
        let theirs = ReferenceGrid::from_level_set(&level_set).unwrap().rebuild(0.0, 3.0).unwrap();
        let (ours, theirs) = (error_to(truth, 3.0, &ours), error_to(truth, 3.0, &theirs.to_level_set().unwrap()));
        println!("{name}, rebuilt: error {ours:.1e} voxels, OpenVDB's {theirs:.1e}");
        assert!(ours <= 0.05, "{name}: {ours}");
        // OpenVDB passes on the closest triangle from voxel to voxel, which is not exact far out in the band.
        assert!(theirs <= 1.0, "{name}: OpenVDB's {theirs}");
    }
}

fn asset(name: &str) -> TriangleMesh {
    read(format!("{}/assets/{name}", env!("CARGO_MANIFEST_DIR")).as_ref()).unwrap().mesh
}

/// A unit sphere off the origin, of an octahedron whose edges are cut into `n`: triangles of about one size, unlike those of an
/// isosurface, on whose slivers f32 distances lose digits.
fn octahedral_sphere(n: i32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for octant in 0..8 {
        let sign = DVec3::new([1.0, -1.0][octant & 1], [1.0, -1.0][octant >> 1 & 1], [1.0, -1.0][octant >> 2]);
        let point = |i: i32, j: i32| {
            let p = DVec3::new(f64::from(i), f64::from(j), f64::from(n - i - j));
            (p * sign).normalize() + DVec3::new(0.11, -0.07, 0.03)
        };
        let mut add = |corners: [DVec3; 3]| {
            let first = mesh.positions.len() as u32;
            mesh.positions.extend(corners);
            let outwards = sign.element_product() > 0.0;
            mesh.triangles.push(if outwards { [first, first + 1, first + 2] } else { [first, first + 2, first + 1] });
        };
        for i in 0..n {
            for j in 0..n - i {
                add([point(i, j), point(i + 1, j), point(i, j + 1)]);
                if i + j + 1 < n {
                    add([point(i + 1, j), point(i + 1, j + 1), point(i, j + 1)]);
                }
            }
        }
    }
    mesh
}

/// Meshes of a sphere, a torus and two models, with the voxel size that each is converted at.
fn meshes() -> Vec<(&'static str, TriangleMesh, f64)> {
    let of = |mesh: TriangleMesh, voxels: f64| {
        let (lo, hi) = mesh.bounding_box().unwrap();
        let size = (hi - lo).max_element() / voxels;
        (mesh, size)
    };
    let named = |name, (mesh, size)| (name, mesh, size);
    vec![
        named("sphere", of(octahedral_sphere(40), 70.0)),
        named("torus", of(asset("torus.obj"), 90.0)),
        named("spot", of(asset("spot.obj"), 110.0)),
        named("goathead", of(asset("goathead.obj"), 100.0)),
    ]
}

/// A mesh converted by OpenVDB differs from ours by up to 0.7 voxel, and it is not ours that is off: the distance to the
/// closest triangle, looked up for every voxel, and the winding number of the mesh, wherever the signs differ, say so.
///
/// Two things move OpenVDB's values. Last of all it renormalises: without that it agrees with us within 1e-5 near the
/// surface. And from 1.8 voxels on it asks only the triangles that were closest for voxels nearby, so that its distances are
/// never smaller than the true ones but up to 0.9 voxel larger.
#[test]
fn mesh_to_level_set_is_exact_where_openvdb_is_not() {
    for (name, mesh, voxel_size) in meshes() {
        let (ours, _) = mesh_to_level_set(&mesh, &MeshToLevelSet::new(voxel_size), &RunOptions::default()).unwrap();
        let points: Vec<_> = mesh.positions.iter().map(|p| p.as_vec3()).collect();
        let tree = Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t).map(|p| p / voxel_size)).collect());
        let winding = WindingNumber::new(&tree);
        let default = ReferenceGrid::from_mesh(&points, &mesh.triangles, *ours.transform(), 3.0).unwrap();
        let plain = ReferenceGrid::from_mesh_unnormalized(&points, &mesh.triangles, *ours.transform(), 3.0).unwrap();
        for (theirs, renormalized) in [(default, true), (plain, false)] {
            let theirs = theirs.to_level_set().unwrap();
            let (mut compared, mut apart, mut worst, mut beside) = (0u64, 0u64, 0f64, 0f64);
            let (mut ours_off, mut too_small, mut signs, mut missing) = (0f64, 0f64, 0u64, 0u64);
            let (mut ours_at, mut theirs_at) = (ours.grid().accessor(), theirs.grid().accessor());
            for grid in [ours.grid(), theirs.grid()] {
                for &id in grid.leaves() {
                    for at in grid.mask(id).iter() {
                        let ijk = grid.origin(id) + vdb_edit::grid::offset_to_local(at);
                        let [a, b] =
                            [ours_at.value(ijk), theirs_at.value(ijk)].map(|value| f64::from(value) / voxel_size);
                        let hit = tree.closest_point(ijk.as_dvec3(), 10.0);
                        let truth = hit.map_or(10.0, |hit| hit.distance_squared.sqrt()).min(3.0);
                        ours_off = ours_off.max((a.abs() - truth).abs());
                        if !ours_at.is_active(ijk) || !theirs_at.is_active(ijk) {
                            missing += u64::from(!ours_at.is_active(ijk) && truth < 3.0 - 1e-4);
                        } else if (a < 0.0) == (b < 0.0) {
                            compared += 1;
                            apart += u64::from((a - b).abs() > 1e-3);
                            worst = worst.max((a - b).abs());
                            too_small = too_small.max(truth - b.abs());
                            if truth <= 1.5 {
                                beside = beside.max((a - b).abs());
                            }
                        } else {
                            signs += 1;
                            // On the surface itself either sign is right.
                            let inside = winding.at(ijk.as_dvec3()) > 0.5;
                            assert!(truth < 1e-5 || inside == (a < 0.0), "{name}: {ijk} has the wrong sign");
                        }
                    }
                }
            }
            println!(
                "{name}, renormalised: {renormalized}: ours within {ours_off:.1e} voxels of the truth; of OpenVDB's {compared} voxels \
                 {apart} are over 1e-3 from ours, by up to {worst:.1e} ({beside:.1e} within 1.5 voxels of the surface); {signs} signed \
                 otherwise"
            );
            assert!(ours_off <= 1e-5, "{name}: {ours_off} voxels off the truth");
            assert_eq!(missing, 0, "{name}: voxels missing from the band");
            assert!(worst <= 1.0 && 2 * apart <= compared, "{name}: {apart} of {compared} apart, up to {worst}");
            if !renormalized {
                assert!(beside <= 1e-4, "{name}: {beside} voxels within 1.5 voxels of the surface");
                assert!(too_small <= 1e-4, "{name}: nearer than the closest triangle by {too_small} voxels");
            }
        }
    }
}

/// Area and signed volume of the polygons, which OpenVDB turns the other way round.
fn area_and_volume(mesh: &ReferenceMesh) -> (f64, f64) {
    let points = mesh.points().unwrap();
    let corners = |t: [u32; 3]| t.map(|v| points[v as usize].as_dvec3());
    mesh.all_triangles().unwrap().into_iter().map(corners).fold((0.0, 0.0), |(area, volume), [a, b, c]| {
        (area + (b - a).cross(c - a).length() / 2.0, volume + a.dot(b.cross(c)) / 6.0)
    })
}

/// The polygons of both programs have the same volume to 0.1 %, and the same area, where they are smooth. On models with creases and thin
/// parts they differ by up to 1 % of the area and 0.2 % of the volume; OpenVDB puts one point in a cell, at the mean of its
/// crossings, ours has its vertices on the grid edges.
#[test]
fn level_set_to_mesh_has_the_area_and_volume_of_openvdbs() {
    let mut subjects = subjects();
    // Inscribed polygons lose volume by the square of the curvature in voxels: 0.1 % needs a thicker torus than the others' test.
    let (bounds, run) = ((IVec3::splat(-95), IVec3::splat(95)), RunOptions::default());
    let torus = |p: DVec3| (p.x.hypot(p.y) - 64.3).hypot(p.z - 0.4) - 20.7;
    subjects[1].1 = LevelSet::from_distance(Transform::uniform(0.02), 3.0, bounds, torus, &run).unwrap();
    for (name, level_set) in subjects {
        let ours = level_set_to_mesh(&level_set, 0.0, &RunOptions::default()).unwrap();
        let (mut area, mut volume) = (0.0, 0.0);
        for t in 0..ours.triangles.len() {
            let [a, b, c] = ours.corners(t);
            area += (b - a).cross(c - a).length() / 2.0;
            volume += a.dot(b.cross(c)) / 6.0;
        }
        let reference = ReferenceGrid::from_level_set(&level_set).unwrap().to_mesh(0.0, 0.0).unwrap();
        let theirs = area_and_volume(&reference);
        let (of_area, of_volume) = (area / theirs.0 - 1.0, volume / theirs.1.abs() - 1.0);
        println!("{name}: area {:+.3} %, volume {:+.3} %", 100.0 * of_area, 100.0 * of_volume);
        let smooth = ["sphere", "torus"].contains(&name);
        let (area, volume) = if smooth { (1e-3, 1e-3) } else { (1e-2, 2e-3) };
        assert!(of_area.abs() <= area && of_volume.abs() <= volume, "{name}: {of_area} {of_volume}");
    }
}
