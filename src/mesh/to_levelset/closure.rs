//! Closing what the triangles leave open.
//!
//! The sign of a voxel is known from the winding number. Where two neighbouring voxels differ and no triangle passes between them, the
//! ½ level of the winding number does: there the surface is closed by the quads of a dual grid, one across each such
//! pair, with a vertex in each of the four cells around it at the mean of the places where the surface crosses the
//! cell's edges. A quad has a vertex in each quadrant around its pair, so it does pass between the two voxels: afterwards their
//! distances to the surface add up to no more than one voxel, and the sign never changes outside the band.
//! Leaves are added around the quads until no open pair is left; the ½ level is bounded, so that this ends.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::inside::Inside;
use crate::error::Result;
use crate::grid::{LEAF_DIM, LeafMask, LeafValues, leaf_offset, leaf_origin};
use crate::mesh::scatter::UnsignedLeaf;
use crate::mesh::winding::BATCH;
use crate::run::RunOptions;

/// Neighbouring voxels whose distances to the triangles add up to more than their own distance are not separated.
/// The excess covers the rounding of the distances.
const APART: f32 = 1.0 + 1e-5;

const AXES: [IVec3; 3] = [IVec3::X, IVec3::Y, IVec3::Z];

/// Leaves of a part that is added: a part is what one task works on.
const LEAVES_OF_A_PART: usize = 64;

/// Leaves of distances, found by origin.
#[derive(Default)]
pub(super) struct DistanceLeaves {
    /// As they were made, tile by tile: leaves are large, and not moved.
    parts: Vec<Vec<UnsignedLeaf>>,
    /// Part, and place in it.
    index: FxHashMap<IVec3, (usize, usize)>,
}

impl DistanceLeaves {
    pub fn new(parts: Vec<Vec<UnsignedLeaf>>) -> Self {
        let mut index = FxHashMap::default();
        for (part, leaves) in parts.iter().enumerate() {
            index.extend(leaves.iter().enumerate().map(|(i, leaf)| (leaf.origin, (part, i))));
        }
        Self { parts, index }
    }

    pub fn find(&self, origin: IVec3) -> Option<&LeafValues> {
        self.index.get(&origin).map(|&(part, i)| &self.parts[part][i].distance)
    }

    pub fn origins(&self) -> impl Iterator<Item = IVec3> + '_ {
        self.parts.iter().flatten().map(|leaf| leaf.origin)
    }

    /// The leaves, part by part.
    pub fn parts(&self) -> &[Vec<UnsignedLeaf>] {
        &self.parts
    }

    /// Lowers the distances to those of `other`.
    pub fn merge(&mut self, other: Vec<UnsignedLeaf>) {
        let before = self.parts.len();
        for leaf in other {
            match self.index.get(&leaf.origin) {
                Some(&(part, i)) => {
                    let values = &mut self.parts[part][i].distance.0;
                    values.iter_mut().zip(&leaf.distance.0).for_each(|(a, b)| *a = a.min(*b));
                }
                None => {
                    if self.parts[before..].last().is_none_or(|part| part.len() == LEAVES_OF_A_PART) {
                        self.parts.push(Vec::with_capacity(LEAVES_OF_A_PART));
                    }
                    let part = self.parts.len() - 1;
                    self.index.insert(leaf.origin, (part, self.parts[part].len()));
                    self.parts[part].push(leaf);
                }
            }
        }
    }
}

/// The signs of a surface's surroundings, extended as far as they are asked for.
pub(super) struct Surroundings<'a> {
    inside: &'a Inside<'a>,
    masks: FxHashMap<IVec3, LeafMask>,
}

impl<'a> Surroundings<'a> {
    pub fn new(inside: &'a Inside<'a>) -> Self {
        Self { inside, masks: FxHashMap::default() }
    }

    /// The inside of the leaf at `origin`, if it is known.
    pub fn mask(&self, origin: IVec3) -> Option<&LeafMask> {
        self.masks.get(&origin)
    }

    /// Finds the signs of the leaves at `origins`.
    pub fn extend(&mut self, origins: &[IVec3]) {
        let masks: Vec<_> = origins.par_iter().map(|&origin| (origin, self.inside.leaf(origin))).collect();
        self.masks.extend(masks);
    }

    fn is_inside(&self, ijk: IVec3) -> bool {
        self.masks.get(&leaf_origin(ijk)).is_some_and(|m| m.get(leaf_offset(ijk)))
    }

    /// The triangles that close the surface whose distances are `kept`, with the signs of everything around them. It may be open
    /// in the leaves of `kept` and those at the origins `suspects`.
    pub fn close(
        &mut self,
        kept: &DistanceLeaves,
        suspects: &[IVec3],
        half_width: f32,
        run: &RunOptions,
    ) -> Result<Vec<[DVec3; 3]>> {
        let mut fresh: Vec<IVec3> = suspects.iter().copied().chain(kept.origins()).collect();
        let mut edges: Vec<OpenEdge> = Vec::new();
        while !fresh.is_empty() {
            run.check("mesh to level set")?;
            let bytes = (self.masks.len() + fresh.len()) as u64 * 4 * 2048;
            run.reserve(
                "mesh to level set",
                bytes,
                "the mesh is open and closes far from its triangles; take a larger voxel_size",
            )?;
            fresh.sort_unstable_by_key(IVec3::to_array);
            fresh.dedup();
            self.extend(&fresh);
            // A pair is listed with its lower voxel, so the leaves below new ones are looked at again.
            let below = |o: &IVec3| AXES.map(|axis| *o - axis * LEAF_DIM);
            let mut dirty: Vec<IVec3> = fresh.iter().flat_map(below).filter(|o| self.masks.contains_key(o)).collect();
            dirty.extend(&fresh);
            dirty.sort_unstable_by_key(IVec3::to_array);
            dirty.dedup();
            let found: Vec<OpenEdge> =
                dirty.par_iter().flat_map_iter(|&origin| self.open_edges(origin, kept, half_width)).collect();
            let mut missing: FxHashSet<IVec3> = FxHashSet::default();
            for edge in &found {
                for corner in 0..8 {
                    let side = IVec3::new(corner & 1, corner >> 1 & 1, corner >> 2 & 1);
                    let ijk = IVec3::from_array(edge.ijk) - 1 + side * (AXES[edge.axis] + 2);
                    missing.insert(leaf_origin(ijk));
                }
            }
            edges.extend(found);
            fresh = missing.into_iter().filter(|o| !self.masks.contains_key(o)).collect();
        }
        edges.sort_unstable();
        edges.dedup();
        Ok(self.quads(&edges, kept, half_width))
    }

    /// The pairs of a voxel of the leaf at `origin` and its upper neighbours that differ with no surface between.
    fn open_edges(&self, origin: IVec3, kept: &DistanceLeaves, half_width: f32) -> Vec<OpenEdge> {
        let mut edges = Vec::new();
        let Some(mask) = self.masks.get(&origin) else { return edges };
        let own = kept.find(origin);
        for (axis, step) in AXES.into_iter().enumerate() {
            let neighbour = origin + step * LEAF_DIM;
            let beyond = kept.find(neighbour);
            for offset in differing(mask, self.masks.get(&neighbour), axis).iter() {
                let ijk = origin + crate::grid::offset_to_local(offset);
                let next = ijk + step;
                let next_leaf = if leaf_origin(next) == origin { own } else { beyond };
                let distance = |leaf: Option<&LeafValues>, o: usize| leaf.map_or(half_width, |l| l.0[o]);
                if distance(own, offset) + distance(next_leaf, leaf_offset(next)) > APART {
                    edges.push(OpenEdge { ijk: ijk.to_array(), axis });
                }
            }
        }
        edges
    }

    /// The quads across open edges, as triangles.
    fn quads(&self, edges: &[OpenEdge], kept: &DistanceLeaves, half_width: f32) -> Vec<[DVec3; 3]> {
        let places =
            edges.par_chunks(BATCH / 2).flat_map_iter(|chunk| chunk.iter().copied().zip(self.half_levels(chunk)));
        let crossing: FxHashMap<OpenEdge, f64> = places.collect();
        let distance = |ijk: IVec3| kept.find(leaf_origin(ijk)).map_or(half_width, |l| l.0[leaf_offset(ijk)]) as f64;
        let vertex = |cell: IVec3| {
            let mut sum = DVec3::ZERO;
            let mut count = 0.0;
            for (axis, step) in AXES.into_iter().enumerate() {
                let (u, v) = (AXES[(axis + 1) % 3], AXES[(axis + 2) % 3]);
                for ijk in [cell, cell + u, cell + v, cell + u + v] {
                    if self.is_inside(ijk) == self.is_inside(ijk + step) {
                        continue;
                    }
                    let t = crossing.get(&OpenEdge { ijk: ijk.to_array(), axis }).copied().unwrap_or_else(|| {
                        let (a, b) = (distance(ijk), distance(ijk + step));
                        if a + b > 0.0 { a / (a + b) } else { 0.5 }
                    });
                    sum += ijk.as_dvec3() + step.as_dvec3() * t;
                    count += 1.0;
                }
            }
            // An open edge of the cell is always among them.
            sum / f64::max(count, 1.0)
        };
        let around = |edge: &OpenEdge| {
            let ijk = IVec3::from_array(edge.ijk);
            let (u, v) = (AXES[(edge.axis + 1) % 3], AXES[(edge.axis + 2) % 3]);
            [ijk - u - v, ijk - v, ijk, ijk - u]
        };
        // Each cell lies beside several edges.
        let mut cells: Vec<IVec3> = edges.iter().flat_map(around).collect();
        cells.par_sort_unstable_by_key(IVec3::to_array);
        cells.dedup();
        let vertices: FxHashMap<IVec3, DVec3> = cells.par_iter().map(|&cell| (cell, vertex(cell))).collect();
        let quad = |edge| around(edge).map(|cell| vertices[&cell]);
        edges.iter().map(quad).flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect()
    }

    /// Where along open edges that lie near each other, half a batch at most, the winding number is ½.
    fn half_levels(&self, edges: &[OpenEdge]) -> [f64; BATCH / 2] {
        let edge = |i: usize| edges[i.min(edges.len() - 1)];
        let end = |i: usize| IVec3::from_array(edge(i / 2).ijk) + AXES[edge(i / 2).axis] * (i % 2) as i32;
        let windings = self.inside.windings(&std::array::from_fn(end));
        std::array::from_fn(|i| {
            let (a, b) = (windings[2 * i] - 0.5, windings[2 * i + 1] - 0.5);
            // At the edge of a sheet the two may not bracket ½, where the sign came from crossings.
            if a * b < 0.0 { a / (a - b) } else { 0.5 }
        })
    }
}

/// A voxel and the axis to its upper neighbour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct OpenEdge {
    ijk: [i32; 3],
    axis: usize,
}

/// The voxels of a leaf whose upper neighbour along `axis` is on the other side, as far as that is known.
fn differing(mask: &LeafMask, beyond: Option<&LeafMask>, axis: usize) -> LeafMask {
    /// In a word, the voxels with z = 0.
    const Z_FIRST: u64 = 0x0101_0101_0101_0101;
    let m = &mask.0;
    // Where nothing is known beyond, the last layer is its own neighbour.
    let edge = beyond.map_or_else(
        || match axis {
            0 => LeafMask([m[7]; 8]),
            1 => LeafMask(m.map(|w| w >> 56)),
            _ => LeafMask(m.map(|w| w >> 7 & Z_FIRST)),
        },
        |b| *b,
    );
    LeafMask(std::array::from_fn(|x| {
        let upper = match axis {
            0 => m.get(x + 1).copied().unwrap_or(edge.0[0]),
            1 => m[x] >> 8 | edge.0[x] << 56,
            _ => (m[x] >> 1 & !(Z_FIRST << 7)) | (edge.0[x] & Z_FIRST) << 7,
        };
        m[x] ^ upper
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{LEAF_VOXELS, offset_to_local};

    #[test]
    fn differing_by_words_equals_differing_by_voxels() {
        let random = |salt: usize| {
            let mut mask = LeafMask::EMPTY;
            (0..LEAF_VOXELS).for_each(|o| mask.set(o, crate::mesh::testing::noise(o + salt) < 0.5));
            mask
        };
        let mask = random(0);
        for beyond in [None, Some(random(1000))] {
            for (axis, step) in AXES.into_iter().enumerate() {
                let result = differing(&mask, beyond.as_ref(), axis);
                for o in 0..LEAF_VOXELS {
                    let next = offset_to_local(o) + step;
                    let other = if leaf_origin(next) == IVec3::ZERO {
                        mask.get(leaf_offset(next))
                    } else {
                        beyond.map_or(mask.get(o), |b| b.get(leaf_offset(next)))
                    };
                    assert_eq!(result.get(o), mask.get(o) != other, "{axis} {o}");
                }
            }
        }
    }
}
