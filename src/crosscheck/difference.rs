//! How far two results lie apart, in voxels.

use glam::{DVec3, IVec3};

use crate::grid::{Transform, offset_to_local};
use crate::levelset::LevelSet;
use crate::mesh::{Bvh, TriangleMesh};

/// Differences of one row.
#[derive(Clone, Debug, Default)]
pub(super) struct Difference {
    /// Largest.
    pub max: f64,
    sum_of_squares: f64,
    voxels: u64,
    /// Voxels active on one side only.
    pub active: u64,
    /// OpenVDB's largest error, where both are held against the truth.
    pub openvdb_max: Option<f64>,
}

impl Difference {
    /// Over the voxels that both have active and `counts(ijk, a, b)` takes.
    pub fn between(a: &LevelSet, b: &LevelSet, counts: impl Fn(IVec3, f32, f32) -> bool) -> Self {
        let mut difference = Self { active: active_difference(a, b), ..Self::default() };
        let mut other = b.grid().accessor();
        for_each_active(a, |ijk, value| {
            let there = other.value(ijk);
            if other.is_active(ijk) && counts(ijk, value, there) {
                difference.add(f64::from(value - there) / a.voxel_size());
            }
        });
        difference
    }

    /// Both against the distance to triangles, signed by `source` and less `offset` voxels.
    pub fn to_truth(ours: &LevelSet, theirs: &LevelSet, bvh: &Bvh, source: &LevelSet, offset: f64) -> Self {
        let [mut difference, other] = [ours, theirs].map(|result| {
            let mut difference = Self::default();
            difference.add_errors(result, bvh, source, offset);
            difference
        });
        difference.active = active_difference(ours, theirs);
        difference.openvdb_max = Some(other.max);
        difference
    }

    /// Takes in one difference, in voxels.
    pub fn add(&mut self, voxels: f64) {
        // A NaN must not pass for a small difference.
        self.max = if voxels.is_nan() { f64::INFINITY } else { self.max.max(voxels.abs()) };
        self.sum_of_squares += voxels * voxels;
        self.voxels += 1;
    }

    /// Root mean square.
    pub fn rms(&self) -> f64 {
        (self.sum_of_squares / self.voxels.max(1) as f64).sqrt()
    }

    fn add_errors(&mut self, result: &LevelSet, bvh: &Bvh, source: &LevelSet, offset: f64) {
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

/// The triangles of a mesh in index space, to look up the closest.
pub(super) fn bvh(mesh: &TriangleMesh, transform: &Transform) -> Bvh {
    let corners = |t: usize| mesh.corners(t).map(|p| transform.world_to_index(p));
    Bvh::new((0..mesh.triangles.len()).map(corners).collect())
}

fn for_each_active(level_set: &LevelSet, mut f: impl FnMut(IVec3, f32)) {
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
