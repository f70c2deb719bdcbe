//! Where a ray may meet the surface at all: a coarse map of empty space.
//!
//! The space around the leaves is divided into cubic blocks: single leaves, or larger ones when those would be too many, each of eight
//! parts. Every block knows, for each of the eight octants of directions, how large a cube that begins with it holds no change of sign, so a ray
//! crosses empty space, outside and inside, in a few jumps; a block with surface knows which of its parts hold some.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::grid::{Grid, LeafId, leaf_origin};
use crate::stencil::{Halo, Row};

/// Most blocks in the map: 2.3 MB. A larger object gets larger blocks.
const MAX_BLOCKS: u64 = 1 << 18;
/// log2 of the least edge of a part in voxels: half of a leaf's.
const LEAST_SHIFT: u32 = 2;
const LEAST_EDGE: i32 = 1 << LEAST_SHIFT;

/// Where the surface is.
pub(super) struct SkipMap {
    /// First block, in blocks.
    lo: IVec3,
    size: IVec3,
    /// log2 of a part's edge in voxels; a block's is twice that.
    shift: u32,
    /// A bit for each part of a block with surface, in the order x·4 + y·2 + z.
    parts: Vec<u8>,
    /// Edge in blocks of the empty cube that a block is the first of, by octant.
    ahead: [Vec<u8>; 8],
}

impl SkipMap {
    /// The map of a grid; `None` when no cell of it changes sign.
    pub fn new(grid: &Grid) -> Option<Self> {
        let mut marked: Vec<IVec3> = grid.map_leaves(|id| parts_with_surface(grid, id)).into_iter().flatten().collect();
        marked.extend(bare_faces(grid));
        let lo = marked.iter().copied().reduce(IVec3::min)?;
        let hi = marked.iter().copied().reduce(IVec3::max)?;
        let mut shift = LEAST_SHIFT;
        let size_at = |shift: u32| (hi >> (shift + 1)) - (lo >> (shift + 1)) + 1;
        while size_at(shift).to_array().iter().map(|&n| n as u64).product::<u64>() > MAX_BLOCKS {
            shift += 1;
        }
        let size = size_at(shift);
        let mut map = Self { lo: lo >> (shift + 1), size, shift, parts: Vec::new(), ahead: Default::default() };
        map.parts = vec![0; (size.x * size.y * size.z) as usize];
        for first in marked {
            let part = first >> shift;
            let at = map.index((part >> 1) - map.lo);
            map.parts[at] |= 1 << place(part);
        }
        map.ahead = (0..8).into_par_iter().map(|octant| map.cubes(octant)).collect::<Vec<_>>().try_into().ok()?;
        Some(map)
    }

    fn index(&self, local: IVec3) -> usize {
        ((local.x * self.size.y + local.y) * self.size.z + local.z) as usize
    }

    /// The empty cubes towards an octant: one block larger than the least of those that begin with the seven next blocks. Beyond the map
    /// all is empty.
    fn cubes(&self, octant: usize) -> Vec<u8> {
        let mut edges = vec![0u8; self.parts.len()];
        let step = towards(octant);
        let along = |n: i32, step: i32| (0..n).map(move |i| if step > 0 { n - 1 - i } else { i });
        for x in along(self.size.x, step.x) {
            for y in along(self.size.y, step.y) {
                for z in along(self.size.z, step.z) {
                    let local = IVec3::new(x, y, z);
                    let at = self.index(local);
                    if self.parts[at] != 0 {
                        continue;
                    }
                    let next = (1..8).map(|n| local + step * IVec3::new(n >> 2, n >> 1 & 1, n & 1));
                    let within = next.filter(|next| next.cmpge(IVec3::ZERO).all() && next.cmplt(self.size).all());
                    let least = within.map(|next| edges[self.index(next)]).min().unwrap_or(u8::MAX);
                    edges[at] = least.saturating_add(1);
                }
            }
        }
        edges
    }

    /// The box of all blocks with surface, in index space.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let edge = self.edge();
        (self.lo.as_dvec3() * edge, (self.lo + self.size).as_dvec3() * edge)
    }

    /// Edge of a block in voxels.
    fn edge(&self) -> f64 {
        f64::from(2u32 << self.shift)
    }

    /// The boxes of the parts that may hold surface, in index space.
    pub fn with_surface(&self) -> impl Iterator<Item = (DVec3, DVec3)> + '_ {
        let parts = move |n: usize| (0..8).filter(move |place| self.parts[n] >> place & 1 == 1);
        (0..self.parts.len()).flat_map(move |n| parts(n).map(move |place| self.part_at(n, place)))
    }

    /// The part in which a cell is, in parts.
    #[inline(always)]
    pub fn part(&self, cell: IVec3) -> IVec3 {
        cell >> self.shift
    }

    /// Where an empty cube ends towards an octant that begins with the block of a part, or with the part: its far corner in index space. `None`
    /// if the part may hold surface.
    #[inline(always)]
    pub fn empty_ahead(&self, part: IVec3, octant: usize) -> Option<DVec3> {
        let block: IVec3 = part >> 1;
        let at = self.index((block - self.lo).clamp(IVec3::ZERO, self.size - 1));
        let edge = i32::from(self.ahead[octant][at]);
        let step = towards(octant);
        // The far side of what begins at `first` and is `edge` long.
        let far = |first: IVec3, edge: i32| {
            first + step * edge + IVec3::select(step.cmplt(IVec3::ZERO), IVec3::ONE, IVec3::ZERO)
        };
        match edge {
            0 if self.parts[at] >> place(part) & 1 == 1 => None,
            0 => Some(far(part, 1).as_dvec3() * (0.5 * self.edge())),
            edge => Some(far(block, edge).as_dvec3() * self.edge()),
        }
    }

    /// Whether both maps have the same blocks.
    pub fn is_congruent(&self, other: &Self) -> bool {
        (self.lo, self.size, self.shift) == (other.lo, other.size, other.shift)
    }

    /// The boxes of the parts that hold surface in one of two maps with the same blocks, and not in the other.
    pub fn changed<'a>(&'a self, before: &'a Self) -> impl Iterator<Item = (DVec3, DVec3)> + 'a {
        let parts = move |n: usize| (0..8).filter(move |place| (self.parts[n] ^ before.parts[n]) >> place & 1 == 1);
        (0..self.parts.len()).flat_map(move |n| parts(n).map(move |place| self.part_at(n, place)))
    }

    /// The box of a part by its block and its place there.
    fn part_at(&self, n: usize, place: i32) -> (DVec3, DVec3) {
        let (n, row) = (n as i32, self.size.z);
        let block = self.lo + IVec3::new(n / (self.size.y * row), n / row % self.size.y, n % row);
        let lo = (block * 2 + IVec3::new(place >> 2, place >> 1 & 1, place & 1)).as_dvec3() * (0.5 * self.edge());
        (lo, lo + 0.5 * self.edge())
    }

    /// Bytes of the map.
    pub const MAX_BYTES: u64 = MAX_BLOCKS * 9;
}

/// The place of a part in its block.
#[inline(always)]
fn place(part: IVec3) -> i32 {
    let bits = part & 1;
    bits.x << 2 | bits.y << 1 | bits.z
}

/// The octant of a direction: a bit for x, y and z that is set where it does not fall.
pub(super) fn octant(direction: DVec3) -> usize {
    let rises = direction.cmpge(DVec3::ZERO);
    usize::from(rises.x) << 2 | usize::from(rises.y) << 1 | usize::from(rises.z)
}

/// The diagonal of an octant.
#[inline(always)]
fn towards(octant: usize) -> IVec3 {
    let side = |bit: usize| (octant >> bit & 1) as i32 * 2 - 1;
    IVec3::new(side(2), side(1), side(0))
}

/// First voxels of the least parts (of leaf `id`, and of absent leaves below it along the axes) that have a cell with a corner in `id` and a change
/// of sign: a cell belongs to the part of its first corner.
fn parts_with_surface(grid: &Grid, id: LeafId) -> Vec<IVec3> {
    let mut halo = Halo::new();
    let around = &grid.neighbours()[id.index()];
    halo.gather(grid.value_pages(), around);
    // By x and y from −1 on: a bit for each z from −1 on at which φ is negative.
    let mut negative = [[0u16; 10]; 10];
    let is_negative = |row: &Row| row.iter().rev().fold(0, |bits, value| bits << 1 | u16::from(*value < 0.0));
    for (x, slab) in negative.iter_mut().enumerate() {
        for (y, bits) in slab.iter_mut().enumerate() {
            let row = |dz: isize| is_negative(halo.row(0, 0, [x as isize - 1, y as isize - 1, dz]));
            *bits = row(-1) | (row(1) & 0xC0) << 2;
        }
    }
    // 0 along an axis is the last cell of the leaf below, 1 and 2 are the halves of this one.
    let voxels = |part: usize| [0..2, 1..6, 5..10][part].clone();
    let mut parts = Vec::new();
    for n in 0..27 {
        let part = [n / 9, n / 3 % 3, n % 3];
        let beside = part.map(|part| usize::from(part != 0));
        if !around[beside[0] * 9 + beside[1] * 3 + beside[2]].is_sentinel() && beside != [1; 3] {
            continue;
        }
        let mask = voxels(part[2]).fold(0, |mask, z| mask | 1u16 << z);
        let rows = negative[voxels(part[0])].iter().flat_map(|slab| &slab[voxels(part[1])]);
        let (any, all) = rows.fold((0, mask), |(any, all), bits| (any | bits & mask, all & bits));
        if any != 0 && all != mask {
            let first = IVec3::from_array(part.map(|part| (part as i32 - 1) * LEAST_EDGE));
            parts.push(grid.origin(id) + first);
        }
    }
    parts
}

/// First voxels of the least parts at which absent space changes sign without any leaf between, as a level set that lost its band has.
fn bare_faces(grid: &Grid) -> Vec<IVec3> {
    let mut out = Vec::new();
    for (lo, edge) in grid.inside_tiles() {
        for a in (0..edge).step_by(LEAST_EDGE as usize) {
            for b in (0..edge).step_by(LEAST_EDGE as usize) {
                for axis in 0..3 {
                    let mut at = [0; 3];
                    at[(axis + 1) % 3] = a;
                    at[(axis + 2) % 3] = b;
                    for (own, beyond) in [(0, -LEAST_EDGE), (edge - LEAST_EDGE, edge)] {
                        at[axis] = own;
                        let inside = lo + IVec3::from_array(at);
                        at[axis] = beyond;
                        let outside = lo + IVec3::from_array(at);
                        if grid.find(leaf_origin(outside)) == LeafId::OUTSIDE {
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
    fn empty_cubes_hold_no_change_of_sign_and_are_as_large_as_they_can_be() {
        let set = shape(crate::grid::Transform::uniform(1.0), 3.0, 80, |p| {
            (p.length() - 30.0).min((p - DVec3::new(60.0, -20.0, 33.0)).length() - 9.0)
        });
        let map = scene(&set).skip;
        let all = |lo: IVec3, hi: IVec3| {
            (lo.x..hi.x)
                .flat_map(move |x| (lo.y..hi.y).flat_map(move |y| (lo.z..hi.z).map(move |z| IVec3::new(x, y, z))))
        };
        let changes = |first: IVec3, edge: i32| {
            let mut signs = all(first, first + edge + 1).map(|v| set.grid().voxel(v).0 < 0.0);
            let sign = signs.next();
            signs.any(|s| Some(s) != sign)
        };
        let (lo, hi) = (map.lo, map.lo + map.size);
        let with_surface: Vec<IVec3> = all(lo, hi).filter(|block| changes(*block * 8, 8)).collect();
        assert!(with_surface.len() > 100);
        for (n, block) in all(lo, hi).enumerate() {
            let octant = n % 8;
            let step = towards(octant);
            // How many blocks ahead those with surface are that are ahead along all axes.
            let ahead = with_surface.iter().map(|s| (*s - block) * step);
            let truth = ahead.filter(|a| a.cmpge(IVec3::ZERO).all()).map(|a| a.max_element()).min();
            let corner = |first: IVec3, edge: i32| first + (step * (2 * edge - 1) + 1) / 2;
            for part in all(block * 2, block * 2 + 2) {
                let found = map.empty_ahead(part, octant);
                match truth {
                    Some(0) if changes(part * 4, 4) => assert_eq!(found, None),
                    Some(0) => assert_eq!(found, Some((corner(part, 1) * 4).as_dvec3())),
                    Some(edge) => assert_eq!(found, Some((corner(block, edge) * 8).as_dvec3())),
                    // As far as the map goes, at least.
                    None => assert!(map.ahead[octant][map.index(block - lo)] == u8::MAX),
                }
            }
        }
    }
}
