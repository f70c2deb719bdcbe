//! How far two results lie apart, in voxels.

use glam::{DVec3, IVec3};
use serde::Serialize;

use crate::grid::{Transform, offset_to_local};
use crate::levelset::LevelSet;
use crate::mesh::{Bvh, TriangleMesh, WindingNumber};

/// A look-up of the closest triangle costs more than the operators do: one in so many voxels is asked.
const EVERY: u32 = 16;

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
    /// How the two compare with each other, where both are held against a mesh.
    pub mutual: Option<Mutual>,
    /// Of meshes: area and volume of ours over OpenVDB's, less 1.
    pub area: Option<f64>,
    pub volume: Option<f64>,
    /// The same of ours and of OpenVDB's over the mesh that the level set was made from.
    pub area_to_source: Option<[f64; 2]>,
    pub volume_to_source: Option<[f64; 2]>,
    /// Of files: the number of leaves, and the time that copying one to OpenVDB takes.
    pub leaves: Option<f64>,
    pub copy_us_a_leaf: Option<f64>,
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

    /// Both against the closed mesh that they were made of, given in index space: distances by its closest triangle, signs
    /// by its winding number. And against each other.
    pub fn to_mesh(ours: &LevelSet, theirs: &LevelSet, mesh: &Bvh, tolerance: f64) -> Self {
        let [mut difference, other] = [ours, theirs].map(|result| {
            let mut difference = Self::default();
            difference.add_magnitudes(result, mesh);
            difference
        });
        difference.active = active_difference(ours, theirs);
        difference.openvdb_max = Some(other.max);
        difference.mutual = Some(Mutual::new(ours, theirs, mesh, tolerance));
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

    /// The errors of distances, whatever their sign.
    fn add_magnitudes(&mut self, result: &LevelSet, mesh: &Bvh) {
        let reach = f64::from(result.half_width()) + 2.0;
        let mut count = 0u32;
        for_each_active(result, |ijk, value| {
            count += 1;
            if count.is_multiple_of(EVERY) {
                let hit = mesh.closest_point(ijk.as_dvec3(), reach);
                let truth = hit.map_or(f64::INFINITY, |hit| hit.distance_squared.sqrt());
                self.add(f64::from(value.abs()) / result.voxel_size() - truth);
            }
        });
    }

    fn add_errors(&mut self, result: &LevelSet, bvh: &Bvh, source: &LevelSet, offset: f64) {
        let mut field = source.grid().accessor();
        let reach = f64::from(result.half_width()) + offset.abs() + 2.0;
        let mut count = 0u32;
        for_each_active(result, |ijk, value| {
            count += 1;
            if count.is_multiple_of(EVERY) {
                let p: DVec3 = ijk.as_dvec3();
                let d = bvh.closest_point(p, reach).map_or(f64::INFINITY, |hit| hit.distance_squared.sqrt());
                let signed = if field.value(ijk) < 0.0 { -d } else { d };
                self.add(f64::from(value) / result.voxel_size() - (signed - offset));
            }
        });
    }
}

/// How two conversions of one mesh compare with each other.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Mutual {
    /// Largest difference where both have one sign, in voxels.
    pub signed_alike_max_diff_voxels: f64,
    /// Voxels of one sign in both whose values differ by more than the tolerance.
    pub signed_alike_above_tolerance: u64,
    /// Voxels with another sign in each.
    pub signed_otherwise: u64,
    /// Voxels of these where the winding number of the mesh contradicts ours.
    pub missigned_by_ours: u64,
}

impl Mutual {
    fn new(ours: &LevelSet, theirs: &LevelSet, mesh: &Bvh, tolerance: f64) -> Self {
        let mut mutual = Self::default();
        let winding = WindingNumber::new(mesh);
        let mut other = theirs.grid().accessor();
        for_each_active(ours, |ijk, value| {
            let there = other.value(ijk);
            if !other.is_active(ijk) {
                return;
            }
            if (value < 0.0) == (there < 0.0) {
                let difference = f64::from(value - there).abs() / ours.voxel_size();
                mutual.signed_alike_max_diff_voxels = mutual.signed_alike_max_diff_voxels.max(difference);
                mutual.signed_alike_above_tolerance += u64::from(difference > tolerance);
            } else {
                mutual.signed_otherwise += 1;
                mutual.missigned_by_ours += u64::from((winding.at(ijk.as_dvec3()) > 0.5) != (value < 0.0));
            }
        });
        mutual
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
