//! Area and volume of the polygons of both programs, held against shapes of which the exact ones are known.
//!
//! Both lose area and volume with the square of the curvature in voxels. Ours has its vertices on the surface, on the
//! edges between voxels; OpenVDB's has one in each cell, at the mean of the cell's crossings, which lies deeper inside.
#![cfg(feature = "openvdb")]

use std::f64::consts::PI;

use glam::{DQuat, DVec3, IVec3};
use vdb_edit::grid::Transform;
use vdb_edit::levelset::LevelSet;
use vdb_edit::mesh::level_set_to_mesh;
use vdb_edit::run::RunOptions;
use vdb_edit::vdb::reference::ReferenceGrid;

/// Relative errors of area and volume.
#[derive(Clone, Copy, Debug)]
struct Errors {
    area: f64,
    volume: f64,
}

fn errors(positions: &[DVec3], triangles: &[[u32; 3]], area: f64, volume: f64) -> Errors {
    let (mut a, mut v) = (0.0, 0.0);
    for [p, q, r] in triangles.iter().map(|t| t.map(|i| positions[i as usize])) {
        a += (q - p).cross(r - p).length() / 2.0;
        v += p.dot(q.cross(r)) / 6.0;
    }
    Errors { area: a / area - 1.0, volume: v.abs() / volume - 1.0 }
}

/// Ours and OpenVDB's for a solid that fits into ±`reach` voxels.
fn both(name: &str, reach: i32, area: f64, volume: f64, distance: impl Fn(DVec3) -> f64 + Sync) -> [Errors; 2] {
    let run = RunOptions::default();
    let bounds = (IVec3::splat(-reach - 5), IVec3::splat(reach + 5));
    let level_set = LevelSet::from_distance(Transform::uniform(1.0), 3.0, bounds, distance, &run).unwrap();
    let ours = level_set_to_mesh(&level_set, 0.0, &run).unwrap();
    let theirs = ReferenceGrid::from_level_set(&level_set).unwrap().to_mesh(0.0, 0.0).unwrap();
    let points: Vec<DVec3> = theirs.points().unwrap().iter().map(|p| p.as_dvec3()).collect();
    let found = [
        errors(&ours.positions, &ours.triangles, area, volume),
        errors(&points, &theirs.all_triangles().unwrap(), area, volume),
    ];
    let percent = found.map(|e| format!("area {:+.4} %, volume {:+.4} %", 100.0 * e.area, 100.0 * e.volume));
    println!("{name}: ours {}; OpenVDB {}", percent[0], percent[1]);
    found
}

fn centre() -> DVec3 {
    DVec3::new(0.3, -0.2, 0.1)
}

fn turn() -> DQuat {
    DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.7)
}

#[test]
fn smooth_shapes_are_nearer_the_truth_and_converge() {
    for radius in [8.0, 16.0, 32.0, 64.0] {
        let found = both(
            &format!("sphere, radius {radius}"),
            radius as i32,
            4.0 * PI * radius * radius,
            4.0 / 3.0 * PI * radius.powi(3),
            |p| (p - centre()).length() - radius,
        );
        assert_nearer(found, 0.8 / (radius * radius));
    }
    for minor in [5.0, 10.0, 20.0] {
        let major = 3.0 * minor;
        let found = both(
            &format!("torus, minor radius {minor}"),
            (major + minor) as i32,
            4.0 * PI * PI * major * minor,
            2.0 * PI * PI * major * minor * minor,
            |p| {
                let p = turn() * (p - centre());
                (p.x.hypot(p.y) - major).hypot(p.z) - minor
            },
        );
        assert_nearer(found, 0.8 / (minor * minor));
    }
}

/// An inscribed polygon of edge h on a curve of radius R lies up to h²/8R inside: about h²/8R² of the area and as much of
/// the volume, and cells have edges up to √3 h. `bound` is that with both principal curvatures.
fn assert_nearer([ours, theirs]: [Errors; 2], bound: f64) {
    assert!(ours.area.abs() <= bound && ours.volume.abs() <= bound, "{ours:?} {bound}");
    assert!(ours.area.abs() < theirs.area.abs() && ours.volume.abs() < theirs.volume.abs(), "{ours:?} {theirs:?}");
}

#[test]
fn a_turned_cube_loses_less_at_its_edges() {
    for half in [12.0, 24.0, 48.0] {
        let found = both(
            &format!("cube, edge {}", 2.0 * half),
            (half * 1.8) as i32,
            24.0 * half * half,
            8.0 * half * half * half,
            |p| {
                let q = (turn() * (p - centre())).abs() - half;
                q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
            },
        );
        // A polygon that cuts an edge off spans a cell: at most its diagonal, √3 voxels. Over a right angle that loses at most
        // (√2 − 1)·√3 of the width of the faces and 3/4 of the cross-section, along 12 edges.
        let [ours, theirs] = found;
        assert!(ours.area.abs() < 0.72 / half && ours.volume.abs() < 2.25 / (half * half), "{ours:?}");
        assert!(ours.area.abs() < theirs.area.abs() && ours.volume.abs() < theirs.volume.abs(), "{ours:?} {theirs:?}");
    }
}
