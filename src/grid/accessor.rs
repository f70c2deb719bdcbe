//! Reading single voxels.

use glam::IVec3;

use super::{Grid, LeafId, leaf_offset, leaf_origin};

/// Reads single voxels and remembers the last leaf: for sampling and tests. Kernels gather whole leaves instead.
pub struct Accessor<'a> {
    grid: &'a Grid,
    origin: IVec3,
    id: LeafId,
}

impl<'a> Accessor<'a> {
    pub(super) fn new(grid: &'a Grid) -> Self {
        Self { grid, origin: IVec3::ZERO, id: grid.find(IVec3::ZERO) }
    }

    #[inline(always)]
    fn leaf(&mut self, ijk: IVec3) -> LeafId {
        let origin = leaf_origin(ijk);
        if origin != self.origin {
            self.origin = origin;
            self.id = self.grid.find(origin);
        }
        self.id
    }

    /// Value of a voxel.
    #[inline(always)]
    pub fn value(&mut self, ijk: IVec3) -> f32 {
        let id = self.leaf(ijk);
        self.grid.values(id).0[leaf_offset(ijk)]
    }

    /// Whether a voxel is active.
    pub fn is_active(&mut self, ijk: IVec3) -> bool {
        let id = self.leaf(ijk);
        self.grid.mask(id).get(leaf_offset(ijk))
    }

    /// Values at the corners of the cell whose first corner is `ijk`, in the order x·4 + y·2 + z.
    #[inline(always)]
    pub fn cell(&mut self, ijk: IVec3) -> [f32; 8] {
        let offset = leaf_offset(ijk);
        let local: IVec3 = ijk & 7;
        if local.max_element() < 7 {
            let id = self.leaf(ijk);
            let v = &self.grid.values(id).0;
            // The eight corners lie in one leaf: x is 64 apart, y 8, z 1.
            return [0, 1, 8, 9, 64, 65, 72, 73].map(|step| v[offset + step]);
        }
        std::array::from_fn(|c| {
            let c = c as i32;
            self.value(ijk + IVec3::new(c >> 2, c >> 1 & 1, c & 1))
        })
    }

    /// Values of the 27 voxels around and including `ijk`, in the order x·9 + y·3 + z from −1 on.
    #[inline(always)]
    pub fn block(&mut self, ijk: IVec3) -> [f32; 27] {
        let local: IVec3 = ijk & 7;
        if local.min_element() > 0 && local.max_element() < 7 {
            let id = self.leaf(ijk);
            let first = leaf_offset(ijk) - (64 + 8 + 1);
            let v = &self.grid.values(id).0;
            return std::array::from_fn(|q| v[first + q / 9 * 64 + q / 3 % 3 * 8 + q % 3]);
        }
        std::array::from_fn(|q| {
            let q = q as i32;
            self.value(ijk + IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1))
        })
    }
}
