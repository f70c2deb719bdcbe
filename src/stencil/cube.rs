//! A leaf and a rim of several voxels as one dense cube: for filters over boxes.
//!
//! The voxels of a slab of constant x lie in one run, rows of 8 + 2·width voxels one behind the other. A filter along an
//! axis is then a sum over runs that start a slab, a row or a voxel apart: vectors go across the ends of rows, nothing is
//! stored twice, and every width has the same code.

use crate::grid::{LeafMask, LeafValues, Neighbours, Paged};

/// The widest rim: the 26 neighbours of a leaf reach no farther.
pub const WIDEST_RIM: usize = 8;

/// A leaf with `width` voxels beyond each of its faces, edges and corners.
pub struct Cube {
    width: usize,
    values: Vec<f32>,
}

impl Cube {
    /// A buffer to gather into, for a rim of 1 to [`WIDEST_RIM`] voxels.
    pub fn new(width: usize) -> Self {
        let width = width.clamp(1, WIDEST_RIM);
        Self { width, values: vec![0.0; (8 + 2 * width) * slab_room(width)] }
    }

    /// Width of the rim.
    #[inline(always)]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Copies what boxes around `voxels` of the leaf in the middle of `around` hold: of the leaf itself and of its 26 neighbours.
    #[inline(always)]
    pub fn gather(&mut self, values: &Paged<LeafValues>, around: &Neighbours, voxels: LeafMask) {
        if self.width == 1 {
            // A constant: copies of a length known at run time would be calls.
            self.gather_rows(1, values, around, voxels);
        } else if self.width == 3 {
            self.gather_rows(3, values, around, voxels);
        } else if self.width == 4 {
            self.gather_rows(4, values, around, voxels);
        } else {
            self.gather_rows(self.width, values, around, voxels);
        }
    }

    #[inline(always)]
    fn gather_rows(&mut self, width: usize, values: &Paged<LeafValues>, around: &Neighbours, voxels: LeafMask) {
        let length = 8 + 2 * width;
        let mut leaves = [&values.get(around[13]).0; 27];
        for (leaf, &id) in leaves.iter_mut().zip(around) {
            *leaf = &values.get(id).0;
        }
        for (x, slab) in self.values.chunks_exact_mut(slab_room(width)).enumerate() {
            // The slabs of the leaf whose boxes reach this one.
            let mut reached = 0;
            for word in &voxels.0[x.saturating_sub(2 * width)..=x.min(7)] {
                reached |= word;
            }
            let Some((first, last)) = row_range(reached) else {
                continue;
            };
            let (i, from_x) = ((x + 8 - width) / 8, (x + 8 - width) % 8);
            let rows = slab.chunks_exact_mut(length).enumerate().take(last + 1 + 2 * width).skip(first);
            for (y, row) in rows {
                let (j, from_y) = ((y + 8 - width) / 8, (y + 8 - width) % 8);
                let at = from_x * 64 + from_y * 8;
                let [below, own, above] = [leaves[i * 9 + j * 3], leaves[i * 9 + j * 3 + 1], leaves[i * 9 + j * 3 + 2]];
                row[..width].copy_from_slice(&below[at + 8 - width..at + 8]);
                row[width..width + 8].copy_from_slice(&own[at..at + 8]);
                row[width + 8..].copy_from_slice(&above[at..at + width]);
            }
        }
    }

    /// Slab `x`, counted from the rim: rows along y, voxels along z within a row, and room for a vector to start at each.
    #[inline(always)]
    pub fn slab(&self, x: usize) -> &[f32] {
        let room = slab_room(self.width);
        &self.values[x * room..][..room]
    }
}

/// The first and the last row with a bit in a word of a mask.
#[inline(always)]
pub fn row_range(word: u64) -> Option<(usize, usize)> {
    if word == 0 {
        return None;
    }
    Some((word.trailing_zeros() as usize / 8, 7 - word.leading_zeros() as usize / 8))
}

/// Room of a slab: its rows, a vector more and the width twice, in whole vectors.
pub const fn slab_room(width: usize) -> usize {
    let length = 8 + 2 * width;
    (length * length + 16 + 2 * width).next_multiple_of(16)
}
