//! What comes out of a flow is a level set again, by the checker's word.

use fearless_simd::Simd;
use glam::{DVec3, IVec3};
use vdb_edit::LevelSet;
use vdb_edit::grid::Transform;
use vdb_edit::mesh::level_set_to_mesh;
use vdb_edit::pde::{SolverOptions, SpeedFunction, Until, evolve};
use vdb_edit::run::RunOptions;
use vdb_edit::stencil::Halo;
use vdb_edit::stencil::curvature::mean_curvature;
use vdb_edit::stencil::simd::Lanes;

/// F = −H.
struct MeanCurvature;

impl SpeedFunction for MeanCurvature {
    type Halo = Halo;

    fn largest_step(&self, voxel_size: f64) -> f64 {
        voxel_size * voxel_size / 3.0
    }

    #[inline(always)]
    fn rate<S: Simd>(&self, simd: S, halo: &Halo, x: usize, y: usize, voxel_size: f32) -> Lanes<S> {
        let at = mean_curvature(simd, halo, x, y, voxel_size);
        -at.mean * at.gradient
    }
}

#[test]
fn curvature_flow_of_a_sharp_union() {
    let run = RunOptions::default();
    let shape = |p: DVec3| {
        let q = p.abs() - DVec3::new(20.0, 12.0, 8.0);
        let slab = q.max(DVec3::ZERO).length() + q.max_element().min(0.0);
        slab.min((p - DVec3::new(5.0, 3.0, 10.0)).length() - 11.3)
    };
    let bounds = (IVec3::splat(-32), IVec3::splat(32));
    let transform = Transform::uniform(0.1);
    let mut level_set = LevelSet::from_distance(transform, 3.0, bounds, shape, &run).unwrap();
    assert_eq!(level_set.check(), []);
    let mut before = level_set.measure(&run).unwrap();
    for steps in [1, 5, 40] {
        evolve(&mut level_set, &MeanCurvature, None, Until::Iterations(steps), &SolverOptions::FIRST_ORDER, &run)
            .unwrap();
        assert_eq!(level_set.check(), [], "{steps} steps");
        let after = level_set.measure(&run).unwrap();
        assert!(after.area < before.area && (after.components, after.euler) == (1, 2));
        let mesh = level_set_to_mesh(&level_set, 0.0, &run).unwrap();
        assert_eq!(mesh.positions.len() as i64 - mesh.triangles.len() as i64 / 2, after.euler);
        before = after;
    }
}
