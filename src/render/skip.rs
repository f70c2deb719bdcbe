//! Where a ray may meet the surface at all: a coarse map of empty space.
//!
//! The space around the leaves is divided into cubic blocks: single leaves, or larger ones when those would be too many.
//! Every block knows how many blocks away (in the maximum norm) the nearest one is that holds a sign change, so a ray
//! crosses empty space, outside and inside, in a few jumps.

use glam::{DVec3, IVec3};

use crate::grid::{Grid, LeafId};
use crate::stencil::Halo;

/// Most blocks in the map: 2 MiB, built in about 50 ms. A larger object gets larger blocks.
const MAX_BLOCKS: u64 = 1 << 21;

/// Distances to the nearest block with surface, in blocks.
pub(super) struct SkipMap {
    /// First block, in blocks.
    lo: IVec3,
    size: IVec3,
    /// log2 of a block's edge in voxels.
    shift: u32,
    distance: Vec<u8>,
}

impl SkipMap {
    /// The map of a grid; `None` when no cell of it changes sign.
    pub fn new(grid: &Grid) -> Option<Self> {
        let mut marked: Vec<IVec3> =
            grid.map_leaves(|id| leaves_with_surface(grid, id)).into_iter().flatten().collect();
        marked.extend(bare_faces(grid));
        let lo = marked.iter().copied().reduce(IVec3::min)?;
        let hi = marked.iter().copied().reduce(IVec3::max)?;
        let mut shift = 3;
        let size_at = |shift: u32| (hi >> shift) - (lo >> shift) + 1;
        while size_at(shift).to_array().iter().map(|&n| n as u64).product::<u64>() > MAX_BLOCKS {
            shift += 1;
        }
        let size = size_at(shift);
        let mut map = Self { lo: lo >> shift, size, shift, distance: Vec::new() };
        map.distance = vec![u8::MAX; (size.x * size.y * size.z) as usize];
        for origin in marked {
            let at = map.index((origin >> shift) - map.lo);
            map.distance[at] = 0;
        }
        map.spread();
        Some(map)
    }

    fn index(&self, local: IVec3) -> usize {
        ((local.x * self.size.y + local.y) * self.size.z + local.z) as usize
    }

    /// Two passes over all blocks, each looking at the 13 neighbours that the pass has seen: exact in the maximum norm.
    fn spread(&mut self) {
        let before: Vec<IVec3> = (0..13).map(|q| IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1)).collect();
        let count = self.distance.len();
        for backwards in [false, true] {
            for i in 0..count {
                let at = if backwards { count - 1 - i } else { i };
                let mut best = self.distance[at];
                if best == 0 {
                    continue;
                }
                let flat = at as i32;
                let local = IVec3::new(
                    flat / (self.size.y * self.size.z),
                    flat / self.size.z % self.size.y,
                    flat % self.size.z,
                );
                for &step in &before {
                    let beside = if backwards { local - step } else { local + step };
                    if beside.cmpge(IVec3::ZERO).all() && beside.cmplt(self.size).all() {
                        best = best.min(self.distance[self.index(beside)].saturating_add(1));
                    }
                }
                self.distance[at] = best;
            }
        }
    }

    /// The box of all blocks with surface, in index space.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let edge = f64::from(1u32 << self.shift);
        (self.lo.as_dvec3() * edge, (self.lo + self.size).as_dvec3() * edge)
    }

    /// The boxes of the blocks that may hold surface, in index space.
    pub fn blocks(&self) -> impl Iterator<Item = (DVec3, DVec3)> + '_ {
        (0..self.distance.len()).filter(|n| self.distance[*n] == 0).map(|n| self.block_at(n))
    }

    /// The block of a cell.
    #[inline(always)]
    pub fn block(&self, cell: IVec3) -> IVec3 {
        cell >> self.shift
    }

    /// The box around a block that holds no surface, in index space: `None` if the block itself may hold some.
    #[inline(always)]
    pub fn empty_around(&self, block: IVec3) -> Option<(DVec3, DVec3)> {
        let distance = i32::from(self.distance[self.index((block - self.lo).clamp(IVec3::ZERO, self.size - 1))]);
        if distance == 0 {
            return None;
        }
        let edge = f64::from(1u32 << self.shift);
        Some(((block - (distance - 1)).as_dvec3() * edge, (block + distance).as_dvec3() * edge))
    }

    /// Whether both maps have the same blocks.
    pub fn is_congruent(&self, other: &Self) -> bool {
        (self.lo, self.size, self.shift) == (other.lo, other.size, other.shift)
    }

    /// The boxes of the blocks that hold surface in one of two maps with the same blocks, and not in the other.
    pub fn changed<'a>(&'a self, before: &'a Self) -> impl Iterator<Item = (DVec3, DVec3)> + 'a {
        let changed = move |n: &usize| (self.distance[*n] == 0) != (before.distance[*n] == 0);
        (0..self.distance.len()).filter(changed).map(|n| self.block_at(n))
    }

    /// The box of a block by its place.
    fn block_at(&self, n: usize) -> (DVec3, DVec3) {
        let (n, row, edge) = (n as i32, self.size.z, f64::from(1u32 << self.shift));
        let lo = (self.lo + IVec3::new(n / (self.size.y * row), n / row % self.size.y, n % row)).as_dvec3() * edge;
        (lo, lo + edge)
    }

    /// Bytes of the map.
    pub const MAX_BYTES: u64 = MAX_BLOCKS;
}

/// Origins of the leaves (`id` and those below it along the axes) that have a cell with a corner in `id` and a change of sign.
fn leaves_with_surface(grid: &Grid, id: LeafId) -> Vec<IVec3> {
    let mut halo = Halo::new();
    halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
    // The first cells begin one voxel below the leaf: a cell belongs to the leaf of its first corner.
    let mixed = |below: IVec3| {
        let span = |b: i32| if b == 0 { 0..=8 } else { -1..=0 };
        // Voxels −1 and 0 along z, or 0 to 7 and then 8.
        let runs: &[(isize, usize, usize)] = if below.z == 0 { &[(0, 0, 8), (1, 7, 8)] } else { &[(-1, 0, 2)] };
        let (mut negative, mut positive) = (false, false);
        for x in span(below.x) {
            for y in span(below.y) {
                for &(dz, from, to) in runs {
                    for value in &halo.row(0, 0, [x as isize, y as isize, dz])[from..to] {
                        negative |= *value < 0.0;
                        positive |= *value >= 0.0;
                    }
                }
            }
        }
        negative && positive
    };
    (0..8)
        .map(|c| IVec3::new(-(c >> 2), -(c >> 1 & 1), -(c & 1)))
        .filter(|below| mixed(*below))
        .map(|below| grid.origin(id) + below * 8)
        .collect()
}

/// Leaf-sized blocks at which absent space changes sign without any leaf between, as a level set that lost its band has.
fn bare_faces(grid: &Grid) -> Vec<IVec3> {
    let mut out = Vec::new();
    for (lo, edge) in grid.inside_tiles() {
        for a in (0..edge).step_by(8) {
            for b in (0..edge).step_by(8) {
                for axis in 0..3 {
                    let mut at = [0; 3];
                    at[(axis + 1) % 3] = a;
                    at[(axis + 2) % 3] = b;
                    for (own, beyond) in [(0, -8), (edge - 8, edge)] {
                        at[axis] = own;
                        let inside = lo + IVec3::from_array(at);
                        at[axis] = beyond;
                        let outside = lo + IVec3::from_array(at);
                        if grid.find(outside) == LeafId::OUTSIDE {
                            out.extend([inside, outside]);
                        }
                    }
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::testing::{scene, shape};

    #[test]
    fn empty_boxes_hold_no_change_of_sign_and_are_as_large_as_they_can_be() {
        let set = shape(crate::grid::Transform::uniform(1.0), 3.0, 80, |p| {
            (p.length() - 30.0).min((p - DVec3::new(60.0, -20.0, 33.0)).length() - 9.0)
        });
        let map = scene(&set).skip;
        let blocks = |lo: IVec3, hi: IVec3| {
            (lo.x..hi.x)
                .flat_map(move |x| (lo.y..hi.y).flat_map(move |y| (lo.z..hi.z).map(move |z| IVec3::new(x, y, z))))
        };
        let changes = |block: IVec3| {
            let mut signs = blocks(block * 8, block * 8 + 9).map(|v| set.grid().voxel(v).0 < 0.0);
            let first = signs.next();
            signs.any(|s| Some(s) != first)
        };
        let (lo, hi) = (map.lo, map.lo + map.size);
        let with_surface: Vec<IVec3> = blocks(lo, hi).filter(|b| changes(*b)).collect();
        assert!(with_surface.len() > 100);
        for block in blocks(lo, hi) {
            let truth = with_surface.iter().map(|s| (*s - block).abs().max_element()).min().unwrap_or(0);
            let expected =
                (truth > 0).then(|| ((block - (truth - 1)).as_dvec3() * 8.0, (block + truth).as_dvec3() * 8.0));
            assert_eq!(map.empty_around(block), expected, "{block}");
        }
    }
}
