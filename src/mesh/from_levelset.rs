//! Level set → triangle mesh: marching cubes with shared vertices.
//!
//! The mesh of a valid level set is closed, manifold and consistently oriented, whatever its signs (the argument is
//! in `levelset::marching`). Vertices lie on grid edges by linear interpolation: within κ h²/8 of the true surface
//! where φ is a distance. Numbers of vertices and triangles go by the order of leaves, not by threads.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::DVec3;
use rayon::prelude::*;

use super::TriangleMesh;
use super::remesh::Last;
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::levelset::isosurface::{CellVertices, IsoSurface, MEMORY_ADVICE, SurfaceLeaf};
use crate::levelset::marching::cell_case;
use crate::run::RunOptions;

const OPERATION: &str = "level set to mesh";

/// The surface φ = `iso` (world units, 0 for the level set's own) as a mesh in world units.
///
/// |iso| must be below the background, and a voxel below it for an accurate surface. Vertex attributes are not made.
/// Refused where the surface leaves the stored band: such a mesh would have holes. Surfaces that lie between absent
/// leaves altogether are not seen; [`LevelSet::check`] finds both.
pub fn level_set_to_mesh(level_set: &LevelSet, iso: f32, run: &RunOptions) -> Result<TriangleMesh> {
    polygonise(level_set, iso, None, run).map(|polygons| polygons.mesh)
}

/// A mesh, and what the next one needs to know of it.
pub(super) struct Polygons {
    pub mesh: TriangleMesh,
    /// The leaves that the surface crosses, and the place of each among them by slot.
    pub leaves: Vec<SurfaceLeaf>,
    pub places: Vec<u32>,
    /// How many of them were not taken from the last mesh.
    pub made: usize,
}

/// As [`level_set_to_mesh`]; what is the same as in the `last` mesh is copied from it.
pub(super) fn polygonise(level_set: &LevelSet, iso: f32, last: Option<&Last>, run: &RunOptions) -> Result<Polygons> {
    let surface = surface_of(level_set, iso, OPERATION, run)?;
    let leaves = surface.leaves();
    let bytes = surface.vertex_count() * size_of::<DVec3>() + surface.triangle_count() * size_of::<[u32; 3]>();
    run.reserve(OPERATION, bytes as u64, MEMORY_ADVICE)?;

    let mut positions = vec![DVec3::ZERO; surface.vertex_count()];
    let mut triangles = vec![[0; 3]; surface.triangle_count()];
    let transform = level_set.transform();
    // A mirrored transform turns the orientation round.
    let mirrored = transform.to_world().matrix3.determinant() < 0.0;
    let task = run.task(OPERATION, leaves.len() as u64);
    let copied = AtomicUsize::new(0);
    let complete = split(leaves, &mut positions, &mut triangles)
        .into_par_iter()
        .with_min_len(16)
        .map_init(CellVertices::new, |vertices, (leaf, positions, triangles)| {
            if run.is_cancelled() {
                return true;
            }
            if let Some(kept) = last.and_then(|last| last.kept(level_set.grid(), &surface, leaf)) {
                positions.copy_from_slice(kept.positions);
                for (triangle, kept_triangle) in triangles.iter_mut().zip(kept.triangles) {
                    *triangle = kept_triangle.map(|vertex| vertex.wrapping_add(kept.shift));
                }
                copied.fetch_add(1, Ordering::Relaxed);
                task.advance(1);
                return true;
            }
            let mut slots = positions.iter_mut();
            surface.for_each_position(leaf, |ijk| {
                if let Some(slot) = slots.next() {
                    *slot = transform.index_to_world(ijk);
                }
            });
            task.advance(1);
            vertices.take(&surface, leaf);
            fill_triangles(&surface, leaf, vertices, mirrored, triangles)
        })
        .all(|complete| complete);
    run.check(OPERATION)?;
    if complete {
        let mesh = TriangleMesh { positions, triangles, ..TriangleMesh::default() };
        let made = leaves.len() - copied.into_inner();
        let (leaves, places) = surface.into_leaves();
        Ok(Polygons { mesh, leaves, places, made })
    } else {
        Err(leaves_the_band(OPERATION, "between leaves"))
    }
}

/// The surface φ = `iso` for `operation`; refused where it leaves the stored leaves.
pub(super) fn surface_of<'a>(
    level_set: &'a LevelSet,
    iso: f32,
    operation: &str,
    run: &RunOptions,
) -> Result<IsoSurface<'a>> {
    let grid = level_set.grid();
    let background = grid.background();
    if iso.is_nan() || iso.abs() >= background {
        return Err(EditError::parameter(operation, "iso", iso, format!("above -{background} and below {background}")));
    }
    let surface = IsoSurface::new(grid, iso, operation, run)?;
    match grid.map_leaves(|id| surface.leak(id)).into_iter().flatten().next() {
        Some(ijk) => Err(leaves_the_band(operation, &format!("at voxel {ijk}"))),
        None => Ok(surface),
    }
}

/// The error of a level set whose surface cannot be followed.
pub(super) fn leaves_the_band(operation: &str, place: &str) -> EditError {
    EditError::NotALevelSet {
        operation: operation.into(),
        name: "level set".into(),
        problem: format!("the surface leaves the stored band {place}; rebuild it, or use --repair"),
    }
}

/// A leaf, its vertices and its triangles.
type Part<'a> = (&'a SurfaceLeaf, &'a mut [DVec3], &'a mut [[u32; 3]]);

/// The part of both arrays that each leaf fills.
fn split<'a>(
    leaves: &'a [SurfaceLeaf],
    mut positions: &'a mut [DVec3],
    mut triangles: &'a mut [[u32; 3]],
) -> Vec<Part<'a>> {
    leaves
        .iter()
        .map(|leaf| {
            let (p, rest) = std::mem::take(&mut positions).split_at_mut(leaf.vertices as usize);
            positions = rest;
            let (t, rest) = std::mem::take(&mut triangles).split_at_mut(leaf.triangles as usize);
            triangles = rest;
            (leaf, p, t)
        })
        .collect()
}

/// Whether all vertices were found: the edges of a valid level set all lie in stored leaves.
fn fill_triangles(
    surface: &IsoSurface,
    leaf: &SurfaceLeaf,
    vertices: &CellVertices,
    mirrored: bool,
    triangles: &mut [[u32; 3]],
) -> bool {
    let mut slots = triangles.iter_mut();
    let mut complete = true;
    surface.rows(leaf).for_each_cell(|cell, pattern| {
        for (edges, slot) in cell_case(pattern).triangles.iter().zip(&mut slots) {
            match edges.map(|e| vertices.vertex(cell, e)) {
                [Some(a), Some(b), Some(c)] => *slot = if mirrored { [a, c, b] } else { [a, b, c] },
                _ => complete = false,
            }
        }
    });
    complete
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Transform;
    use crate::levelset::testing::{ball, block, noise, sampled, torus};
    use crate::mesh::testing::{area_and_volume, assert_manifold};
    use glam::IVec3;

    fn mesh(level_set: &LevelSet) -> TriangleMesh {
        level_set_to_mesh(level_set, 0.0, &RunOptions::default()).unwrap()
    }

    #[test]
    fn sphere_and_torus() {
        let centre = DVec3::new(0.3, -0.2, 0.1);
        let sphere = mesh(&ball(centre, 20.0));
        assert_eq!(assert_manifold(&sphere), 2);
        // A chord of a voxel's length sags κ h²/8; a linear crossing of the distance errs no more. Normals point
        // outwards.
        for p in &sphere.positions {
            assert!(((*p - centre).length() - 20.0).abs() < 1.0 / (8.0 * 20.0) * 1.1);
        }
        for t in 0..sphere.triangles.len() {
            let [a, b, c] = sphere.corners(t);
            let n = (b - a).cross(c - a).normalize();
            assert!(n.dot(((a + b + c) / 3.0 - centre).normalize()) > 0.8);
        }
        assert_eq!(assert_manifold(&mesh(&torus(20.0, 6.0))), 0);
        let empty = mesh(&LevelSet::empty(Transform::uniform(1.0), 3.0));
        assert_eq!(empty, TriangleMesh::default());
    }

    #[test]
    fn random_signs_are_manifold_and_agree_with_the_measures() {
        for (seed, inside) in [(1, 0.1), (2, 0.3), (3, 0.5), (4, 0.7), (5, 0.95)] {
            let level_set = noise(3, seed, inside);
            let mesh = mesh(&level_set);
            let euler = assert_manifold(&mesh);
            let measures = level_set.measure(&RunOptions::default()).unwrap();
            assert_eq!(euler, measures.euler);
            let (area, volume) = area_and_volume(&mesh);
            assert!((area - measures.area).abs() < 1e-9 * area && (volume - measures.volume).abs() < 1e-9 * area);
        }
    }

    #[test]
    fn cubes_that_touch_at_an_edge_or_a_corner() {
        for offset in [IVec3::new(1, 1, 0), IVec3::ONE, IVec3::X] {
            // Values of exactly 0 around the cubes: every vertex would lie on a voxel.
            for outside in [0.0, 0.5] {
                let cubes = block(3, move |ijk| {
                    let within = |lo: IVec3| (ijk - lo).min_element() >= 0 && (ijk - lo).max_element() < 4;
                    if within(IVec3::splat(5)) || within(IVec3::splat(5) + offset * 4) { -0.5 } else { outside }
                });
                assert_eq!(assert_manifold(&mesh(&cubes)), if offset == IVec3::X { 2 } else { 4 });
            }
        }
    }

    #[test]
    fn other_iso_values_and_mirrored_transforms() {
        let level_set = ball(DVec3::ZERO, 12.0);
        let grown = level_set_to_mesh(&level_set, 1.5, &RunOptions::default()).unwrap();
        assert_eq!(assert_manifold(&grown), 2);
        assert!(grown.positions.iter().all(|p| (p.length() - 13.5).abs() < 0.012));
        for iso in [3.0, -3.5, f32::NAN] {
            let refused = level_set_to_mesh(&level_set, iso, &RunOptions::default()).unwrap_err();
            assert_eq!(refused.exit_code(), 2, "{refused}");
        }
        let (area, volume) = area_and_volume(&mesh(&level_set));
        let mirror = glam::DAffine3::from_scale_rotation_translation(
            DVec3::new(-1.0, 1.0, 1.0),
            glam::DQuat::from_rotation_y(0.5),
            DVec3::new(100.0, 0.0, -7.0),
        );
        let mirrored = mesh(&level_set.with_transform(Transform::from_affine(mirror).unwrap()));
        assert_eq!(assert_manifold(&mirrored), 2);
        let (mirrored_area, mirrored_volume) = area_and_volume(&mirrored);
        assert!((mirrored_area / area - 1.0).abs() < 1e-12 && (mirrored_volume / volume - 1.0).abs() < 1e-9);
    }

    #[test]
    fn threads_do_not_change_the_mesh() {
        let level_set = noise(4, 11, 0.4);
        let on = |threads| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| mesh(&level_set))
        };
        assert_eq!(on(1), on(3));
    }

    #[test]
    fn refusals() {
        let ball = ball(DVec3::ZERO, 20.0);
        let mut limited = RunOptions::default();
        limited.memory_limit = Some(100_000);
        assert_eq!(level_set_to_mesh(&ball, 0.0, &limited).unwrap_err().exit_code(), 5);
        let cancelled = RunOptions::default();
        cancelled.cancel_flag().store(true, std::sync::atomic::Ordering::Relaxed);
        assert_eq!(level_set_to_mesh(&ball, 0.0, &cancelled).unwrap_err().exit_code(), 130);
        // A leaf at the surface loses its band: the surface ends in the open.
        let mut holed = ball.clone();
        let top = holed.grid().find(IVec3::new(0, 0, 16));
        let set = [top].into_iter().collect();
        holed.grid_mut().update(&set, |_, values, mask| {
            values.0.fill(3.0);
            *mask = crate::grid::LeafMask::EMPTY;
        });
        holed.grid_mut().prune(&set);
        let refused = level_set_to_mesh(&holed, 0.0, &RunOptions::default()).unwrap_err();
        assert_eq!(refused.exit_code(), 3, "{refused}");
        // Space of both signs that meets without any leaf between, at the upper edge of a leaf.
        let mut torn = sampled(24, |p| p.length() - 12.0);
        torn.grid_mut().set_sign(IVec3::new(16, 16, 0), IVec3::new(24, 24, 8), true);
        assert!(level_set_to_mesh(&torn, 0.0, &RunOptions::default()).is_err());
    }
}
