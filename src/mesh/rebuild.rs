//! Exact distances again from the surface: on the same lattice, on another one, or at an offset.
//!
//! The zero set is polygonised (vertices on the grid edges, where φ is linear) and the distances to its triangles are exact;
//! signs come from the field itself, or on another lattice from crossings. Against a true distance field the error is that
//! of the polygons: they lie up to 3/8·h²κ inside a smooth surface of curvature κ (half a cell's diagonal, squared, over the
//! diameter), and cut off up to half a voxel of a sharp edge. The surface of an offset is the set of points at that
//! distance: no steps, no error that grows with the distance.

use glam::{DVec3, IVec3};

use super::scatter::{distance_to_triangles, estimated_bytes};
use super::{Bvh, MeshToLevelSet, TriangleMesh, level_set_to_mesh, mesh_to_level_set};
use crate::error::{EditError, Result};
use crate::grid::{LEAF_VOXELS, LeafMask, Transform};
use crate::levelset::{LevelSet, background, grid_of_leaves};
use crate::run::RunOptions;

const OPERATION: &str = "rebuild";

/// Distances from the surface, in voxels, up to which every triangle is scattered into the band around it; beyond, voxels
/// near the offset surface look for their closest triangle. A scattered band this wide costs about as much as the look-ups.
const WIDEST_SCATTER: f64 = 12.0;

/// What to rebuild.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rebuild {
    /// Half width of the new band in voxels.
    pub half_width: f32,
    /// The value of φ (world units, within the band) whose surface is taken.
    pub iso: f32,
    /// Distance (world units, positive outwards) of the new surface from that one.
    pub offset: f64,
}

impl Rebuild {
    /// The same surface with a band of `half_width` voxels.
    pub fn band(half_width: f32) -> Self {
        Self { half_width, iso: 0.0, offset: 0.0 }
    }
}

/// The level set with exact distances in a band of any width around its surface, or around one at an offset. Same lattice.
pub fn rebuild(level_set: &LevelSet, what: &Rebuild, run: &RunOptions) -> Result<LevelSet> {
    let transform = *level_set.transform();
    let voxel_size = transform.voxel_size();
    let Rebuild { half_width, iso, offset } = *what;
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
    let mesh = level_set_to_mesh(level_set, iso, run)?;
    if mesh.triangles.is_empty() {
        let mut none = LevelSet::empty(transform, half_width);
        none.grid_mut().combine_signs(level_set.grid(), |_, inside| inside);
        return Ok(none);
    }
    let positions: Vec<DVec3> = mesh.positions.iter().map(|p| transform.world_to_index(*p)).collect();
    let corners = |t: usize| mesh.triangles[t].map(|v| positions[v as usize]);
    let count = mesh.triangles.len();
    let field = level_set.grid();
    if reach > WIDEST_SCATTER {
        // Found out before the search: no surface at this distance outwards of anything has less area than a ball of that radius.
        let least =
            estimated_bytes(4.0 * std::f64::consts::PI * offset.max(0.0).powi(2), DVec3::splat(2.0 * reach), 0, 0.0);
        run.reserve(OPERATION, least, "take a smaller distance")?;
        let bvh = Bvh::new((0..count).map(corners).collect());
        let bounds = index_bounds(&positions, reach)?;
        let distance = |ijk: DVec3| {
            let d = bvh.closest_point(ijk, f64::INFINITY).map_or(f64::INFINITY, |hit| hit.distance_squared.sqrt());
            // At the centre of a block the nearest voxel tells the side; where that is in doubt, d is small.
            let inside = field.voxel(ijk.round().as_ivec3()).0 < iso;
            if inside { -d - offset } else { d - offset }
        };
        return LevelSet::from_distance(transform, half_width, bounds, distance, run);
    }
    let needed = estimated_bytes(area(&positions, &mesh), extent(&positions), count, reach);
    run.reserve(OPERATION, needed, "take a narrower band or a smaller distance")?;
    let background = background(half_width, &transform);
    let leaves = distance_to_triangles(count, corners, reach as f32, run)?
        .into_iter()
        .filter_map(|leaf| {
            let mut values = leaf.distance;
            let mut active = LeafMask::EMPTY;
            let inside = field.values(field.find(leaf.origin));
            for at in 0..LEAF_VOXELS {
                let d = f64::from(values.0[at]);
                let signed = if inside.0[at] < iso { -d - offset } else { d - offset };
                let phi = (signed * voxel_size) as f32;
                // What lies beyond the scattered band is farther than the new one reaches.
                let known = values.0[at] < reach as f32;
                active.set(at, known && phi.abs() < background);
                values.0[at] = if active.get(at) { phi } else { background.copysign(phi) };
            }
            (!active.is_empty()).then_some((leaf.origin, values, active))
        })
        .collect();
    Ok(LevelSet::new(grid_of_leaves(background, leaves), transform))
}

/// The level set on another lattice, with exact distances to its polygonised surface; voxels that coincide are copied.
pub fn onto_lattice(level_set: &LevelSet, target: &Transform, half_width: f32, run: &RunOptions) -> Result<LevelSet> {
    if let Some(renamed) = level_set.renamed(target) {
        return with_half_width(&renamed, half_width, run);
    }
    let mut mesh = level_set_to_mesh(level_set, 0.0, run)?;
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

fn index_bounds(positions: &[DVec3], reach: f64) -> Result<(IVec3, IVec3)> {
    let (lo, hi) = bounds(positions);
    let (lo, hi) = (lo - reach - 1.0, hi + reach + 1.0);
    let limit = f64::from(crate::grid::MAX_COORD);
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

fn bounds(positions: &[DVec3]) -> (DVec3, DVec3) {
    positions.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(*p), hi.max(*p)))
}

fn extent(positions: &[DVec3]) -> DVec3 {
    let (lo, hi) = bounds(positions);
    hi - lo
}

fn area(positions: &[DVec3], mesh: &TriangleMesh) -> f64 {
    let at = |v: u32| positions[v as usize];
    mesh.triangles.iter().map(|&[a, b, c]| (at(b) - at(a)).cross(at(c) - at(a)).length() / 2.0).sum()
}
