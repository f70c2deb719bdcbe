//! A mesh made again after an edit: only the leaves that the edit changed.
//!
//! The vertices and triangles of a leaf depend on the values of its voxels and of those in the seven leaves above it along the axes, which its cells
//! reach into. Where these are the same bits as before, they are copied; the numbers of the vertices grow by as much as came before them. So the
//! mesh is that of [`level_set_to_mesh`](super::level_set_to_mesh), to the bit.

use glam::{DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::TriangleMesh;
use super::from_levelset::polygonise;
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LeafId, neighbour_index};
use crate::levelset::LevelSet;
use crate::levelset::isosurface::{IsoSurface, SurfaceLeaf, corner};
use crate::run::RunOptions;

/// The last mesh of a surface, from which the next one takes what has not changed.
#[derive(Default)]
pub struct Remesh {
    last: Option<Last>,
    /// Leaves that were polygonised for the last mesh.
    made: usize,
}

impl Remesh {
    /// As [`level_set_to_mesh`](super::level_set_to_mesh).
    pub fn level_set_to_mesh(&mut self, level_set: &LevelSet, iso: f32, run: &RunOptions) -> Result<&TriangleMesh> {
        let is_same = |last: &Last| last.iso == iso && last.level_set.transform() == level_set.transform();
        let last = self.last.take().filter(is_same);
        let (mesh, leaves, made) = polygonise(level_set, iso, last.as_ref(), run)?;
        self.made = made;
        Ok(&self.last.insert(Last { level_set: level_set.clone(), iso, mesh, leaves }).mesh)
    }

    /// Leaves that were polygonised for the last mesh; the others were copied.
    pub fn made(&self) -> usize {
        self.made
    }

    /// Bytes held, those of the level set's pages included.
    pub fn bytes(&self) -> u64 {
        self.last.as_ref().map_or(0, |last| {
            let mesh = size_of_val(&last.mesh.positions[..]) + size_of_val(&last.mesh.triangles[..]);
            let leaves = last.leaves.capacity() * size_of::<(IVec3, Place)>();
            last.level_set.grid().bytes() + (mesh + leaves) as u64
        })
    }
}

/// A mesh and what it was made of.
pub(super) struct Last {
    level_set: LevelSet,
    iso: f32,
    mesh: TriangleMesh,
    leaves: Places,
}

/// Where the vertices and triangles of each leaf are, by its origin.
pub(super) type Places = FxHashMap<IVec3, Place>;

/// Where the vertices and triangles of a leaf are.
#[derive(Clone, Copy)]
pub(super) struct Place {
    first_vertex: u32,
    first_triangle: usize,
}

/// Where the leaves of a surface have theirs.
pub(super) fn places(grid: &Grid, surface: &IsoSurface) -> Places {
    let mut first_triangle = 0;
    let place = |leaf: &SurfaceLeaf| {
        let place = Place { first_vertex: leaf.first_vertex, first_triangle };
        first_triangle += leaf.triangles as usize;
        (grid.origin(leaf.id), place)
    };
    surface.leaves().iter().map(place).collect()
}

/// What a leaf had in the last mesh.
pub(super) struct Kept<'a> {
    pub positions: &'a [DVec3],
    pub triangles: &'a [[u32; 3]],
    /// What the numbers of vertices grow by, modulo 2³².
    pub shift: u32,
}

impl Last {
    /// What a leaf had, if it has the same now.
    pub fn kept(&self, grid: &Grid, surface: &IsoSurface, leaf: &SurfaceLeaf) -> Option<Kept<'_>> {
        let (was, origin) = (self.level_set.grid(), grid.origin(leaf.id));
        let place = self.leaves.get(&origin)?;
        let shift = leaf.first_vertex.wrapping_sub(place.first_vertex);
        let around = &grid.neighbours()[leaf.id.index()];
        let is_same = |step: IVec3| {
            let (id, origin) = (around[neighbour_index(step)], origin + step * LEAF_DIM);
            let first_vertex = surface.place(id).map(|at| surface.leaves()[at].first_vertex.wrapping_sub(shift));
            first_vertex == self.leaves.get(&origin).map(|place| place.first_vertex)
                && same_values(grid, id, was, was.find(origin))
        };
        if !(0..8).all(|c| is_same(corner(c))) {
            return None;
        }
        let (vertex, triangle) = (place.first_vertex as usize, place.first_triangle);
        Some(Kept {
            positions: self.mesh.positions.get(vertex..vertex + leaf.vertices as usize)?,
            triangles: self.mesh.triangles.get(triangle..triangle + leaf.triangles as usize)?,
            shift,
        })
    }
}

/// Whether two leaves hold the same bits.
fn same_values(a: &Grid, in_a: LeafId, b: &Grid, in_b: LeafId) -> bool {
    let (a, b) = (a.values(in_a), b.values(in_b));
    std::ptr::eq(a, b) || a.0.iter().zip(&b.0).all(|(a, b)| a.to_bits() == b.to_bits())
}

#[cfg(test)]
mod tests {
    use super::super::level_set_to_mesh;
    use super::*;
    use crate::grid::LeafSet;
    use crate::levelset::testing::{ball, noise};

    #[test]
    fn the_mesh_is_that_of_making_all_of_it() {
        let run = RunOptions::default();
        let mut remesh = Remesh::default();
        let check = |remesh: &mut Remesh, level_set: &LevelSet, iso: f32| {
            let mesh = level_set_to_mesh(level_set, iso, &run).unwrap();
            assert!(*remesh.level_set_to_mesh(level_set, iso, &run).unwrap() == mesh);
            remesh.made()
        };
        let mut level_set = noise(6, 1, 0.4);
        let all = check(&mut remesh, &level_set, 0.0);
        assert_eq!(check(&mut remesh, &level_set, 0.0), 0);
        // Values without signs, then signs: the numbers of all that comes after change.
        let ids: Vec<LeafId> = level_set.grid().leaves().to_vec();
        for (n, factor) in [(70, 0.5), (90, -1.0), (1, -0.25)] {
            let one: LeafSet = [ids[n]].into_iter().collect();
            level_set.grid_mut().update(&one, |_, values, mask| mask.iter().for_each(|at| values.0[at] *= factor));
            // The leaf and the seven whose cells reach into it; after it some whose vertices have grown by other numbers.
            let made = check(&mut remesh, &level_set, 0.0);
            assert!((1..all / 2).contains(&made), "{made} of {all}");
        }
        // Another value, another shape in other slots, none, and the first again.
        assert_eq!(check(&mut remesh, &level_set, 0.1), all);
        let moved = ball(DVec3::new(0.4, 0.0, 0.0), 12.0);
        for shape in [&moved, &LevelSet::empty(*moved.transform(), 3.0), &moved, &ball(DVec3::ZERO, 12.0)] {
            check(&mut remesh, shape, 0.0);
        }
        let copy = LevelSet::new(moved.grid().deep_copy(), *moved.transform());
        check(&mut remesh, &moved, 0.0);
        assert_eq!(check(&mut remesh, &copy, 0.0), 0);
    }
}
