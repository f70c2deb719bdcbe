//! OpenVDB's tools through the bridge, against exact solutions: is what we compare our operators with called as intended?
#![cfg(feature = "openvdb")]

use glam::{DVec3, IVec3};
use vdb_edit::LevelSet;
use vdb_edit::grid::Transform;
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::reference::{Csg, Filter, ReferenceGrid, ReferenceScheme, Tracker};

const DX: f64 = 0.1;
/// Radius in voxels.
const R: f64 = 20.0;

fn ball(center: DVec3, radius: f64) -> LevelSet {
    let (c, r) = (center.as_ivec3(), IVec3::splat(radius as i32 + 8));
    let distance = |p: DVec3| (p - center).length() - radius;
    LevelSet::from_distance(Transform::uniform(DX), 3.0, (c - r, c + r), distance, &RunOptions::default()).unwrap()
}

fn reference() -> ReferenceGrid {
    ReferenceGrid::from_level_set(&ball(DVec3::ZERO, R)).unwrap()
}

/// Radius, in voxels, at which φ vanishes along x.
fn radius(grid: &ReferenceGrid) -> f64 {
    let level_set = grid.to_level_set().unwrap();
    let mut accessor = level_set.grid().accessor();
    let phi = |x: i32, a: &mut vdb_edit::grid::Accessor| f64::from(a.value(IVec3::new(x, 0, 0)));
    let x = (0..40).find(|&x| phi(x, &mut accessor) < 0.0 && phi(x + 1, &mut accessor) >= 0.0).unwrap();
    let (a, b) = (phi(x, &mut accessor), phi(x + 1, &mut accessor));
    f64::from(x) + a / (a - b)
}

#[test]
fn a_level_set_goes_to_openvdb_and_back_unchanged() {
    let level_set = ball(DVec3::new(3.5, -40.25, 7.0), R);
    let back = ReferenceGrid::from_level_set(&level_set).unwrap().to_level_set().unwrap();
    let (a, b) = (level_set.grid(), back.grid());
    assert_eq!(a.leaves().len(), b.leaves().len());
    for (&i, &j) in a.leaves().iter().zip(b.leaves()) {
        assert!(a.origin(i) == b.origin(j) && a.values(i) == b.values(j) && a.mask(i) == b.mask(j));
    }
    assert_eq!(a.inside_tiles(), b.inside_tiles());
}

#[test]
fn area_and_volume_of_a_ball() {
    let grid = reference();
    let r = R * DX;
    let pi = std::f64::consts::PI;
    assert!((grid.area().unwrap() / (4.0 * pi * r * r) - 1.0).abs() < 5e-3);
    assert!((grid.volume().unwrap() / (4.0 / 3.0 * pi * r.powi(3)) - 1.0).abs() < 5e-3);
}

#[test]
fn curvature_flow_shrinks_a_ball_as_it_must() {
    // dR/dt = -H = -1/R and a step of dx²/3: R² falls by 2/3 voxel² a step.
    let steps = 15;
    let exact = (R * R - 2.0 * steps as f64 / 3.0).sqrt();
    for tracker in [Tracker::default(), Tracker { scheme: ReferenceScheme::First, runge_kutta: 1, normalizations: 1 }] {
        let mut grid = reference();
        grid.apply(Filter::MeanCurvature(steps), &tracker).unwrap();
        assert!((radius(&grid) - exact).abs() < 0.05, "{tracker:?}: {} {exact}", radius(&grid));
    }
    // The Laplacian is twice the mean curvature, with half the step.
    let mut grid = reference();
    grid.apply(Filter::Laplacian(steps), &Tracker::default()).unwrap();
    assert!((radius(&grid) - exact).abs() < 0.05, "{} {exact}", radius(&grid));
}

#[test]
fn offset_is_positive_outwards() {
    for (distance, wanted) in [(0.2, 22.0), (-0.3, 17.0)] {
        let mut grid = reference();
        grid.apply(Filter::Offset(distance), &Tracker::default()).unwrap();
        assert!((radius(&grid) - wanted).abs() < 0.05, "{}", radius(&grid));
    }
}

#[test]
fn filters_and_trackers_keep_a_smooth_surface() {
    let rk3 = Tracker { runge_kutta: 3, ..Tracker::default() };
    for filter in [Filter::Gaussian(1), Filter::Mean(1), Filter::Median(1), Filter::Track, Filter::Normalize] {
        let mut grid = reference();
        grid.apply(filter, &rk3).unwrap();
        assert!((radius(&grid) - R).abs() < 0.25, "{filter:?}: {}", radius(&grid));
    }
    // Not in place: the copy alone changes.
    let original = reference();
    let mut copy = original.duplicate().unwrap();
    copy.apply(Filter::Offset(0.1), &rk3).unwrap();
    assert!((radius(&original) - R).abs() < 1e-4);
}

#[test]
fn csg_of_two_balls() {
    let (a, b) = (reference(), ReferenceGrid::from_level_set(&ball(DVec3::new(10.0, 0.0, 0.0), R)).unwrap());
    // Along x: a spans -20..20, b spans -10..30.
    let inside = |grid: &ReferenceGrid, x: i32| grid.to_level_set().unwrap().grid().voxel(IVec3::new(x, 0, 0)).0 < 0.0;
    for (operation, expected) in [
        (Csg::Union, [true, true, true]),
        (Csg::Intersection, [false, true, false]),
        (Csg::Difference, [true, false, false]),
    ] {
        let result = a.csg(&b, operation).unwrap();
        assert_eq!([-15, 5, 25].map(|x| inside(&result, x)), expected, "{operation:?}");
    }
}

#[test]
fn meshes_there_and_back() {
    let grid = reference();
    let mesh = grid.to_mesh(0.0, 0.0).unwrap();
    assert!(mesh.quads().unwrap().len() > 1000);
    // World units, on the sphere to a fraction of a voxel.
    let points = mesh.points().unwrap();
    for p in &points {
        assert!((f64::from(p.length()) - R * DX).abs() < 0.1 * DX);
    }
    let triangles = mesh.all_triangles().unwrap();
    let again = ReferenceGrid::from_mesh(&points, &triangles, Transform::uniform(DX), 3.0).unwrap();
    assert!((radius(&again) - R).abs() < 0.1);
    assert!(ReferenceGrid::from_mesh(&points, &[[0, 1, u32::MAX]], Transform::uniform(DX), 3.0).is_err());
    let wide = grid.rebuild(0.0, 5.0).unwrap();
    assert!((wide.to_level_set().unwrap().half_width() - 5.0).abs() < 1e-5);
    assert!((radius(&wide) - R).abs() < 0.1);
}
