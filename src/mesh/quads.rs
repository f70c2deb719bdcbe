//! Level set → quad mesh: dual contouring, one quad around each grid edge that the surface crosses.
//!
//! A cell has one vertex for each of its pieces of surface ([`dual`](crate::levelset::dual)), so the mesh of a valid level
//! set is closed, manifold and consistently oriented, whatever its signs. A vertex is the mean of the points where its
//! piece crosses the grid edges, and where it is alone in its cell, one Newton step x − (φ − iso) ∇φ/|∇φ|² of the
//! trilinear field draws it onto the surface. The quads are not flat: between their corners they err as chords of a voxel's
//! length do, by about κ h²/4. Numbers of vertices and quads go by the order of leaves and cells, not by threads.
//!
//! Source: Gibson 1998, Constrained Elastic Surface Nets; Nielson 2004, Dual Marching Cubes.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::TriangleMesh;
use super::from_levelset::{leaves_the_band, surface_of};
use crate::error::{EditError, Result};
use crate::grid::{Grid, LeafMask, leaf_offset, leaf_origin, neighbour_index, offset_to_local};
use crate::levelset::LevelSet;
use crate::levelset::dual::{DualCase, dual_case};
use crate::levelset::isosurface::{IsoSurface, MEMORY_ADVICE, SurfaceLeaf, VERTEX_MARGIN, corner, crossing};
use crate::levelset::marching::{EDGES, Edge, edge_at};
use crate::levelset::sample::interpolate;
use crate::run::RunOptions;

const OPERATION: &str = "level set to quads";

/// The longest Newton step in voxels: a longer one does not come from a distance field.
const LONGEST_STEP: f64 = 0.5;

/// An indexed quad mesh in world units; corners are counter-clockwise seen from outside, attributes as in a [`TriangleMesh`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct QuadMesh {
    /// Vertex positions.
    pub positions: Vec<DVec3>,
    /// Vertex indices of each quad.
    pub quads: Vec<[u32; 4]>,
    /// Linear RGBA in 0..1, one a vertex.
    pub colors: Option<Vec<[f32; 4]>>,
    /// Texture coordinates, one a vertex.
    pub uvs: Option<Vec<[f32; 2]>>,
}

impl QuadMesh {
    /// The same mesh in triangles: each quad is cut along the diagonal across which its halves face most alike.
    pub fn into_triangles(self) -> TriangleMesh {
        let triangles = self.quads.par_iter().flat_map_iter(|quad| cut(*quad, &self.positions)).collect();
        TriangleMesh { positions: self.positions, triangles, colors: self.colors, uvs: self.uvs, normals: None }
    }
}

fn cut([a, b, c, d]: [u32; 4], positions: &[DVec3]) -> [[u32; 3]; 2] {
    let alike = |halves: [[u32; 3]; 2]| {
        let [m, n] = halves.map(|half| {
            let [p, q, r] = half.map(|v| positions[v as usize]);
            (q - p).cross(r - p).normalize_or_zero()
        });
        m.dot(n)
    };
    let (one, other) = ([[a, b, c], [a, c, d]], [[b, c, d], [b, d, a]]);
    if alike(one) >= alike(other) { one } else { other }
}

/// The surface φ = `iso` (world units, 0 for the level set's own) as quads in world units.
///
/// Limits and refusals are those of [`level_set_to_mesh`](super::level_set_to_mesh). The topology is that of its mesh, but
/// for tunnels of one voxel's width between diagonal voxels.
pub fn level_set_to_quads(level_set: &LevelSet, iso: f32, run: &RunOptions) -> Result<QuadMesh> {
    let surface = surface_of(level_set, iso, OPERATION, run)?;
    let leaves = surface.leaves();
    let quad_count: usize = surface.vertex_count();
    let vertex_count: usize = leaves.iter().map(|leaf| leaf.loops as usize).sum();
    let per_quad = size_of::<[u32; 4]>();
    let per_vertex = size_of::<DVec3>() + size_of::<CellVertices>();
    run.reserve(OPERATION, (quad_count * per_quad + vertex_count * per_vertex) as u64, MEMORY_ADVICE)?;

    let grid = level_set.grid();
    let mut cells: Vec<LeafCells> = leaves.par_iter().map(|leaf| LeafCells::new(grid, &surface, leaf)).collect();
    let mut vertices = 0u32;
    for leaf in &mut cells {
        leaf.first_vertex = vertices;
        vertices = vertices.checked_add(leaf.vertices).ok_or_else(|| {
            let accepted = "at most 4294967295 surface vertices; resample to a larger one";
            EditError::parameter(OPERATION, "voxel_size", level_set.voxel_size(), accepted)
        })?;
    }
    run.check(OPERATION)?;

    let mut positions = vec![DVec3::ZERO; vertices as usize];
    let mut quads = vec![[0; 4]; quad_count];
    let transform = level_set.transform();
    // A mirrored transform turns the orientation round.
    let mirrored = transform.to_world().matrix3.determinant() < 0.0;
    let task = run.task(OPERATION, leaves.len() as u64);
    let complete = split(leaves, &cells, &mut positions, &mut quads)
        .into_par_iter()
        .with_min_len(16)
        .map(|(leaf, own, positions, quads)| {
            if run.is_cancelled() {
                return true;
            }
            let mut accessor = grid.accessor();
            let origin = grid.origin(leaf.id);
            let mut slots = positions.iter_mut();
            for (offset, cell) in own.crossed.iter().zip(&own.cells) {
                let first = origin + offset_to_local(offset);
                let values = accessor.cell(first);
                for (edges, slot) in cell.case.loops.iter().zip(&mut slots) {
                    let inside = place(values, edges, iso, cell.case.loops.len() == 1);
                    *slot = transform.index_to_world(first.as_dvec3() + inside);
                }
            }
            task.advance(1);
            fill_quads(grid, &surface, leaf, &cells, mirrored, quads)
        })
        .all(|complete| complete);
    run.check(OPERATION)?;
    if complete {
        Ok(QuadMesh { positions, quads, ..QuadMesh::default() })
    } else {
        Err(leaves_the_band(OPERATION, "between leaves"))
    }
}

/// The vertices of a crossed cell.
struct CellVertices {
    /// Number of the first one within its leaf.
    first: u16,
    case: &'static DualCase,
}

/// The crossed cells of a leaf, numbered as the vertices of an [`IsoSurface`] are: by a mask and ranks.
struct LeafCells {
    /// Number of the leaf's first vertex.
    first_vertex: u32,
    vertices: u32,
    crossed: LeafMask,
    /// Crossed cells before each word of `crossed`.
    ranks: [u16; 8],
    cells: Vec<CellVertices>,
}

impl LeafCells {
    fn new(grid: &Grid, surface: &IsoSurface, leaf: &SurfaceLeaf) -> Self {
        let origin = grid.origin(leaf.id);
        let mut crossed = LeafMask::EMPTY;
        let mut cells = Vec::new();
        // A cell has at most 4 vertices, a leaf 2048.
        let mut vertices = 0u16;
        surface.rows(leaf).for_each_cell(|cell, pattern| {
            crossed.set(leaf_offset(cell), true);
            let beyond = |face: u8| {
                let step = IVec3::AXES[usize::from(face / 2)] * if face % 2 == 1 { 1 } else { -1 };
                pattern_at(grid, surface, origin + cell + step)
            };
            let case = dual_case(pattern, beyond);
            cells.push(CellVertices { first: vertices, case });
            vertices += case.loops.len() as u16;
        });
        let mut ranks = [0; 8];
        let mut before = 0;
        for (rank, word) in ranks.iter_mut().zip(crossed.0) {
            *rank = before;
            before += word.count_ones() as u16;
        }
        Self { first_vertex: 0, vertices: u32::from(vertices), crossed, ranks, cells }
    }

    /// The number of the vertex of `edge` of the cell at `offset`; `None` if the cell is not crossed.
    #[inline]
    fn vertex(&self, offset: usize, edge: Edge) -> Option<u32> {
        let (word, bit) = (offset >> 6, offset & 63);
        let mask = self.crossed.0[word];
        if mask >> bit & 1 == 0 {
            return None;
        }
        let rank = usize::from(self.ranks[word]) + (mask & ((1 << bit) - 1)).count_ones() as usize;
        let cell = self.cells.get(rank)?;
        Some(self.first_vertex + u32::from(cell.first) + u32::from(cell.case.vertex_of[usize::from(edge)]))
    }
}

/// The signs of any cell.
fn pattern_at(grid: &Grid, surface: &IsoSurface, cell: IVec3) -> u8 {
    (0..8).fold(0, |pattern, c| {
        let ijk = cell + corner(c);
        let inside = surface.inside(grid.find(leaf_origin(ijk))).get(leaf_offset(ijk));
        pattern | u8::from(inside) << c
    })
}

/// A leaf, its cells, its vertices and its quads.
type Part<'a> = (&'a SurfaceLeaf, &'a LeafCells, &'a mut [DVec3], &'a mut [[u32; 4]]);

/// The part of both arrays that each leaf fills.
fn split<'a>(
    leaves: &'a [SurfaceLeaf],
    cells: &'a [LeafCells],
    mut positions: &'a mut [DVec3],
    mut quads: &'a mut [[u32; 4]],
) -> Vec<Part<'a>> {
    leaves
        .iter()
        .zip(cells)
        .map(|(leaf, cells)| {
            let (p, rest) = std::mem::take(&mut positions).split_at_mut(cells.vertices as usize);
            positions = rest;
            let (q, rest) = std::mem::take(&mut quads).split_at_mut(leaf.vertices as usize);
            quads = rest;
            (leaf, cells, p, q)
        })
        .collect()
}

/// The vertex of a piece of surface that crosses `edges`, in 0..1 within its cell.
fn place(values: [f32; 8], edges: &[Edge], iso: f32, alone: bool) -> DVec3 {
    let points = edges.iter().map(|&edge| {
        let (axis, first) = EDGES[usize::from(edge)];
        let (first, last) = (usize::from(first), usize::from(first | 4 >> axis));
        let mut point = corner(first).as_dvec3();
        point[axis] = crossing(values[first], values[last], iso);
        point
    });
    let mean = points.sum::<DVec3>() / edges.len() as f64;
    if !alone {
        return mean;
    }
    let (phi, gradient) = interpolate(values, mean);
    let step = gradient * ((phi - f64::from(iso)) / gradient.length_squared());
    if step.length() <= LONGEST_STEP {
        (mean - step).clamp(DVec3::splat(VERTEX_MARGIN), DVec3::splat(1.0 - VERTEX_MARGIN))
    } else {
        mean
    }
}

/// Whether all vertices were found: the cells around an edge of a valid level set all lie in stored leaves.
fn fill_quads(
    grid: &Grid,
    surface: &IsoSurface,
    leaf: &SurfaceLeaf,
    cells: &[LeafCells],
    mirrored: bool,
    quads: &mut [[u32; 4]],
) -> bool {
    /// Where the edge lies in each of its four cells, along the two axes that follow its own: counter-clockwise seen from
    /// its upper end.
    const AROUND: [[i32; 2]; 4] = [[0, 0], [1, 0], [1, 1], [0, 1]];
    let around = &grid.neighbours()[leaf.id.index()];
    let inside = surface.inside(leaf.id);
    let mut slots = quads.iter_mut();
    let mut complete = true;
    leaf.for_each_vertex(|axis, offset| {
        let Some(slot) = slots.next() else { return };
        let voxel = offset_to_local(offset);
        let corners = AROUND.map(|[u, v]| {
            let mut within = IVec3::ZERO;
            within[(axis + 1) % 3] = u;
            within[(axis + 2) % 3] = v;
            let cell = voxel - within;
            let place = surface.place(around[neighbour_index(cell >> 3)])?;
            let edge = edge_at(axis, (within.x << 2 | within.y << 1 | within.z) as u8);
            cells.get(place)?.vertex(leaf_offset(cell), edge)
        });
        match corners {
            // The surface faces the outside end of the edge.
            [Some(a), Some(b), Some(c), Some(d)] => {
                *slot = if inside.get(offset) != mirrored { [a, b, c, d] } else { [d, c, b, a] };
            }
            _ => complete = false,
        }
    });
    complete
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Transform;
    use crate::levelset::testing::{ball, block, noise, torus};
    use crate::mesh::testing::{area_and_volume, assert_manifold, shared_mesh};
    use crate::mesh::{MeshToLevelSet, level_set_to_mesh, mesh_to_level_set};
    use std::collections::HashMap;

    fn quads(level_set: &LevelSet) -> QuadMesh {
        level_set_to_quads(level_set, 0.0, &RunOptions::default()).unwrap()
    }

    /// Asserts that each side joins two quads in opposite directions and that the quads around every vertex form one ring,
    /// and returns V − E + F.
    fn assert_quads_manifold(mesh: &QuadMesh) -> i64 {
        let mut sides = HashMap::new();
        let mut around = vec![Vec::new(); mesh.positions.len()];
        for quad in &mesh.quads {
            for i in 0..4 {
                let [before, at, after] = [quad[i], quad[(i + 1) % 4], quad[(i + 2) % 4]];
                assert!(sides.insert((before, at), ()).is_none(), "side {before}-{at} is used twice in one direction");
                around[at as usize].push((after, before));
            }
        }
        assert!(sides.keys().all(|&(from, to)| sides.contains_key(&(to, from))), "open side");
        for (v, fan) in around.iter().enumerate() {
            let next: HashMap<u32, u32> = fan.iter().copied().collect();
            let start = fan.first().unwrap_or_else(|| panic!("vertex {v} is not used")).0;
            let (mut at, mut steps) = (next[&start], 1);
            while at != start {
                at = next[&at];
                steps += 1;
            }
            assert_eq!(steps, fan.len(), "vertex {v} joins several sheets");
        }
        mesh.positions.len() as i64 - sides.len() as i64 / 2 + mesh.quads.len() as i64
    }

    #[test]
    fn area_and_volume_of_a_sphere_converge_by_the_second_order() {
        let centre = DVec3::new(0.3, -0.2, 0.1);
        let errors = [10.0, 20.0, 40.0].map(|radius| {
            let mesh = quads(&ball(centre, radius));
            assert_eq!(assert_quads_manifold(&mesh), 2);
            for p in &mesh.positions {
                // The trilinear field errs by κ h²/4 within a cell, the single step by less.
                assert!(((*p - centre).length() - radius).abs() < 0.3 / radius, "{p}");
            }
            let (area, volume) = area_and_volume(&mesh.into_triangles());
            let (true_area, true_volume) =
                (4.0 * std::f64::consts::PI * radius.powi(2), 4.0 / 3.0 * std::f64::consts::PI * radius.powi(3));
            [(area / true_area - 1.0).abs(), (volume / true_volume - 1.0).abs()]
        });
        for k in 0..2 {
            assert!(errors[2][k] < 1e-3, "{errors:?}");
            assert!(errors[0][k] / errors[1][k] > 3.0 && errors[1][k] / errors[2][k] > 3.0, "{errors:?}");
        }
    }

    #[test]
    fn a_torus_has_a_hole_and_nothing_has_no_quads() {
        let mesh = quads(&torus(20.0, 6.0));
        assert_eq!(assert_quads_manifold(&mesh), 0);
        assert_eq!(assert_manifold(&mesh.into_triangles()), 0);
        assert_eq!(quads(&LevelSet::empty(Transform::uniform(1.0), 3.0)), QuadMesh::default());
    }

    #[test]
    fn random_signs_are_manifold() {
        for (seed, inside) in [(1, 0.1), (2, 0.3), (3, 0.5), (4, 0.7), (5, 0.95), (6, 0.9), (7, 0.8)] {
            let level_set = noise(3, seed, inside);
            let mesh = quads(&level_set);
            let euler = assert_quads_manifold(&mesh);
            // A face that two cells decide the other way closes one tunnel.
            let triangles = level_set_to_mesh(&level_set, 0.0, &RunOptions::default()).unwrap();
            let of_triangles = assert_manifold(&triangles);
            assert!(euler >= of_triangles && (euler - of_triangles) % 2 == 0, "{euler} {of_triangles}");
            assert_eq!(mesh.quads.len(), triangles.positions.len());
            assert_eq!(crate::mesh::analyze(&mesh.into_triangles()).non_manifold_edges, 0);
        }
    }

    #[test]
    fn two_outside_voxels_across_a_diagonal_part() {
        // One cavity of two voxels for the triangles, two cavities for the quads.
        let cavity = block(2, |ijk| {
            let within = (ijk - 3).min_element() >= 0 && (ijk - 12).max_element() <= 0;
            let hole = ijk == IVec3::splat(7) || ijk == IVec3::new(7, 8, 8);
            if within && !hole { -0.5 } else { 0.5 }
        });
        let triangles = level_set_to_mesh(&cavity, 0.0, &RunOptions::default()).unwrap();
        assert_eq!(assert_manifold(&triangles), 4);
        assert_eq!(assert_quads_manifold(&quads(&cavity)), 6);
    }

    #[test]
    fn mirrored_transforms_and_other_iso_values() {
        let level_set = ball(DVec3::ZERO, 12.0);
        let grown = level_set_to_quads(&level_set, 1.5, &RunOptions::default()).unwrap();
        assert!(grown.positions.iter().all(|p| (p.length() - 13.5).abs() < 0.03));
        assert_eq!(level_set_to_quads(&level_set, 3.0, &RunOptions::default()).unwrap_err().exit_code(), 2);
        let (_, volume) = area_and_volume(&quads(&level_set).into_triangles());
        let mirror = glam::DAffine3::from_scale(DVec3::new(-1.0, 1.0, 1.0));
        let mirrored = quads(&level_set.with_transform(Transform::from_affine(mirror).unwrap()));
        let (_, mirrored) = area_and_volume(&mirrored.into_triangles());
        assert!(volume > 0.0 && (mirrored / volume - 1.0).abs() < 1e-9);
    }

    #[test]
    fn threads_do_not_change_the_mesh() {
        let level_set = noise(4, 11, 0.4);
        let on = |threads| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| quads(&level_set))
        };
        assert_eq!(on(1), on(3));
    }

    #[test]
    fn a_real_surface_keeps_its_volume() {
        let Some(mesh) = shared_mesh("meshes/fertility.off") else { return };

        let (level_set, _) = mesh_to_level_set(&mesh, &MeshToLevelSet::new(1.5), &RunOptions::default()).unwrap();
        let quads = quads(&level_set);
        assert_eq!(assert_quads_manifold(&quads), -6);
        let triangles = level_set_to_mesh(&level_set, 0.0, &RunOptions::default()).unwrap();
        let (a, b) = (area_and_volume(&quads.into_triangles()), area_and_volume(&triangles));
        assert!((a.0 / b.0 - 1.0).abs() < 5e-3 && (a.1 / b.1 - 1.0).abs() < 5e-3, "{a:?} {b:?}");
    }
}
