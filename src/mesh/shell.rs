//! A solid around a surface: everything within half a thickness of its triangles.

use glam::DVec3;

use super::scatter::{distance_to_triangles, estimated_bytes};
use super::{MeshToLevelSet, TriangleMesh};
use crate::error::Result;
use crate::grid::{LEAF_VOXELS, LeafMask, Transform};
use crate::levelset::{LevelSet, background, grid_of_leaves};
use crate::run::RunOptions;

/// The level set |d| − thickness / 2 of a surface, which may be open: an exact distance outside, and inside up to the surface
/// itself, where the distance to the other side takes over. `thickness` in world units.
pub fn shell(mesh: &TriangleMesh, thickness: f64, params: &MeshToLevelSet, run: &RunOptions) -> Result<LevelSet> {
    params.validate()?;
    let size = params.voxel_size;
    let half = thickness / 2.0 / size;
    let reach = half + f64::from(params.half_width);
    let corners = |t: usize| mesh.corners(t).map(|p| p / size);
    let count = mesh.triangles.len();
    let area: f64 = (0..count).map(corners).map(|[a, b, c]| (b - a).cross(c - a).length() / 2.0).sum();
    let (lo, hi) = mesh.bounding_box().unwrap_or((DVec3::ZERO, DVec3::ZERO));
    run.reserve(
        "shell",
        estimated_bytes(area, (hi - lo) / size, count, reach),
        "take a larger voxel_size or less thickness",
    )?;
    let transform = Transform::uniform(size);
    let background = background(params.half_width, &transform);
    let leaves = distance_to_triangles(count, corners, reach as f32, run)?
        .into_iter()
        .filter_map(|leaf| {
            let mut values = leaf.distance;
            let mut active = LeafMask::EMPTY;
            for at in 0..LEAF_VOXELS {
                let phi = ((f64::from(values.0[at]) - half) * size) as f32;
                active.set(at, phi.abs() < background);
                values.0[at] = if active.get(at) { phi } else { background.copysign(phi) };
            }
            (!active.is_empty()).then_some((leaf.origin, values, active))
        })
        .collect();
    Ok(LevelSet::new(grid_of_leaves(background, leaves), transform))
}
