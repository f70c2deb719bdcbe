//! A leaf and its rim in one contiguous buffer.

use glam::IVec3;

use crate::grid::{LeafValues, Neighbours, Paged};

/// Eight voxels along z.
pub type Row = [f32; 8];

/// A leaf with a rim of `(S − 8) / 2` voxels on every side: `Halo<10>` for one-voxel stencils, `Halo<14>` for WENO5.
#[repr(align(64))]
pub struct Halo<const S: usize>([[[f32; S]; S]; S]);

impl<const S: usize> Halo<S> {
    /// Width of the rim in voxels.
    pub const RIM: usize = (S - 8) / 2;

    /// A buffer to gather into; the contents have no meaning yet.
    pub fn new() -> Self {
        Self([[[0.0; S]; S]; S])
    }

    /// Copies the leaf in the middle of `around` and the rim from its 26 neighbours.
    #[inline(always)]
    pub fn gather(&mut self, values: &Paged<LeafValues>, around: &Neighbours) {
        for q in 0..9 {
            self.gather_columns(values, around, q / 3, q % 3);
        }
    }

    /// Copies the leaf and the rims across its six faces only; edges and corners keep what they held. For stencils that
    /// look along the axes.
    #[inline(always)]
    pub fn gather_star(&mut self, values: &Paged<LeafValues>, around: &Neighbours) {
        self.gather_columns(values, around, 1, 1);
        for (i, j) in [(0, 1), (2, 1), (1, 0), (1, 2)] {
            let centre = &values.get(around[(i * 9) + (j * 3) + 1]).0;
            for (x, sx) in Self::span(i) {
                for (y, sy) in Self::span(j) {
                    let from = sx * 64 + sy * 8;
                    self.0[x][y][Self::RIM..Self::RIM + 8].copy_from_slice(&centre[from..from + 8]);
                }
            }
        }
    }

    /// The (halo, leaf) coordinates along one axis of what neighbour 0 (below), 1 (this) or 2 (above) gives.
    #[inline(always)]
    fn span(side: usize) -> impl Iterator<Item = (usize, usize)> {
        let (first, from, count) = match side {
            0 => (0, 8 - Self::RIM, Self::RIM),
            1 => (Self::RIM, 0, 8),
            _ => (Self::RIM + 8, 0, Self::RIM),
        };
        (0..count).map(move |k| (first + k, from + k))
    }

    #[inline(always)]
    fn gather_columns(&mut self, values: &Paged<LeafValues>, around: &Neighbours, i: usize, j: usize) {
        let rim = Self::RIM;
        let [below, centre, above] = std::array::from_fn(|k| &values.get(around[i * 9 + j * 3 + k]).0);
        for (x, sx) in Self::span(i) {
            for (y, sy) in Self::span(j) {
                let from = sx * 64 + sy * 8;
                let row = &mut self.0[x][y];
                row[..rim].copy_from_slice(&below[from + 8 - rim..from + 8]);
                row[rim..rim + 8].copy_from_slice(&centre[from..from + 8]);
                row[rim + 8..].copy_from_slice(&above[from..from + rim]);
            }
        }
    }

    /// The value at a voxel in the leaf's own coordinates, within the rim.
    #[inline(always)]
    pub fn value(&self, local: IVec3) -> f32 {
        let at = |i: i32| (i + Self::RIM as i32) as usize;
        self.0[at(local.x)][at(local.y)][at(local.z)]
    }

    /// The 8 values of row (x, y) shifted by (dx, dy, dz) voxels, each shift within the rim.
    #[inline(always)]
    pub fn row(&self, x: usize, y: usize, [dx, dy, dz]: [isize; 3]) -> &Row {
        let at = |i: usize, d: isize| (i + Self::RIM).wrapping_add_signed(d);
        let row = &self.0[at(x, dx)][at(y, dy)];
        row[at(0, dz)..].first_chunk().unwrap_or(&[0.0; 8])
    }
}

impl<const S: usize> Default for Halo<S> {
    fn default() -> Self {
        Self::new()
    }
}

/// The rows of a star-shaped stencil of ±R voxels along each axis around one row.
pub struct Star<'a, const S: usize> {
    halo: &'a Halo<S>,
    x: usize,
    y: usize,
}

impl<'a, const S: usize> Star<'a, S> {
    /// The star around row (x, y).
    #[inline(always)]
    pub fn new(halo: &'a Halo<S>, x: usize, y: usize) -> Self {
        Self { halo, x, y }
    }

    /// The row `step` voxels along `axis` (0 = x, 1 = y, 2 = z).
    #[inline(always)]
    pub fn at(&self, axis: usize, step: isize) -> &'a Row {
        let mut shift = [0; 3];
        shift[axis] = step;
        self.halo.row(self.x, self.y, shift)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{Grid, leaf_offset, offset_to_local};

    fn value(ijk: IVec3) -> f32 {
        (ijk.x * 1000 + ijk.y * 30 + ijk.z) as f32
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
        let centre = grid.find(IVec3::ZERO);
        let mut halo = Halo::<10>::new();
        halo.gather(grid.value_pages(), &grid.neighbours()[centre.index()]);
        let mut wide = Halo::<14>::new();
        wide.gather_star(grid.value_pages(), &grid.neighbours()[centre.index()]);
        for o in 0..512 {
            let p = offset_to_local(o);
            assert_eq!(leaf_offset(p), o);
            let (x, y, z) = (p.x as usize, p.y as usize, p.z as usize);
            for q in 0..27isize {
                let d = [q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1];
                let ijk = p + IVec3::new(d[0] as i32, d[1] as i32, d[2] as i32);
                assert_eq!(halo.row(x, y, d)[z], value(ijk));
            }
            for axis in 0..3 {
                for step in -3..=3 {
                    let mut ijk = p;
                    ijk[axis] += step;
                    assert_eq!(Star::new(&wide, x, y).at(axis, step as isize)[z], value(ijk));
                }
            }
        }
    }
}
