//! Exact distances again from the surface: on the same lattice, on another one, or at an offset.
//!
//! The zero set is polygonised (vertices on the grid edges, where φ is linear) and the distances to its triangles are exact;
//! signs come from the field itself, or on another lattice from crossings. Against a true distance field the error is that
//! of the polygons: they lie up to 3/8·h²κ inside a smooth surface of curvature κ (half a cell's diagonal, squared, over the
//! diameter), and cut off up to half a voxel of a sharp edge. The surface of an offset is the set of points at that
//! distance: no steps, no error that grows with the distance.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::from_levelset::{leaves_the_band, surface_of};
use super::nearest::{Band, Leaf, leaves_of_band};
use super::{Bvh, MeshToLevelSet, TriangleMesh, level_set_to_mesh, mesh_to_level_set};
use crate::error::{EditError, Result};
use crate::grid::{Grid, LEAF_DIM, LEAF_VOXELS, LeafId, LeafMask, LeafSet, MAX_COORD, Transform};
use crate::levelset::isosurface::IsoSurface;
use crate::levelset::{BYTES_A_LEAF, LevelSet, background, grid_of_parts};
use crate::run::RunOptions;

const OPERATION: &str = "rebuild";

/// Distances from the surface, in voxels, up to which the triangles near a tile of voxels are collected; beyond, each voxel looks
/// its closest triangle up in a tree over all of them.
const FARTHEST_IN_TILES: f64 = 64.0;

/// What to rebuild.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rebuild {
    /// Half width of the new band in voxels.
    pub half_width: f32,
    /// The value of φ (world units, within the band) whose surface is taken.
    pub iso: f32,
    /// Distance (world units, positive outwards) of the new surface from that one.
    pub offset: f64,
    /// At an offset: keep the field's sharp edges on the side that the surface moves to, which its polygons cut off. For fields that are distances; up to
    /// 64 voxels.
    pub sharp: bool,
}

impl Rebuild {
    /// The same surface with a band of `half_width` voxels.
    pub fn band(half_width: f32) -> Self {
        Self { half_width, iso: 0.0, offset: 0.0, sharp: false }
    }
}

/// The level set with exact distances in a band of any width around its surface, or around one at an offset. Same lattice.
pub fn rebuild(level_set: &LevelSet, what: &Rebuild, run: &RunOptions) -> Result<LevelSet> {
    let transform = *level_set.transform();
    let voxel_size = transform.voxel_size();
    let Rebuild { half_width, iso, offset, sharp } = *what;
    if iso.is_nan() || iso.abs() >= level_set.background() {
        return Err(EditError::parameter(
            OPERATION,
            "iso",
            iso,
            format!("less than the band, {}", level_set.background()),
        ));
    }
    let offset = offset / voxel_size;
    let reach = offset.abs() + f64::from(half_width);
    let surface = surface_of(level_set, iso, OPERATION, run)?;
    if surface.is_torn() {
        return Err(leaves_the_band(OPERATION, "between leaves"));
    }
    if surface.leaves().is_empty() {
        let mut none = LevelSet::empty(transform, half_width);
        none.grid_mut().combine_signs(level_set.grid(), |_, inside| inside);
        return Ok(none);
    }
    let bounds = index_bounds(&surface, level_set.grid(), reach)?;
    if reach > FARTHEST_IN_TILES {
        drop(surface);
        return from_tree(level_set, what, bounds, run);
    }
    let background = background(half_width, &transform);
    let sharp = sharp && offset != 0.0;
    let band = Band { offset, half_width: f64::from(half_width), voxel_size, background, sharp, keeps: false };
    let leaves = leaves_of_band(OPERATION, &surface, level_set.grid(), iso, band, |_, _| true, run)?;
    Ok(LevelSet::new(grid_of_parts(background, &leaves), transform))
}

/// The level set with exact distances beyond its band, up to `half_width` voxels from the surface, in the leaves for whose first
/// and last voxel `wanted` holds, as it must for every box around one. The voxels of its own band keep their bits.
///
/// The rebuilt distances are those of polygons, the others what they were: where the two meet they differ by the error of the polygons.
pub fn widened(
    level_set: &LevelSet,
    half_width: f32,
    wanted: impl Fn(IVec3, IVec3) -> bool + Sync,
    run: &RunOptions,
) -> Result<LevelSet> {
    if level_set.half_width() >= half_width || level_set.grid().leaves().is_empty() {
        return Ok(level_set.clone());
    }
    let (transform, field) = (*level_set.transform(), level_set.grid());
    let background = background(half_width, &transform);
    let mut parts = rebuilt_leaves(level_set, half_width, wanted, run)?;
    parts.par_iter_mut().flatten().for_each(|(origin, values, mask)| {
        let own = field.find(*origin);
        for at in field.mask(own).iter() {
            values.0[at] = field.values(own).0[at];
            mask.set(at, true);
        }
    });
    let made: FxHashSet<IVec3> = parts.iter().flatten().map(|leaf| leaf.0).collect();
    let kept = field.leaves().par_iter().filter(|&&id| !made.contains(&field.origin(id))).map(|&id| {
        let (mut values, mask) = (field.values(id).clone(), field.mask(id));
        for at in mask.zip(mask, |active, _| !active).iter() {
            values.0[at] = if values.0[at] < 0.0 { -background } else { background };
        }
        (field.origin(id), values, mask)
    });
    parts.push(kept.collect());
    Ok(LevelSet::new(grid_of_parts(background, &parts), transform))
}

/// The same surface with exact distances in the cubes of 4³ voxels for whose first and last voxel `wanted` holds, as it must for every box around one; all
/// else stays as it is, in the pages that it shares.
pub fn rebuild_where(
    level_set: &LevelSet,
    wanted: impl Fn(IVec3, IVec3) -> bool + Sync,
    run: &RunOptions,
) -> Result<LevelSet> {
    let (mut grid, background) = (level_set.grid().clone(), level_set.background());
    let rebuilt = band_of(level_set, level_set.half_width(), true, &wanted, run)?;
    let mut missing: Vec<IVec3> =
        rebuilt.iter().flatten().map(|leaf| leaf.0).filter(|&o| grid.find(o).is_sentinel()).collect();
    missing.sort_unstable_by_key(|o| (o.x, o.y, o.z));
    grid.add_leaves(&missing);
    let new: FxHashMap<LeafId, &Leaf> = rebuilt.iter().flatten().map(|leaf| (grid.find(leaf.0), leaf)).collect();
    let is_wanted = |id: &LeafId| wanted(grid.origin(*id), grid.origin(*id) + (LEAF_DIM - 1));
    let leaves: Vec<LeafId> = grid.leaves().par_iter().copied().filter(is_wanted).collect();
    let leaves: LeafSet = leaves.into_iter().collect();
    grid.update(&leaves, |id, values, mask| match new.get(&id) {
        Some((_, there, active)) => {
            values.clone_from(there);
            *mask = *active;
        }
        // Farther from the surface than the band.
        None => {
            values.0.iter_mut().for_each(|value| *value = if *value < 0.0 { -background } else { background });
            *mask = LeafMask::EMPTY;
        }
    });
    grid.prune(&leaves);
    Ok(LevelSet::new(grid, *level_set.transform()))
}

/// The leaves of a band of `half_width` voxels with exact distances, those for whose first and last voxel `wanted` holds, as it must for every box
/// around one.
pub(crate) fn rebuilt_leaves(
    level_set: &LevelSet,
    half_width: f32,
    wanted: impl Fn(IVec3, IVec3) -> bool + Sync,
    run: &RunOptions,
) -> Result<Vec<Vec<Leaf>>> {
    band_of(level_set, half_width, false, wanted, run)
}

/// The same; voxels that are not wanted stay as they are if it `keeps` them.
fn band_of(
    level_set: &LevelSet,
    half_width: f32,
    keeps: bool,
    wanted: impl Fn(IVec3, IVec3) -> bool + Sync,
    run: &RunOptions,
) -> Result<Vec<Vec<Leaf>>> {
    let transform = level_set.transform();
    let background = background(half_width, transform);
    let surface = surface_of(level_set, 0.0, OPERATION, run)?;
    let (half, voxel_size) = (f64::from(half_width), transform.voxel_size());
    let band = Band { offset: 0.0, half_width: half, voxel_size, background, sharp: false, keeps };
    leaves_of_band(OPERATION, &surface, level_set.grid(), 0.0, band, wanted, run)
}

/// The same by looking up the closest triangle in a tree, voxel by voxel.
fn from_tree(level_set: &LevelSet, what: &Rebuild, bounds: (IVec3, IVec3), run: &RunOptions) -> Result<LevelSet> {
    let transform = *level_set.transform();
    let Rebuild { half_width, iso, offset, .. } = *what;
    let offset = offset / transform.voxel_size();
    // Found out before the search: no surface at this distance outwards of anything has less area than a ball of that radius.
    let area = 4.0 * std::f64::consts::PI * offset.max(0.0).powi(2);
    let leaves = area * 2.0 * f64::from(half_width) / LEAF_VOXELS as f64;
    run.reserve(OPERATION, leaves as u64 * BYTES_A_LEAF, "take a smaller distance")?;
    let mesh = level_set_to_mesh(level_set, iso, run)?;
    let positions: Vec<DVec3> = mesh.positions.iter().map(|p| transform.world_to_index(*p)).collect();
    let corners = |triangle: &[u32; 3]| triangle.map(|v| positions[v as usize]);
    let bvh = Bvh::new(mesh.triangles.iter().map(corners).collect());
    let field = level_set.grid();
    let distance = |ijk: DVec3| {
        let d = bvh.closest_point(ijk, f64::INFINITY).map_or(f64::INFINITY, |hit| hit.distance_squared.sqrt());
        // At the centre of a block the nearest voxel tells the side; where that is in doubt, d is small.
        let inside = field.voxel(ijk.round().as_ivec3()).0 < iso;
        if inside { -d - offset } else { d - offset }
    };
    LevelSet::from_distance(transform, half_width, bounds, distance, run)
}

/// The level set on another lattice, with exact distances to its polygonised surface; voxels that coincide are copied.
pub fn onto_lattice(level_set: &LevelSet, target: &Transform, half_width: f32, run: &RunOptions) -> Result<LevelSet> {
    if let Some(renamed) = level_set.renamed(target) {
        return with_half_width(&renamed, half_width, run);
    }
    level_set_of_mesh(level_set_to_mesh(level_set, 0.0, run)?, target, half_width, run)
}

/// The level set of a mesh (world units) on a given lattice; empty if it has no triangles.
pub fn level_set_of_mesh(
    mut mesh: TriangleMesh,
    target: &Transform,
    half_width: f32,
    run: &RunOptions,
) -> Result<LevelSet> {
    if mesh.triangles.is_empty() {
        return Ok(LevelSet::empty(*target, half_width));
    }
    // Into the target's index space, scaled by its voxel size: a world in which its lattice is the plain one.
    let voxel_size = target.voxel_size();
    mesh.positions.iter_mut().for_each(|p| *p = target.world_to_index(*p) * voxel_size);
    if target.to_world().matrix3.determinant() < 0.0 {
        mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    }
    let params = MeshToLevelSet { half_width, ..MeshToLevelSet::new(voxel_size) };
    let (rebuilt, _) = mesh_to_level_set(&mesh, &params, run)?;
    Ok(rebuilt.with_transform(*target))
}

/// The level set with another half width: cut if it is wider, rebuilt if it is narrower.
pub fn with_half_width(level_set: &LevelSet, half_width: f32, run: &RunOptions) -> Result<LevelSet> {
    let has = level_set.half_width();
    // Half widths from files differ in the last digits; a thousandth of a voxel is no other band.
    if (has - half_width).abs() < 1e-3 {
        Ok(level_set.clone())
    } else if has > half_width {
        Ok(level_set.narrowed(half_width))
    } else {
        rebuild(level_set, &Rebuild::band(half_width), run)
    }
}

/// Voxels around all that is within `reach` of a surface.
fn index_bounds(surface: &IsoSurface, field: &Grid, reach: f64) -> Result<(IVec3, IVec3)> {
    let origins = || surface.leaves().iter().map(|leaf| field.origin(leaf.id));
    let lo = origins().fold(IVec3::MAX, IVec3::min).as_dvec3() - reach - 1.0;
    let hi = (origins().fold(IVec3::MIN, IVec3::max) + LEAF_DIM).as_dvec3() + reach + 1.0;
    let limit = f64::from(MAX_COORD);
    if lo.abs().max(hi.abs()).max_element() > limit {
        return Err(EditError::parameter(
            OPERATION,
            "offset",
            reach,
            "a distance that stays within 2^30 voxels of the origin",
        ));
    }
    Ok((lo.floor().as_ivec3(), hi.ceil().as_ivec3()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{ball, block, box_distance, noise, sampled, torus};
    use crate::stencil::simd::{Isa, choose};

    /// Holds every `step`th voxel around the result against the nearest triangle of the polygons and the sign of the field.
    fn check(level_set: &LevelSet, what: Rebuild, step: usize) {
        let rebuilt = rebuild(level_set, &what, &RunOptions::default()).unwrap();
        let mesh = level_set_to_mesh(level_set, what.iso, &RunOptions::default()).unwrap();
        let transform = level_set.transform();
        let voxel_size = level_set.voxel_size();
        let bvh =
            Bvh::new((0..mesh.triangles.len()).map(|t| mesh.corners(t).map(|p| transform.world_to_index(p))).collect());
        let surface = IsoSurface::new(level_set.grid(), what.iso, "test", &RunOptions::default()).unwrap();
        let half_width = f64::from(what.half_width);
        let (lo, hi) = index_bounds(&surface, level_set.grid(), what.offset.abs() / voxel_size + half_width).unwrap();
        let mut accessor = rebuilt.grid().accessor();
        for x in (lo.x..=hi.x).step_by(step) {
            for y in (lo.y..=hi.y).step_by(step) {
                for z in (lo.z..=hi.z).step_by(step) {
                    let ijk = IVec3::new(x, y, z);
                    let unsigned = bvh.closest_point(ijk.as_dvec3(), f64::INFINITY).unwrap().distance_squared.sqrt();
                    let inside = level_set.grid().voxel(ijk).0 < what.iso;
                    let truth = if inside { -unsigned } else { unsigned } - what.offset / voxel_size;
                    let truth_in_band = truth.clamp(-half_width, half_width);
                    let value = f64::from(accessor.value(ijk)) / voxel_size;
                    // Rounding in f32 grows with the distance from the surface.
                    let tolerance = 1e-6 * (1.0 + unsigned);
                    assert!((value - truth_in_band).abs() < tolerance, "{what:?} {ijk}: {value} {truth}");
                    if (truth.abs() - half_width).abs() > tolerance {
                        assert_eq!(accessor.is_active(ijk), truth.abs() < half_width, "{what:?} {ijk}");
                    }
                }
            }
        }
    }

    #[test]
    fn where_it_is_wanted_distances_are_those_of_all_and_elsewhere_nothing_changes() {
        let mut distorted = parts();
        let all: LeafSet = distorted.grid().leaves().iter().copied().collect();
        distorted.grid_mut().update(&all, |_, values, mask| {
            mask.iter().for_each(|at| values.0[at] *= 0.75);
        });
        let centre = DVec3::new(9.0, 3.0, 5.0);
        let near = |first: IVec3, last: IVec3| {
            let nearest = centre.clamp(first.as_dvec3(), last.as_dvec3());
            nearest.distance(centre) < 9.0
        };
        let run = RunOptions::default();
        let (part, whole) =
            (rebuild_where(&distorted, near, &run).unwrap(), rebuild(&distorted, &Rebuild::band(3.0), &run).unwrap());
        let mut changed = 0;
        for n in 0..64i32.pow(3) {
            let ijk = IVec3::new(n / 4096, n / 64 % 64, n % 64) - 32;
            let cube = ijk.div_euclid(IVec3::splat(4)) * 4;
            let [(value, active), (before, was_active)] = [&part, &distorted].map(|l| l.grid().voxel(ijk));
            if near(cube, cube + 3) {
                // The nearest of two triangles that share a vertex may be the other one: the last bit differs.
                let (expected, expected_active) = whole.grid().voxel(ijk);
                assert!((value - expected).abs() <= 3.0 * f32::EPSILON && active == expected_active, "{ijk}");
            } else {
                assert_eq!((value.to_bits(), active), (before.to_bits(), was_active), "{ijk}");
            }
            changed += i32::from(value != before);
        }
        assert!(changed > 500, "{changed}");
    }

    fn moved(half_width: f32, offset: f64) -> Rebuild {
        Rebuild { offset, ..Rebuild::band(half_width) }
    }

    /// A thin plate, a ball beside it and a box that touches neither.
    fn parts() -> LevelSet {
        sampled(40, |p| {
            let plate = box_distance(p, DVec3::new(14.0, 13.0, 0.4));
            let ball = (p - DVec3::new(3.0, 2.0, 11.3)).length() - 6.2;
            let corner = box_distance(p + DVec3::new(20.0, 21.0, 18.5), DVec3::splat(5.3));
            plate.min(ball).min(corner)
        })
    }

    #[test]
    fn bands_of_any_width_are_exact() {
        for half_width in [1.5, 3.0, 7.0, 20.0] {
            check(&parts(), Rebuild::band(half_width), 1 + half_width as usize / 4);
            check(&torus(14.0, 5.0), Rebuild::band(half_width), 1 + half_width as usize / 4);
        }
        check(&ball(DVec3::new(0.3, -0.2, 0.1), 12.0), Rebuild { iso: -1.25, ..Rebuild::band(4.0) }, 1);
    }

    #[test]
    fn fields_that_are_no_distance_are_exact() {
        for (seed, inside) in [(1, 0.02), (2, 0.3), (3, 0.5), (4, 0.97)] {
            let field = noise(3, seed, inside);
            for half_width in [1.5, 3.0, 9.0] {
                check(&field, Rebuild::band(half_width), 1);
            }
            check(&field, moved(3.0, 4.0), 1);
        }
        // Signs alone: all vertices in the middle of an edge or, with values of 0, beside a voxel.
        for outside in [0.0, 0.5, f32::INFINITY] {
            check(
                &block(3, |ijk| if (ijk - 12).abs().max_element() < 7 { -0.5 } else { outside }),
                Rebuild::band(5.0),
                1,
            );
        }
    }

    #[test]
    fn offsets_are_exact_on_both_sides() {
        for offset in [1.0, -1.0, 2.5, -4.0, 9.0, -9.5, 17.0, 40.0] {
            check(&parts(), moved(3.0, offset), 2 + offset.abs() as usize / 3);
        }
        for offset in [-2.0, -11.0, 40.0, 70.0] {
            check(&ball(DVec3::new(0.3, -0.2, 0.1), 12.0), moved(1.5, offset), 2 + offset.abs() as usize / 3);
        }
        assert!(rebuild(&parts(), &moved(3.0, -20.0), &RunOptions::default()).unwrap().is_empty());
    }

    #[test]
    fn far_from_the_origin_is_as_exact() {
        let centre = DVec3::new(1e6 + 0.123, -2e7 - 0.4, 3e5);
        let voxel = centre.as_ivec3();
        let ball = LevelSet::from_distance(
            Transform::uniform(0.1),
            3.0,
            (voxel - 20, voxel + 20),
            |p| (p - centre).length() - 9.0,
            &RunOptions::default(),
        );
        check(&ball.unwrap(), moved(4.0, 0.35), 1);
    }

    #[test]
    fn threads_and_instructions_do_not_change_a_bit() {
        let level_set = parts();
        let on = |threads, isa| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let before = choose(isa);
            let result = pool.install(|| rebuild(&level_set, &moved(3.0, 2.5), &RunOptions::default()).unwrap());
            choose(before);
            let grid = result.into_grid();
            grid.leaves()
                .iter()
                .map(|&id| (grid.origin(id), grid.mask(id), grid.values(id).0.map(f32::to_bits)))
                .collect::<Vec<_>>()
        };
        let expected = on(1, Isa::Portable);
        assert!(expected == on(1, Isa::Avx512) && expected == on(3, Isa::Avx2));
        assert!(expected.iter().any(|(_, mask, _)| *mask != LeafMask::EMPTY));
    }

    #[test]
    fn refusals() {
        let ball = ball(DVec3::ZERO, 20.0);
        let mut limited = RunOptions::default();
        limited.memory_limit = Some(2_000_000);
        let small = rebuild(&ball, &Rebuild::band(3.0), &limited);
        assert!(small.is_ok(), "{:?}", small.err());
        assert_eq!(rebuild(&ball, &Rebuild::band(20.0), &limited).err().unwrap().exit_code(), 5);
        assert_eq!(rebuild(&ball, &moved(3.0, 1000.0), &limited).err().unwrap().exit_code(), 5);
        assert_eq!(rebuild(&ball, &moved(3.0, 2e9), &limited).err().unwrap().exit_code(), 2);
        let cancelled = RunOptions::default();
        cancelled.cancel_flag().store(true, std::sync::atomic::Ordering::Relaxed);
        assert_eq!(rebuild(&ball, &Rebuild::band(3.0), &cancelled).err().unwrap().exit_code(), 130);
        // Space of both signs that meets without any leaf between.
        let mut torn = sampled(24, |p| p.length() - 12.0);
        torn.grid_mut().set_sign(IVec3::new(16, 16, 0), IVec3::new(24, 24, 8), true);
        assert_eq!(rebuild(&torn, &Rebuild::band(3.0), &RunOptions::default()).err().unwrap().exit_code(), 3);
    }
}
