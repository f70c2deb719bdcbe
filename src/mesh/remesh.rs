//! A mesh made again after an edit: only the leaves that the edit changed.
//!
//! The vertices and triangles of a leaf depend on the values of its voxels and of those in the seven leaves above it along the axes, which its cells
//! reach into, and on how these eight leaves number their vertices: one of them may have more or fewer before those that the leaf uses, because of a
//! ninth leaf. Where all this is as before, they are copied; the numbers of the vertices grow by as much as came before them. So the mesh is that of
//! [`level_set_to_mesh`](super::level_set_to_mesh), to the bit.

use glam::{DVec3, IVec3};

use super::TriangleMesh;
use super::from_levelset::{Polygons, polygonise};
use crate::error::{EditError, Result};
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
        let last = std::mem::take(self).last.filter(is_same);
        let made = match polygonise(level_set, iso, last.as_ref(), run) {
            // There may be room for one mesh where there is none for two.
            Err(EditError::Memory { .. }) if last.is_some() => {
                drop(last);
                polygonise(level_set, iso, None, run)
            }
            made => made,
        };
        let Polygons { mesh, leaves, places, made } = made?;
        self.made = made;
        let last = Last { level_set: level_set.clone(), iso, mesh, leaves, places };
        Ok(&self.last.insert(last).mesh)
    }

    /// Leaves that were polygonised for the last mesh; the others were copied.
    pub fn made(&self) -> usize {
        self.made
    }

    /// Whether there is no mesh to take anything from.
    pub fn is_empty(&self) -> bool {
        self.last.is_none()
    }

    /// Bytes held, those of the level set's pages included.
    pub fn bytes(&self) -> u64 {
        self.last.as_ref().map_or(0, |last| {
            let mesh = size_of_val(&last.mesh.positions[..]) + size_of_val(&last.mesh.triangles[..]);
            let leaves = size_of_val(&last.leaves[..]) + size_of_val(&last.places[..]);
            last.level_set.grid().bytes() + (mesh + leaves) as u64
        })
    }
}

/// A mesh and what it was made of.
pub(super) struct Last {
    level_set: LevelSet,
    iso: f32,
    mesh: TriangleMesh,
    /// Those that the surface crossed.
    leaves: Vec<SurfaceLeaf>,
    /// The place of each among them, by slot.
    places: Vec<u32>,
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
        let old = self.leaf(was.find(origin))?;
        let shift = leaf.first_vertex.wrapping_sub(old.first_vertex);
        let around = &grid.neighbours()[leaf.id.index()];
        let is_same = |step: IVec3| {
            let (new, old) = (around[neighbour_index(step)], was.find(origin + step * LEAF_DIM));
            let same_numbers = match (surface.place(new).map(|place| &surface.leaves()[place]), self.leaf(old)) {
                (Some(new), Some(old)) => {
                    new.first_vertex == old.first_vertex.wrapping_add(shift) && new.ranks == old.ranks
                }
                (new, old) => new.is_none() && old.is_none(),
            };
            same_numbers && same_values(grid, new, was, old)
        };
        if !(0..8).all(|c| is_same(corner(c))) {
            return None;
        }
        let vertex = old.first_vertex as usize;
        Some(Kept {
            positions: self.mesh.positions.get(vertex..vertex + leaf.vertices as usize)?,
            triangles: self.mesh.triangles.get(old.first_triangle..old.first_triangle + leaf.triangles as usize)?,
            shift,
        })
    }

    fn leaf(&self, id: LeafId) -> Option<&SurfaceLeaf> {
        self.leaves.get(*self.places.get(id.index())? as usize)
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
    use crate::grid::{LeafSet, leaf_offset, leaf_origin};
    use crate::levelset::testing::{ball, block, noise};

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

    #[test]
    fn a_leaf_far_away_may_change_the_numbers_that_a_leaf_uses() {
        let run = RunOptions::default();
        // A layer that few leaves share, and rods along each axis: most neighbours of a leaf have no surface.
        let layer = |p: IVec3| (p.z as f32 - 12.3).clamp(-0.9, 0.9);
        let rod = |axis: usize| {
            move |p: IVec3| {
                let [u, v] = [1, 2].map(|k| p[(axis + k) % 3] as f32 - 15.6);
                ((u * u + v * v).sqrt() - 2.5).clamp(-0.9, 0.9)
            }
        };
        let shapes = [block(5, layer), block(5, rod(0)), block(5, rod(1)), block(5, rod(2))];
        for (n, mut level_set) in shapes.into_iter().enumerate() {
            let mut remesh = Remesh::default();
            remesh.level_set_to_mesh(&level_set, 0.0, &run).unwrap();
            let mut state = 7 + n as u64;
            let mut random = |below: u64| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) % below
            };
            let first = IVec3::new(24, 19, 13);
            for step in 0..120 {
                let ijk = if step == 0 { first } else { IVec3::from_array([0; 3].map(|_| 2 + random(36) as i32)) };
                let id = level_set.grid().find(leaf_origin(ijk));
                if id.is_sentinel() {
                    continue;
                }
                let one: LeafSet = [id].into_iter().collect();
                level_set.grid_mut().update(&one, |_, values, mask| {
                    let at = leaf_offset(ijk);
                    if mask.get(at) {
                        values.0[at] = -values.0[at];
                    }
                });
                let mesh = level_set_to_mesh(&level_set, 0.0, &run).unwrap();
                assert!(
                    *remesh.level_set_to_mesh(&level_set, 0.0, &run).unwrap() == mesh,
                    "shape {n}, step {step}, {ijk}"
                );
            }
        }
    }
}
