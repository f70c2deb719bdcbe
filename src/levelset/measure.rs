//! Area, volume, curvature and topology of the surface, without building a mesh.
//!
//! All of these are exact for the polygonised surface that `mesh::level_set_to_mesh` makes:
//!
//! > area = Σ |n|, n = (b − a) × (c − a) / 2 over its triangles;  volume = Σ a · (b × c) / 6 (divergence theorem);
//! > ∫ H dA = ½ Σ length · exterior angle over its edges (Steiner's formula for polyhedra; 4πR on a sphere, H = (κ1+κ2)/2);
//! > χ = loops − crossed grid edges: each vertex lies on a grid edge with four cells around it, so there are twice as many
//! > segments as vertices, and V − E + F is V − 2V + loops.
//!
//! Area, volume and ∫ H dA converge to those of the true surface with the square of the voxel size where it is
//! smooth; a sphere of R voxels is within 0.32 / R², 0.61 / R² and 0.12 / R² of them (measured, R = 10..40). Sharp
//! edges are chamfered by less than a voxel, an error of first order in area. A solid ball with a cavity has one
//! component, two surface components and χ = 4. Sums go by the order of leaves and do not depend on the number of
//! threads.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use serde::Serialize;

use super::LevelSet;
use super::components;
use super::isosurface::{CellVertices, IsoSurface, MEMORY_ADVICE, SurfaceLeaf, corner, crossing};
use super::marching::{EDGES, MAX_TRIANGLES, across, cell_case};
use super::union_find::UnionFind;
use crate::error::Result;
use crate::grid::Grid;
use crate::run::RunOptions;
use crate::stencil::Halo;

/// What [`LevelSet::measure`] finds. World units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Measures {
    /// Area of the surface.
    pub area: f64,
    /// Volume inside.
    pub volume: f64,
    /// ∫ H dA with H = (κ1+κ2)/2, positive on convex surfaces.
    pub mean_curvature_integral: f64,
    /// Connected parts of the inside.
    pub components: u64,
    /// Connected parts of the surface: a cavity has one of its own.
    pub surface_components: u64,
    /// Euler characteristic of the surface: 2 for each sphere, 0 for each torus.
    pub euler: i64,
}

impl LevelSet {
    /// Measures the zero set. What of the surface lies outside the stored leaves (see [`check`](Self::check)) is not
    /// seen.
    pub fn measure(&self, run: &RunOptions) -> Result<Measures> {
        const OPERATION: &str = "measuring a level set";
        let surface = IsoSurface::new(self.grid(), 0.0, OPERATION, run)?;
        run.reserve(OPERATION, surface.vertex_count() as u64 * 4, MEMORY_ADVICE)?;
        let leaves = surface.leaves();
        // Positions are taken relative to each leaf, and leaves to the first one: far from the origin nothing is lost.
        let reference = leaves.first().map_or(IVec3::ZERO, |leaf| self.grid().origin(leaf.id));
        let sums: Vec<Sums> =
            leaves.par_iter().with_min_len(16).map(|leaf| leaf_sums(self.grid(), &surface, leaf)).collect();
        run.check(OPERATION)?;
        let mut measures = Measures::default();
        let (mut loops, mut volume) = (0, 0.0);
        for (leaf, sums) in leaves.iter().zip(sums) {
            let place = (self.grid().origin(leaf.id) - reference).as_dvec3();
            measures.area += sums.area;
            volume += sums.volume + place.dot(sums.area_vector) / 3.0;
            measures.mean_curvature_integral += sums.mean_curvature;
            loops += i64::from(leaf.loops);
        }
        let voxel_size = self.voxel_size();
        measures.area *= voxel_size * voxel_size;
        measures.volume = volume * voxel_size * voxel_size * voxel_size;
        measures.mean_curvature_integral *= voxel_size;
        measures.euler = loops - surface.vertex_count() as i64;
        measures.surface_components = surface_components(&surface);
        run.check(OPERATION)?;
        run.reserve(OPERATION, components::bytes_needed(self.grid()), MEMORY_ADVICE)?;
        measures.components = components::count(self.grid(), &surface);
        Ok(measures)
    }
}

/// Sums over the cells of a leaf, in voxels, relative to the leaf's first voxel.
#[derive(Default)]
struct Sums {
    area: f64,
    area_vector: DVec3,
    volume: f64,
    mean_curvature: f64,
}

fn leaf_sums(grid: &Grid, surface: &IsoSurface, leaf: &SurfaceLeaf) -> Sums {
    let mut halo = Halo::new();
    halo.gather(grid.value_pages(), &grid.neighbours()[leaf.id.index()]);
    let mut sums = Sums::default();
    surface.rows(leaf).for_each_cell(|cell, pattern| {
        let case = cell_case(pattern);
        let points = Points::new(&halo, cell);
        let mut normals = [DVec3::ZERO; MAX_TRIANGLES];
        for (triangle, normal) in case.triangles.iter().zip(&mut normals) {
            let [a, b, c] = triangle.map(|e| points.at(e));
            *normal = (b - a).cross(c - a);
            sums.area += normal.length() / 2.0;
            sums.area_vector += *normal / 2.0;
            sums.volume += a.dot(*normal) / 6.0;
        }
        for &([from, to], triangles) in &case.diagonals {
            let [first, second] = triangles.map(|t| normals[usize::from(t)]);
            sums.mean_curvature += edge_curvature(points.at(to) - points.at(from), first, second);
        }
        // Segments on the upper faces belong to the cells beyond.
        for segment in case.segments.iter().filter(|s| s.face % 2 == 0) {
            let axis = usize::from(segment.face / 2);
            let beside = Points::new(&halo, cell - IVec3::AXES[axis]);
            let other = cell_case(beside.pattern());
            let [from, to] = segment.ends;
            let ends = [across(to, axis), across(from, axis)];
            let facing = other.segments.iter().find(|s| s.face == segment.face + 1 && s.ends == ends);
            if let Some(facing) = facing {
                let [a, b, c] = other.triangles[usize::from(facing.triangle)].map(|e| beside.at(e));
                let normal = normals[usize::from(segment.triangle)];
                sums.mean_curvature += edge_curvature(points.at(to) - points.at(from), normal, (b - a).cross(c - a));
            }
        }
    });
    sums
}

/// ½ · length · exterior angle of the edge `along`, which the triangle with normal `first` follows in its own
/// direction.
fn edge_curvature(along: DVec3, first: DVec3, second: DVec3) -> f64 {
    let length = along.length();
    // The arguments need no unit normals: both carry the same factor.
    0.5 * length * along.dot(first.cross(second)).atan2(length * first.dot(second))
}

/// The values and vertices of a cell, in voxels relative to its leaf.
struct Points {
    cell: DVec3,
    values: [f32; 8],
}

impl Points {
    /// The cell with the given first corner, −1..8 along each axis.
    #[inline(always)]
    fn new(halo: &Halo, cell: IVec3) -> Self {
        let values = std::array::from_fn(|c| halo.value(cell + corner(c)));
        Self { cell: cell.as_dvec3(), values }
    }

    fn pattern(&self) -> u8 {
        self.values.iter().rev().fold(0, |pattern, v| pattern << 1 | u8::from(*v < 0.0))
    }

    #[inline(always)]
    fn at(&self, edge: u8) -> DVec3 {
        let (axis, first) = EDGES[usize::from(edge)];
        let first = usize::from(first);
        let mut position = self.cell + corner(first).as_dvec3();
        position[axis] += crossing(self.values[first], self.values[first | 4 >> axis], 0.0);
        position
    }
}

fn surface_components(surface: &IsoSurface) -> u64 {
    let sets = UnionFind::new(surface.vertex_count());
    surface.leaves().par_iter().with_min_len(16).for_each_init(CellVertices::new, |vertices, leaf| {
        vertices.take(surface, leaf);
        surface.rows(leaf).for_each_cell(|cell, pattern| {
            for &[a, b, c] in &cell_case(pattern).triangles {
                let first = vertices.vertex(cell, a);
                for other in [b, c] {
                    if let (Some(v), Some(w)) = (first, vertices.vertex(cell, other)) {
                        sets.join(v, w);
                    }
                }
            }
        });
    });
    sets.count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Transform;
    use crate::levelset::testing::{ball, block, box_distance, noise, sampled, torus};
    use std::f64::consts::PI;

    fn measure(level_set: &LevelSet) -> Measures {
        level_set.measure(&RunOptions::default()).unwrap()
    }

    fn topology(level_set: &LevelSet) -> (u64, u64, i64) {
        let m = measure(level_set);
        (m.components, m.surface_components, m.euler)
    }

    #[test]
    fn area_volume_and_curvature_of_spheres_converge_to_second_order() {
        for radius in [10.0, 20.0, 40.0] {
            // Several positions in the grid: a single one may be lucky.
            let mut worst = [0.0f64; 3];
            for centre in [DVec3::ZERO, DVec3::new(0.31, -0.47, 0.13), DVec3::splat(0.5)] {
                let m = measure(&ball(centre, radius));
                let truth = [4.0 * PI * radius * radius, 4.0 / 3.0 * PI * radius.powi(3), 4.0 * PI * radius];
                for ((w, found), truth) in
                    worst.iter_mut().zip([m.area, m.volume, m.mean_curvature_integral]).zip(truth)
                {
                    *w = w.max((found / truth - 1.0).abs());
                }
                assert_eq!((m.components, m.surface_components, m.euler), (1, 1, 2));
            }
            for (w, limit) in worst.iter().zip([0.32, 0.61, 0.12]) {
                assert!(*w < limit / (radius * radius), "{radius}: {worst:?}");
            }
        }
    }

    #[test]
    fn measures_of_a_torus_and_a_box() {
        let (major, minor) = (24.0, 8.0);
        let m = measure(&torus(major, minor));
        assert!((m.area / (4.0 * PI * PI * major * minor) - 1.0).abs() < 5e-3);
        assert!((m.volume / (2.0 * PI * PI * major * minor * minor) - 1.0).abs() < 5e-3);
        // Pappus: ∫ H dA = 2π² R on a torus of revolution.
        assert!((m.mean_curvature_integral / (2.0 * PI * PI * major) - 1.0).abs() < 1e-2);
        assert_eq!((m.components, m.surface_components, m.euler), (1, 1, 0));

        // A box whose faces lie a quarter of a voxel beyond the last voxels inside: its edges are chamfered by as much,
        // which costs (2 − √2) c of area and c²/2 of volume a unit of length. ∫ H dA = π · the sum of the edges / 4.
        let (half, chamfer) = (12.25, 0.25);
        let m = measure(&sampled(20, move |p| box_distance(p, DVec3::splat(half))));
        let edge = 2.0 * half;
        let area = 6.0 * edge * edge - 12.0 * edge * chamfer * (2.0 - 2f64.sqrt());
        let volume = edge.powi(3) - 12.0 * edge * chamfer * chamfer / 2.0;
        assert!((m.area - area).abs() < 1.0 && (m.volume - volume).abs() < 1.0);
        assert!((m.mean_curvature_integral / (3.0 * PI * edge) - 1.0).abs() < 1e-2);
        assert_eq!((m.components, m.surface_components, m.euler), (1, 1, 2));
    }

    #[test]
    fn world_units_and_far_places() {
        let at_home = measure(&ball(DVec3::splat(0.25), 10.0));
        // A small voxel size, a mirrored and rotated transform: only the unit changes.
        let rotation = glam::DQuat::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 1.0);
        let affine =
            glam::DAffine3::from_scale_rotation_translation(DVec3::new(0.01, 0.01, -0.01), rotation, DVec3::splat(9.0));
        let transform = Transform::from_affine(affine).unwrap();
        let bounds = (IVec3::splat(-16), IVec3::splat(16));
        let distance = |p: DVec3| (p - DVec3::splat(0.25)).length() - 10.0;
        let small = LevelSet::from_distance(transform, 3.0, bounds, distance, &RunOptions::default()).unwrap();
        let m = measure(&small);
        assert!((m.area / at_home.area / 1e-4 - 1.0).abs() < 1e-5);
        assert!((m.volume / at_home.volume / 1e-6 - 1.0).abs() < 1e-5);
        assert!((m.mean_curvature_integral / at_home.mean_curvature_integral / 1e-2 - 1.0).abs() < 1e-4);
        // A million voxels away.
        let far = DVec3::splat(f64::from(1 << 20));
        let bounds = (IVec3::splat((1 << 20) - 16), IVec3::splat((1 << 20) + 16));
        let moved = LevelSet::from_distance(
            Transform::uniform(1.0),
            3.0,
            bounds,
            |p| distance(p - far),
            &RunOptions::default(),
        );
        let m = measure(&moved.unwrap());
        assert!((m.volume / at_home.volume - 1.0).abs() < 1e-9 && (m.area / at_home.area - 1.0).abs() < 1e-9);
    }

    #[test]
    fn components_and_euler_numbers() {
        let length = |p: DVec3| p.length();
        assert_eq!(topology(&LevelSet::empty(Transform::uniform(1.0), 3.0)), (0, 0, 0));
        // A cavity; balls within balls, large enough for solid leaves between them; two apart.
        assert_eq!(topology(&sampled(34, |p| (p.length() - 20.0).abs() - 10.0)), (1, 2, 4));
        let onion = |p: DVec3| ((length(p) - 60.0).abs() - 30.0).min(length(p) - 20.0);
        assert_eq!(topology(&sampled(96, onion)), (2, 3, 6));
        let pair = |p: DVec3| (p.abs() - DVec3::new(30.0, 0.0, 0.0)).length() - 25.0;
        assert_eq!(topology(&sampled(64, pair)), (2, 2, 4));
        // So large that whole nodes are solid.
        assert_eq!(topology(&sampled(220, |p| box_distance(p, DVec3::new(210.0, 180.0, 200.0)))), (1, 1, 2));

        // Level 2 of Menger's sponge (walls 6 voxels): genus 81, so χ = 2 − 162.
        let sponge = |p: DVec3| {
            let hole = |scale: f64| {
                let q = ((p / scale + 0.5).rem_euclid(DVec3::ONE) - 0.5).abs() * scale;
                let w = scale / 6.0;
                (w - q.x.max(q.y)).max(w - q.y.max(q.z)).max(w - q.z.max(q.x))
            };
            box_distance(p, DVec3::splat(27.0)).max(hole(54.0)).max(hole(18.0))
        };
        let sponge = sampled(32, sponge);
        assert_eq!(topology(&sponge), (1, 1, 2 - 2 * 81));
    }

    #[test]
    fn cubes_that_touch_at_an_edge_or_a_corner_stay_apart() {
        let cubes = |offset: IVec3| {
            block(3, move |ijk| {
                let within = |lo: IVec3| (ijk - lo).min_element() >= 0 && (ijk - lo).max_element() < 4;
                if within(IVec3::splat(5)) || within(IVec3::splat(5) + offset * 4) { -0.5 } else { 0.5 }
            })
        };
        assert_eq!(topology(&cubes(IVec3::new(1, 1, 0))), (2, 2, 4));
        assert_eq!(topology(&cubes(IVec3::ONE)), (2, 2, 4));
        assert_eq!(topology(&cubes(IVec3::X)), (1, 1, 2));
    }

    /// Parts of the voxels with `inside(ijk) == side`, by flood fill over neighbours that `joined` allows.
    fn flooded(level_set: &LevelSet, size: i32, side: bool, diagonals: bool) -> u64 {
        let mut accessor = level_set.grid().accessor();
        let mut is = |p: IVec3| (accessor.value(p) < 0.0) == side;
        let mut seen = std::collections::HashSet::new();
        let mut parts = 0;
        for i in 0..size.pow(3) {
            let seed = IVec3::new(i / (size * size), i / size % size, i % size);
            if !is(seed) || !seen.insert(seed) {
                continue;
            }
            parts += 1;
            let mut front = vec![seed];
            while let Some(p) = front.pop() {
                for q in 0..27 {
                    let d = IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1);
                    let next = p + d;
                    let near = d.abs().element_sum() == 1 || (diagonals && d.abs().element_sum() == 2);
                    if near && next.min_element() >= 0 && next.max_element() < size && is(next) && seen.insert(next) {
                        front.push(next);
                    }
                }
            }
        }
        parts
    }

    #[test]
    fn random_signs_against_flood_fills() {
        for (seed, inside) in [(1, 0.1), (2, 0.3), (3, 0.5), (4, 0.7), (5, 0.95)] {
            let level_set = noise(3, seed, inside);
            let m = measure(&level_set);
            let solid = flooded(&level_set, 24, true, false);
            assert_eq!(m.components, solid, "{seed}");
            // Each closed surface separates one part of the inside from one of the outside, and they form a tree.
            assert_eq!(m.surface_components, solid + flooded(&level_set, 24, false, true) - 1, "{seed}");
        }
    }

    #[test]
    fn threads_do_not_change_a_bit() {
        let level_set = noise(4, 9, 0.4);
        let on = |threads| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| measure(&level_set))
        };
        let (one, three) = (on(1), on(3));
        assert_eq!(one, three);
        assert_eq!(one.mean_curvature_integral.to_bits(), three.mean_curvature_integral.to_bits());
    }

    #[test]
    fn invalid_fields_do_not_panic() {
        let holed = {
            let mut holed = ball(DVec3::ZERO, 20.0);
            holed.grid_mut().set_sign(IVec3::splat(-8), IVec3::splat(8), false);
            holed.grid_mut().update_all(|id, values, _| {
                if id.index() % 5 == 0 {
                    values.0.fill(f32::NAN);
                }
            });
            holed
        };
        let m = measure(&holed);
        assert!(m.area.is_finite() && m.components >= 1);
    }
}
