//! A leaf and its rim in one contiguous buffer, laid out so that every operand of a stencil is a plain vector load.
//!
//! Kernels work on two rows of a leaf at once: (x, y) and (x, y + 1), y even, 16 values. A shift in x or y moves to other
//! rows; a shift in z would straddle rows, so the leaf is gathered once for each shift in z, every row 8 values long.

use fearless_simd::{Simd, SimdBase};
use glam::IVec3;

use super::simd::Lanes;
use crate::grid::{LeafValues, Neighbours, Paged};

/// Eight voxels along z.
pub type Row = [f32; 8];

/// A leaf with a rim of one voxel: for stencils over the 27 voxels around each.
#[repr(align(64))]
pub struct Halo {
    /// By shift in z (−1, 0, 1), then x; ten rows of 8 along y.
    slabs: [[[f32; 80]; 10]; 3],
}

impl Halo {
    /// A buffer to gather into.
    pub fn new() -> Self {
        Self { slabs: [[[0.0; 80]; 10]; 3] }
    }

    /// Copies the leaf in the middle of `around` and the rim from its 26 neighbours.
    #[inline(always)]
    pub fn gather(&mut self, values: &Paged<LeafValues>, around: &Neighbours) {
        for x in 0..10 {
            // The neighbour in x, and the slab of it.
            let (i, from) = match x {
                0 => (0, 7),
                9 => (2, 0),
                _ => (1, x - 1),
            };
            for (j, rows, first, count) in [(0, 7, 0, 1), (1, 0, 1, 8), (2, 0, 9, 1)] {
                let leaf = |k: usize| &values.get(around[i * 9 + j * 3 + k]).0[from * 64 + rows * 8..][..count * 8];
                let (below, centre, above) = (leaf(0), leaf(1), leaf(2));
                let to = first * 8..(first + count) * 8;
                self.slabs[1][x][to.clone()].copy_from_slice(centre);
                shift_up(&mut self.slabs[0][x][to.clone()], centre, below, 1);
                shift_down(&mut self.slabs[2][x][to], centre, above, 1);
            }
        }
    }

    /// Rows (x, y) and (x, y + 1) shifted by (dx, dy, dz), each −1, 0 or 1.
    #[inline(always)]
    pub fn rows<S: Simd>(&self, simd: S, x: usize, y: usize, [dx, dy, dz]: [isize; 3]) -> Lanes<S> {
        let slab = &self.slabs[dz.wrapping_add(1) as usize][(x + 1).wrapping_add_signed(dx)];
        Lanes::from_slice(simd, &slab[(y + 1).wrapping_add_signed(dy) * 8..][..16])
    }
}

impl Halo {
    /// Row (x, y) shifted by (dx, dy, dz), each −1, 0 or 1.
    #[inline(always)]
    pub fn row(&self, x: usize, y: usize, [dx, dy, dz]: [isize; 3]) -> &Row {
        let slab = &self.slabs[dz.wrapping_add(1) as usize][(x + 1).wrapping_add_signed(dx)];
        &slab.as_chunks().0[(y + 1).wrapping_add_signed(dy)]
    }

    /// The value at a position relative to the leaf's first voxel, −1..8 along each axis.
    #[inline(always)]
    pub fn value(&self, ijk: IVec3) -> f32 {
        // A voxel of the rim in z is the first or last of a row shifted towards it.
        let z = ijk.z.clamp(0, 7);
        let slab = &self.slabs[(ijk.z - z + 1) as usize][(ijk.x + 1) as usize];
        slab[(ijk.y + 1) as usize * 8 + z as usize]
    }
}

impl Default for Halo {
    fn default() -> Self {
        Self::new()
    }
}

/// A leaf with what stencils of ±3 voxels along each axis read.
#[repr(align(64))]
pub struct StarHalo {
    /// By x; fourteen rows of 8 along y.
    slabs: [[f32; 112]; 14],
    /// The leaf's own rows by shift in z (−3, −2, −1, 1, 2, 3), then x.
    shifted: [[[f32; 64]; 8]; 6],
}

impl StarHalo {
    /// A buffer to gather into.
    pub fn new() -> Self {
        Self { slabs: [[0.0; 112]; 14], shifted: [[[0.0; 64]; 8]; 6] }
    }

    /// Copies the leaf in the middle of `around` and the three voxels beyond each of its faces.
    #[inline(always)]
    pub fn gather(&mut self, values: &Paged<LeafValues>, around: &Neighbours) {
        let leaf = |q: usize| &values.get(around[q]).0;
        let centre = leaf(13);
        for x in 0..3 {
            self.slabs[x][24..88].copy_from_slice(&leaf(4)[(5 + x) * 64..][..64]);
            self.slabs[11 + x][24..88].copy_from_slice(&leaf(22)[x * 64..][..64]);
        }
        for x in 0..8 {
            let slab = &mut self.slabs[3 + x];
            slab[..24].copy_from_slice(&leaf(10)[x * 64 + 40..][..24]);
            slab[24..88].copy_from_slice(&centre[x * 64..][..64]);
            slab[88..].copy_from_slice(&leaf(16)[x * 64..][..24]);
            let [own, below, above] = [13, 12, 14].map(|q| &leaf(q)[x * 64..][..64]);
            for by in 1..=3 {
                shift_up(&mut self.shifted[3 - by][x], own, below, by);
                shift_down(&mut self.shifted[2 + by][x], own, above, by);
            }
        }
    }

    /// Rows (x, y) and (x, y + 1) of the leaf.
    #[inline(always)]
    pub fn centre<S: Simd>(&self, simd: S, x: usize, y: usize) -> Lanes<S> {
        Lanes::from_slice(simd, &self.slabs[x + 3][(y + 3) * 8..][..16])
    }

    /// The rows at steps −3, −2, −1, 1, 2, 3 along `axis` (0 = x, 1 = y, 2 = z).
    #[inline(always)]
    pub fn along<S: Simd>(&self, simd: S, x: usize, y: usize, axis: usize) -> [Lanes<S>; 6] {
        // Written out: a closure would not be inlined into the code of the chosen instruction set.
        macro_rules! load {
            ($($k:literal $step:literal),*) => {
                match axis {
                    0 => [$(Lanes::from_slice(simd, &self.slabs[x + $step][(y + 3) * 8..][..16])),*],
                    1 => [$(Lanes::from_slice(simd, &self.slabs[x + 3][(y + $step) * 8..][..16])),*],
                    _ => [$(Lanes::from_slice(simd, &self.shifted[$k][x][y * 8..][..16])),*],
                }
            };
        }
        load!(0 0, 1 1, 2 2, 3 4, 4 5, 5 6)
    }
}

impl Default for StarHalo {
    fn default() -> Self {
        Self::new()
    }
}

/// Rows of 8 moved up in z: `to[z] = own[z − by]`, what enters below coming from the end of `below`'s rows.
#[inline(always)]
fn shift_up(to: &mut [f32], own: &[f32], below: &[f32], by: usize) {
    let n = own.len();
    // One copy for all rows; the first voxels of each are then put right.
    to[by..n].copy_from_slice(&own[..n - by]);
    for row in (0..n).step_by(8) {
        to[row..row + by].copy_from_slice(&below[row + 8 - by..row + 8]);
    }
}

/// Rows of 8 moved down in z: `to[z] = own[z + by]`.
#[inline(always)]
fn shift_down(to: &mut [f32], own: &[f32], above: &[f32], by: usize) {
    let n = own.len();
    to[..n - by].copy_from_slice(&own[by..]);
    for row in (0..n).step_by(8) {
        to[row + 8 - by..row + 8].copy_from_slice(&above[row..row + by]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{Grid, offset_to_local};
    use crate::stencil::simd::{Work, dispatch};

    fn value(ijk: IVec3) -> f32 {
        (ijk.x * 1000 + ijk.y * 30 + ijk.z) as f32
    }

    struct Compare<'a>(&'a Grid);

    impl Work for Compare<'_> {
        fn run<S: Simd>(self, simd: S) {
            let grid = self.0;
            let centre = grid.find(IVec3::ZERO);
            let around = &grid.neighbours()[centre.index()];
            let (mut halo, mut star) = (Halo::new(), StarHalo::new());
            halo.gather(grid.value_pages(), around);
            star.gather(grid.value_pages(), around);
            for x in 0..8usize {
                for y in (0..8usize).step_by(2) {
                    let at = |lane: usize| IVec3::new(x as i32, (y + lane / 8) as i32, (lane % 8) as i32);
                    for q in 0..27isize {
                        let d = [q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1];
                        let rows = halo.rows(simd, x, y, d);
                        assert!((0..8).all(|z| rows[z] == halo.row(x, y, d)[z]));
                        for lane in 0..16 {
                            let ijk = at(lane) + IVec3::from(d.map(|d| d as i32));
                            assert_eq!((rows[lane], halo.value(ijk)), (value(ijk), value(ijk)));
                        }
                    }
                    for axis in 0..3 {
                        for (rows, step) in star.along(simd, x, y, axis).into_iter().zip([-3, -2, -1, 1, 2, 3]) {
                            for lane in 0..16 {
                                let mut ijk = at(lane);
                                ijk[axis] += step;
                                assert_eq!(rows[lane], value(ijk));
                            }
                        }
                    }
                    assert_eq!(star.centre(simd, x, y)[9], value(at(9)));
                }
            }
        }
    }

    #[test]
    fn gathers_every_neighbour() {
        let origins: Vec<_> = (0..27).map(|q| IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1) * 8).collect();
        let mut grid = Grid::from_origins(1.0, &origins);
        let ids: Vec<_> = grid.leaves().iter().map(|&id| (id, grid.origin(id))).collect();
        grid.update_all(|id, values, _| {
            let origin = ids.iter().find(|i| i.0 == id).unwrap().1;
            for (o, v) in values.0.iter_mut().enumerate() {
                *v = value(origin + offset_to_local(o));
            }
        });
        dispatch(Compare(&grid));
    }
}
