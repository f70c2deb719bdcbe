//! Orders of convergence, measured: errors in world units on the same solid with voxels of half the size, and half of that.

use glam::{DVec3, IVec3};
use vdb_edit::LevelSet;
use vdb_edit::grid::{Transform, offset_to_local};
use vdb_edit::levelset::{CurvatureKind, curvature};
use vdb_edit::mesh::{Rebuild, rebuild};
use vdb_edit::ops::EvolutionOptions;
use vdb_edit::ops::smooth::{Smooth, smooth};
use vdb_edit::run::RunOptions;

const CENTRE: DVec3 = DVec3::new(0.013, -0.021, 0.008);

fn made(h: f64, reach: f64, distance: impl Fn(DVec3) -> f64 + Sync) -> LevelSet {
    let bound = IVec3::splat((reach / h) as i32 + 6);
    let index = |ijk: DVec3| distance(ijk * h) / h;
    LevelSet::from_distance(Transform::uniform(h), 3.0, (-bound, bound), index, &RunOptions::default()).unwrap()
}

/// Every pair of neighbours in the list differs by a factor of 2^order, within the tolerance of `low`.
fn assert_order(name: &str, errors: &[f64], low: f64) {
    for pair in errors.windows(2) {
        let order = (pair[0] / pair[1]).log2();
        assert!(order > low && order < 3.0, "{name}: order {order}, errors {errors:?}");
    }
}

#[test]
fn the_distance_is_second_order() {
    // Polygons of a ball lie up to 3/8 h²/R inside of it, and the distance to them is off by as much.
    let errors = [0.1, 0.05, 0.025].map(|h| {
        let ball = made(h, 1.0, |p| (p - CENTRE).length() - 1.0);
        let rebuilt = rebuild(&ball, &Rebuild::band(3.0), &RunOptions::default()).unwrap();
        let grid = rebuilt.grid();
        let error = |id, at| {
            let p = rebuilt.transform().voxel_to_world(grid.origin(id) + offset_to_local(at));
            (f64::from(grid.values(id).0[at]) - ((p - CENTRE).length() - 1.0)).abs()
        };
        let worst = grid.leaves().iter().flat_map(|&id| grid.mask(id).iter().map(move |at| (id, at)));
        let worst = worst.map(|(id, at)| error(id, at)).fold(0.0, f64::max);
        assert!(worst < 0.375 * h * h, "{h}: {worst}");
        worst
    });
    assert_order("distance", &errors, 1.7);
}

#[test]
fn curvature_is_second_order() {
    let errors = [0.1, 0.05, 0.025].map(|h| {
        let ring = made(h, 1.5, |p| (p.x.hypot(p.y) - 0.9).hypot(p.z) - 0.5);
        let field = curvature(&ring, CurvatureKind::Mean, &RunOptions::default()).unwrap();
        let (mut sum, mut count) = (0.0, 0.0);
        for &id in field.grid().leaves() {
            for at in field.grid().mask(id).iter() {
                let p = field.transform().voxel_to_world(field.grid().origin(id) + offset_to_local(at));
                let (out, tube) = (p.x.hypot(p.y) - 0.9, (p.x.hypot(p.y) - 0.9).hypot(p.z));
                if (tube - 0.5).abs() < h {
                    let exact = (1.0 / tube + out / (tube * (0.9 + out))) / 2.0;
                    sum += (f64::from(field.grid().values(id).0[at]) - exact).powi(2);
                    count += 1.0;
                }
            }
        }
        f64::sqrt(sum / count)
    });
    assert_order("curvature", &errors, 1.7);
}

#[test]
fn curvature_flow_is_second_order() {
    // F = −H: a ball of radius 1 has R² = 1 − 2t. The step is h²/3, so an error of first order in time is one of second order in h.
    let time = 0.18;
    let radius = f64::sqrt(1.0 - 2.0 * time);
    let errors = [0.1, 0.05].map(|h| {
        let mut ball = made(h, 1.0, |p| (p - CENTRE).length() - 1.0);
        let evolution = EvolutionOptions { time: Some(time), ..EvolutionOptions::default() };
        smooth(&mut ball, &Smooth { evolution, ..Smooth::default() }, &RunOptions::default()).unwrap();
        let mut sampler = ball.sampler();
        let points = (0..1000).map(|k| {
            let z = 1.0 - 2.0 * (f64::from(k) + 0.5) / 1000.0;
            let (s, c) = (f64::from(k) * 2.399963).sin_cos();
            CENTRE + DVec3::new((1.0 - z * z).sqrt() * c, (1.0 - z * z).sqrt() * s, z) * radius
        });
        let squares = points.map(|p| f64::from(sampler.trilinear(p / h)).powi(2));
        let rms = f64::sqrt(squares.sum::<f64>() / 1000.0);
        assert!(rms < 0.05 * h, "within a twentieth of a voxel: {rms}");
        rms
    });
    assert_order("curvature flow", &errors, 1.3);
}
