//! How far two level sets are apart, voxel by voxel and surface to surface.
//!
//! The band difference is |φ_A − φ_B| over the union of the active voxels, both cut to the smaller background, so that
//! bands of other widths do not count as differences. Where the lattices differ, B is first brought onto A's by exact distances
//! to its polygons ([`onto_lattice`]). The surface distance is that of the vertices of each surface's polygons to the other's
//! triangles, both ways. All lengths are in voxels of A.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use serde::Serialize;

use crate::error::Result;
use crate::grid::{Grid, LEAF_VOXELS, LeafMask, LeafValues};
use crate::levelset::LevelSet;
use crate::mesh::{Bvh, TriangleMesh, level_set_to_mesh, onto_lattice};
use crate::run::RunOptions;

const OPERATION: &str = "compare";

/// What [`compare`] finds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Whether transform, background, active voxels and every value are the same.
    pub identical: bool,
    /// Largest difference in the band, in voxels.
    pub max_diff_voxels: f64,
    /// Root of the mean square of the differences in the band, in voxels.
    pub rms_diff_voxels: f64,
    /// Voxels active in A alone.
    pub active_only_in_a: u64,
    /// Voxels active in B alone.
    pub active_only_in_b: u64,
    /// Distance of the surfaces; `None` if one has no surface.
    pub surface_distance: Option<SurfaceDistance>,
    /// Volume of B over that of A; `None` if A has none.
    pub volume_ratio: Option<f64>,
    /// Area of B over that of A; `None` if A has none.
    pub area_ratio: Option<f64>,
    /// Whether B had to be resampled to the lattice of A.
    pub resampled: bool,
}

/// Distances between two surfaces in voxels, over the vertices of both.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SurfaceDistance {
    /// Mean.
    pub mean: f64,
    /// Root of the mean square.
    pub rms: f64,
    /// Largest: the Hausdorff distance of the vertices.
    pub max: f64,
}

/// Compares `b` with `a`.
pub fn compare(a: &LevelSet, b: &LevelSet, run: &RunOptions) -> Result<Comparison> {
    let task = run.task(OPERATION, 3);
    let resampled = a.transform() != b.transform();
    let on_lattice = if resampled { &onto_lattice(b, a.transform(), a.half_width(), run)? } else { b };
    let band = band_difference(a.grid(), on_lattice.grid());
    task.advance(1);
    run.check(OPERATION)?;
    let (of_a, of_b) = (a.measure(run)?, b.measure(run)?);
    task.advance(1);
    let ratio = |b: f64, a: f64| (a != 0.0).then_some(b / a);
    let surface_distance = surface_distance(a, b, run)?;
    task.advance(1);
    let voxels = a.voxel_size();
    let count = band.voxels.max(1) as f64;
    Ok(Comparison {
        identical: !resampled && a.background() == b.background() && band.same_bits && signs(a) == signs(b),
        max_diff_voxels: band.max / voxels,
        rms_diff_voxels: (band.sum_of_squares / count).sqrt() / voxels,
        active_only_in_a: band.only_in_a,
        active_only_in_b: band.only_in_b,
        surface_distance,
        volume_ratio: ratio(of_b.volume, of_a.volume),
        area_ratio: ratio(of_b.area, of_a.area),
        resampled,
    })
}

/// Voxels of `after` whose value or activity is not that of `before`; all active ones where there is no "before" on the same
/// lattice.
pub fn changed_voxels(before: Option<&LevelSet>, after: &LevelSet) -> u64 {
    match before {
        Some(before) if before.transform() == after.transform() => change(before, after).voxels,
        _ => after.grid().active_voxels(),
    }
}

/// What changed between two level sets of one lattice.
pub(super) struct Change {
    /// Voxels whose value or activity differs.
    pub voxels: u64,
    /// Volume gained in world units: a voxel counts as inside with the part ½ − φ/h of it.
    pub volume: f64,
}

/// What of `before` changed to become `after`. Pages that they share are not looked at.
pub(super) fn change(before: &LevelSet, after: &LevelSet) -> Change {
    let (a, b) = (before.grid(), after.grid());
    let per_voxel = 1.0 / after.voxel_size();
    let inside = |bits: u32| (0.5 - f64::from(f32::from_bits(bits)) * per_voxel).clamp(0.0, 1.0);
    let of_leaf = |origin: IVec3| {
        if a.find(origin) == b.find(origin) && a.shares_storage(b, a.find(origin)) {
            return (0, 0.0);
        }
        let (a, b) = (View::of(a, origin), View::of(b, origin));
        let changed = (0..LEAF_VOXELS).map(|i| (a.at(i), b.at(i))).filter(|(a, b)| a != b);
        changed.fold((0, 0.0), |(voxels, volume), (a, b)| (voxels + 1, volume + (inside(b.0) - inside(a.0))))
    };
    // Summed in the order of leaves, so that threads do not show.
    let leaves: Vec<(u64, f64)> = all_origins(a, b).into_par_iter().with_min_len(16).map(of_leaf).collect();
    let (voxels, volume) = leaves.iter().fold((0, 0.0), |sum, leaf| (sum.0 + leaf.0, sum.1 + leaf.1));
    Change { voxels, volume: volume * after.voxel_size().powi(3) }
}

fn signs(level_set: &LevelSet) -> Vec<(IVec3, i32)> {
    level_set.grid().inside_tiles()
}

/// A leaf of a grid, or the space where it has none.
struct View<'a> {
    values: &'a LeafValues,
    mask: LeafMask,
}

impl<'a> View<'a> {
    fn of(grid: &'a Grid, origin: IVec3) -> Self {
        let id = grid.find(origin);
        Self { values: grid.values(id), mask: grid.mask(id) }
    }

    fn at(&self, offset: usize) -> (u32, bool) {
        (self.values.0[offset].to_bits(), self.mask.get(offset))
    }
}

/// Origins of the leaves of either grid.
fn all_origins(a: &Grid, b: &Grid) -> Vec<IVec3> {
    let of = |grid: &Grid| grid.leaves().iter().map(|&id| grid.origin(id)).collect::<Vec<_>>();
    let mut origins = of(a);
    origins.extend(of(b));
    origins.par_sort_unstable_by_key(|o| (o.x, o.y, o.z));
    origins.dedup();
    origins
}

struct BandDifference {
    same_bits: bool,
    max: f64,
    sum_of_squares: f64,
    voxels: u64,
    only_in_a: u64,
    only_in_b: u64,
}

impl BandDifference {
    const NONE: Self = Self { same_bits: true, max: 0.0, sum_of_squares: 0.0, voxels: 0, only_in_a: 0, only_in_b: 0 };

    fn add(self, next: &Self) -> Self {
        Self {
            same_bits: self.same_bits && next.same_bits,
            max: larger(self.max, next.max),
            sum_of_squares: self.sum_of_squares + next.sum_of_squares,
            voxels: self.voxels + next.voxels,
            only_in_a: self.only_in_a + next.only_in_a,
            only_in_b: self.only_in_b + next.only_in_b,
        }
    }
}

/// The larger number; infinite once one is NaN, so that no broken value counts as alike.
fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::INFINITY } else { a.max(b) }
}

fn band_difference(a: &Grid, b: &Grid) -> BandDifference {
    let background = a.background().min(b.background());
    let leaf = |origin: &IVec3| {
        let (a, b) = (View::of(a, *origin), View::of(b, *origin));
        let mut found = BandDifference::NONE;
        for offset in 0..LEAF_VOXELS {
            let ((bits_a, active_a), (bits_b, active_b)) = (a.at(offset), b.at(offset));
            found.same_bits &= bits_a == bits_b && active_a == active_b;
            if active_a || active_b {
                let cut = |bits: u32| f64::from(f32::from_bits(bits).clamp(-background, background));
                let difference = (cut(bits_a) - cut(bits_b)).abs();
                found.max = larger(found.max, difference);
                found.sum_of_squares += difference * difference;
                found.voxels += 1;
                found.only_in_a += u64::from(!active_b);
                found.only_in_b += u64::from(!active_a);
            }
        }
        found
    };
    // Summed in the order of leaves, so that threads do not show.
    let leaves: Vec<BandDifference> = all_origins(a, b).par_iter().with_min_len(64).map(leaf).collect();
    leaves.iter().fold(BandDifference::NONE, BandDifference::add)
}

fn surface_distance(a: &LevelSet, b: &LevelSet, run: &RunOptions) -> Result<Option<SurfaceDistance>> {
    let (mesh_a, mesh_b) = (level_set_to_mesh(a, 0.0, run)?, level_set_to_mesh(b, 0.0, run)?);
    let Some((lo, hi)) = mesh_a.bounding_box() else { return Ok(None) };
    if mesh_b.triangles.is_empty() {
        return Ok(None);
    }
    // Around the origin and in voxels, where the tree's f32 boxes are tight.
    let (centre, voxel_size) = ((lo + hi) / 2.0, a.voxel_size());
    let local = |mesh: TriangleMesh| TriangleMesh {
        positions: mesh.positions.iter().map(|p| (*p - centre) / voxel_size).collect(),
        ..mesh
    };
    let (mesh_a, mesh_b) = (local(mesh_a), local(mesh_b));
    run.check(OPERATION)?;
    let mut squares = squared_distances(&mesh_a, &mesh_b);
    run.check(OPERATION)?;
    squares.extend(squared_distances(&mesh_b, &mesh_a));
    let count = squares.len() as f64;
    Ok(Some(SurfaceDistance {
        mean: squares.iter().map(|s| s.sqrt()).sum::<f64>() / count,
        rms: (squares.iter().sum::<f64>() / count).sqrt(),
        max: squares.iter().copied().fold(0.0, f64::max).sqrt(),
    }))
}

/// Of the vertices of one mesh to the triangles of the other.
fn squared_distances(from: &TriangleMesh, to: &TriangleMesh) -> Vec<f64> {
    let tree = Bvh::new((0..to.triangles.len()).map(|t| to.corners(t)).collect());
    let nearest = |p: &DVec3| tree.closest_point(*p, f64::INFINITY).map(|hit| hit.distance_squared);
    from.positions.par_iter().with_min_len(256).filter_map(nearest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Transform;

    fn sphere(radius: f64, transform: Transform) -> LevelSet {
        let centre = transform.world_to_index(DVec3::ZERO);
        let reach = IVec3::splat((radius / transform.voxel_size()) as i32 + 8);
        let (lo, hi) = (centre.floor().as_ivec3() - reach, centre.ceil().as_ivec3() + reach);
        let distance = |ijk: DVec3| (ijk - centre).length() - radius / transform.voxel_size();
        LevelSet::from_distance(transform, 3.0, (lo, hi), distance, &RunOptions::default()).unwrap()
    }

    fn compared(a: &LevelSet, b: &LevelSet) -> Comparison {
        compare(a, b, &RunOptions::default()).unwrap()
    }

    #[test]
    fn a_level_set_is_identical_to_itself() {
        let a = sphere(1.0, Transform::uniform(0.1));
        let same = compared(&a, &a.clone());
        assert!(same.identical && !same.resampled);
        assert_eq!((same.max_diff_voxels, same.rms_diff_voxels), (0.0, 0.0));
        assert_eq!(same.volume_ratio, Some(1.0));
        assert!(same.surface_distance.unwrap().max < 1e-9);
        assert_eq!(changed_voxels(Some(&a), &a.clone()), 0);
        assert_eq!(changed_voxels(None, &a), a.grid().active_voxels());
    }

    #[test]
    fn spheres_of_other_radii_are_apart_by_their_difference() {
        let (a, b) = (sphere(1.0, Transform::uniform(0.1)), sphere(1.05, Transform::uniform(0.1)));
        let found = compared(&a, &b);
        assert!(!found.identical);
        assert!((found.max_diff_voxels - 0.5).abs() < 1e-4, "{}", found.max_diff_voxels);
        assert!(found.active_only_in_a > 0 && found.active_only_in_b > 0);
        let distance = found.surface_distance.unwrap();
        // Polygons of a sphere of 10 voxels lie within κ h²/8 of it.
        assert!((distance.mean - 0.5).abs() < 0.02 && (distance.max - 0.5).abs() < 0.03, "{distance:?}");
        assert!((found.volume_ratio.unwrap() - 1.05f64.powi(3)).abs() < 2e-3);
        assert!(changed_voxels(Some(&a), &b) >= a.grid().active_voxels());
    }

    #[test]
    fn other_lattices_are_resampled() {
        let turned = Transform::from_affine(glam::DAffine3::from_scale_rotation_translation(
            DVec3::splat(0.07),
            glam::DQuat::from_rotation_y(0.4),
            DVec3::new(0.013, 0.2, -0.1),
        ))
        .unwrap();
        let (a, b) = (sphere(1.0, Transform::uniform(0.1)), sphere(1.0, turned));
        let found = compared(&a, &b);
        assert!(found.resampled && !found.identical);
        // Polygons lie within κ h²/8 a direction of the sphere: 1/80 voxel each at a radius of ten.
        assert!(found.max_diff_voxels < 0.04, "{}", found.max_diff_voxels);
        // Vertices lie within κ h²/8 of the sphere, and triangles with edges of √3 voxels within three times that.
        assert!(found.surface_distance.unwrap().max < 0.05);
    }

    #[test]
    fn nothing_beside_something() {
        let a = sphere(1.0, Transform::uniform(0.1));
        let empty = LevelSet::empty(*a.transform(), 3.0);
        let found = compared(&empty, &a);
        assert_eq!((found.volume_ratio, found.surface_distance), (None, None));
        assert_eq!(found.active_only_in_b, a.grid().active_voxels());
        assert!(compared(&empty, &empty.clone()).identical);
    }
}
