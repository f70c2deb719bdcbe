//! A leaf and its rim in one contiguous buffer, laid out so that every operand of a stencil is a plain vector load.
//!
//! Kernels work on two rows of a leaf at once: (x, y) and (x, y + 1), y even, 16 values. A shift in x or y moves to other
//! rows; a shift in z would straddle rows, so the leaf is gathered once for each shift in z, every row 8 values long.

use fearless_simd::{Select, Simd, SimdBase, SimdMask, mask32x16};
use glam::IVec3;

use super::simd::Lanes;
use crate::grid::{LEAF_VOXELS, LeafValues, Neighbours, Paged};

/// Eight voxels along z.
pub type Row = [f32; 8];

/// A leaf and the voxels around it that a stencil reads.
pub trait LeafHalo: Default {
    /// Voxels beyond the leaf along each axis.
    const REACH: usize;

    /// Copies the leaf in the middle of `around` and what belongs to its rim.
    fn gather(&mut self, values: &Paged<LeafValues>, around: &Neighbours);

    /// Rows (x, y) and (x, y + 1) of the leaf.
    fn centre<S: Simd>(&self, simd: S, x: usize, y: usize) -> Lanes<S>;

    /// The rows one step before and one step after along `axis` (0 = x, 1 = y, 2 = z).
    fn beside<S: Simd>(&self, simd: S, x: usize, y: usize, axis: usize) -> [Lanes<S>; 2];
}

/// A leaf and its 26 neighbours.
const ALL: [usize; 27] =
    [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26];

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
        let leaves = leaves(values, around, ALL);
        for x in 0..10 {
            // The neighbour in x, and the slab of it.
            let (i, from) = match x {
                0 => (0, 7),
                9 => (2, 0),
                _ => (1, x - 1),
            };
            let leaf = |q: usize| slab(leaves[i * 9 + q], from);
            let [low, middle, high] = &mut self.slabs;
            let slabs = &mut [&mut low[x], &mut middle[x], &mut high[x]];
            fill::<8>(slabs, 0, [&leaf(0)[56..], &leaf(1)[56..], &leaf(2)[56..]]);
            fill::<64>(slabs, 8, [leaf(3), leaf(4), leaf(5)]);
            fill::<8>(slabs, 72, [&leaf(6)[..8], &leaf(7)[..8], &leaf(8)[..8]]);
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

impl LeafHalo for Halo {
    const REACH: usize = 1;

    #[inline(always)]
    fn gather(&mut self, values: &Paged<LeafValues>, around: &Neighbours) {
        Self::gather(self, values, around);
    }

    #[inline(always)]
    fn centre<S: Simd>(&self, simd: S, x: usize, y: usize) -> Lanes<S> {
        self.rows(simd, x, y, [0; 3])
    }

    #[inline(always)]
    fn beside<S: Simd>(&self, simd: S, x: usize, y: usize, axis: usize) -> [Lanes<S>; 2] {
        let (mut before, mut after) = ([0; 3], [0; 3]);
        (before[axis], after[axis]) = (-1, 1);
        [self.rows(simd, x, y, before), self.rows(simd, x, y, after)]
    }
}

/// A leaf with what stencils of ±REACH voxels along each axis read, REACH 1 or 3.
#[repr(align(64))]
pub struct StarHalo<const REACH: usize = 3> {
    /// By x; sixteen rows of 8 along y, the leaf's from the fourth on: so its row pairs lie in one cache line each.
    slabs: [[f32; 16 * ROW]; 14],
    /// The leaves below and above in z, with room for loads that begin or end beyond them.
    below: [f32; LEAF_VOXELS + ROW],
    above: [f32; LEAF_VOXELS + 2 * ROW],
}

/// Voxels of a row.
const ROW: usize = 8;
/// Where the leaf's values begin and end in a slab.
const FIRST: usize = 4 * ROW;
const LAST: usize = FIRST + 8 * ROW;

/// For stencils over the six face neighbours.
pub type FaceHalo = StarHalo<1>;

impl<const REACH: usize> StarHalo<REACH> {
    /// A buffer to gather into.
    pub fn new() -> Self {
        Self { slabs: [[0.0; 16 * ROW]; 14], below: [0.0; LEAF_VOXELS + ROW], above: [0.0; LEAF_VOXELS + 2 * ROW] }
    }

    /// Copies the leaf in the middle of `around` and the voxels beyond each of its faces.
    #[inline(always)]
    pub fn gather(&mut self, values: &Paged<LeafValues>, around: &Neighbours) {
        let [centre, xm, xp, ym, yp, zm, zp] = leaves(values, around, [13, 4, 22, 10, 16, 12, 14]);
        for x in 0..REACH {
            self.slabs[2 - x][FIRST..LAST].copy_from_slice(slab(xm, 7 - x));
            self.slabs[11 + x][FIRST..LAST].copy_from_slice(slab(xp, x));
        }
        let rim = 8 * REACH;
        for x in 0..8 {
            let rows = &mut self.slabs[3 + x];
            rows[FIRST - rim..FIRST].copy_from_slice(&slab(ym, x)[64 - rim..]);
            rows[FIRST..LAST].copy_from_slice(slab(centre, x));
            rows[LAST..LAST + rim].copy_from_slice(&slab(yp, x)[..rim]);
        }
        self.below[..LEAF_VOXELS].copy_from_slice(zm);
        self.above[ROW..ROW + LEAF_VOXELS].copy_from_slice(zp);
    }

    /// Rows (x, y) and (x, y + 1) of the leaf.
    #[inline(always)]
    pub fn centre<S: Simd>(&self, simd: S, x: usize, y: usize) -> Lanes<S> {
        Lanes::from_slice(simd, &self.slabs[x + 3][FIRST + y * ROW..][..16])
    }

    /// The rows `by` steps along `axis`.
    #[inline(always)]
    fn shifted_rows<S: Simd>(&self, simd: S, x: usize, y: usize, axis: usize, by: isize) -> Lanes<S> {
        let rows = match axis {
            0 => &self.slabs[(x + 3).wrapping_add_signed(by)][FIRST + y * ROW..],
            1 => &self.slabs[x + 3][(FIRST / ROW + y).wrapping_add_signed(by) * ROW..],
            _ => &self.slabs[x + 3][(FIRST + y * ROW).wrapping_add_signed(by)..],
        };
        let lanes = Lanes::from_slice(simd, &rows[..16]);
        if axis < 2 {
            return lanes;
        }
        // What straddles the rows' ends is of the leaf below or above: the same lanes of a load there.
        let (steps, at) = (by.unsigned_abs(), x * 64 + y * ROW);
        let (beyond, row) = if by < 0 {
            (&self.below[at + ROW - steps..], (1 << steps) - 1)
        } else {
            (&self.above[at + steps..], 0xff & !(0xff >> steps))
        };
        let mask = mask32x16::from_bitmask(simd, row << 8 | row);
        mask.select(Lanes::from_slice(simd, &beyond[..16]), lanes)
    }
}

impl StarHalo<3> {
    /// The rows at steps −3, −2, −1, 1, 2, 3 along `axis` (0 = x, 1 = y, 2 = z).
    #[inline(always)]
    pub fn along<S: Simd>(&self, simd: S, x: usize, y: usize, axis: usize) -> [Lanes<S>; 6] {
        // Written out: a closure would not be inlined into the code of the chosen instruction set.
        macro_rules! load {
            ($($step:literal),*) => { [$(self.shifted_rows(simd, x, y, axis, $step)),*] };
        }
        load!(-3, -2, -1, 1, 2, 3)
    }
}

impl<const REACH: usize> LeafHalo for StarHalo<REACH> {
    const REACH: usize = REACH;

    #[inline(always)]
    fn gather(&mut self, values: &Paged<LeafValues>, around: &Neighbours) {
        Self::gather(self, values, around);
    }

    #[inline(always)]
    fn centre<S: Simd>(&self, simd: S, x: usize, y: usize) -> Lanes<S> {
        Self::centre(self, simd, x, y)
    }

    #[inline(always)]
    fn beside<S: Simd>(&self, simd: S, x: usize, y: usize, axis: usize) -> [Lanes<S>; 2] {
        [self.shifted_rows(simd, x, y, axis, -1), self.shifted_rows(simd, x, y, axis, 1)]
    }
}

impl<const REACH: usize> Default for StarHalo<REACH> {
    fn default() -> Self {
        Self::new()
    }
}

/// The values of some of the leaves around and including one.
#[inline(always)]
fn leaves<'a, const N: usize>(
    values: &'a Paged<LeafValues>,
    around: &Neighbours,
    which: [usize; N],
) -> [&'a [f32; LEAF_VOXELS]; N] {
    // Not by `map`, which would not be inlined.
    let mut leaves = [&values.get(around[which[0]]).0; N];
    for (leaf, q) in leaves.iter_mut().zip(which) {
        *leaf = &values.get(around[q]).0;
    }
    leaves
}

/// The 64 values of slab x of a leaf.
#[inline(always)]
fn slab(leaf: &[f32; LEAF_VOXELS], x: usize) -> &[f32; 64] {
    &leaf.as_chunks().0[x]
}

/// Puts N / 8 rows of a leaf into the three slabs (shifted by −1, 0, 1 in z) from position `at` on; `leaves` are the one
/// below, the leaf itself and the one above.
#[inline(always)]
fn fill<const N: usize>(slabs: &mut [&mut [f32; 80]; 3], at: usize, leaves: [&[f32]; 3]) {
    let [low, middle, high] = slabs;
    let targets = (low[at..].first_chunk_mut(), middle[at..].first_chunk_mut(), high[at..].first_chunk_mut());
    let sources = (leaves[0].first_chunk::<N>(), leaves[1].first_chunk::<N>(), leaves[2].first_chunk::<N>());
    if let (Some(low), Some(middle), Some(high)) = targets
        && let (Some(below), Some(own), Some(above)) = sources
    {
        *middle = *own;
        shift_up::<N, 1>(low, own, below);
        shift_down::<N, 1>(high, own, above);
    }
}

/// Rows of 8 moved up in z: `to[z] = own[z − BY]`, what enters below coming from the end of `below`'s rows.
#[inline(always)]
fn shift_up<const N: usize, const BY: usize>(to: &mut [f32; N], own: &[f32; N], below: &[f32; N]) {
    // Vector by vector across the rows; the first voxels of each row are then put right. Lengths are constants throughout:
    // a copy of a length known at run time would be a call.
    let mut k = 0;
    while k + 16 + BY <= N {
        to[k + BY..k + BY + 16].copy_from_slice(&own[k..k + 16]);
        k += 16;
    }
    to[k + BY..].copy_from_slice(&own[k..N - BY]);
    for row in (0..N).step_by(8) {
        to[row..row + BY].copy_from_slice(&below[row + 8 - BY..row + 8]);
    }
}

/// Rows of 8 moved down in z: `to[z] = own[z + BY]`.
#[inline(always)]
fn shift_down<const N: usize, const BY: usize>(to: &mut [f32; N], own: &[f32; N], above: &[f32; N]) {
    let mut k = 0;
    while k + 16 + BY <= N {
        to[k..k + 16].copy_from_slice(&own[k + BY..k + BY + 16]);
        k += 16;
    }
    to[k..N - BY].copy_from_slice(&own[k + BY..]);
    for row in (0..N).step_by(8) {
        to[row + 8 - BY..row + 8].copy_from_slice(&above[row..row + BY]);
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
            let (mut halo, mut star, mut face) = (Halo::new(), StarHalo::new(), FaceHalo::new());
            halo.gather(grid.value_pages(), around);
            face.gather(grid.value_pages(), around);
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
                        let [m1, p1] = face.beside(simd, x, y, axis);
                        let [_, _, before, after, _, _] = star.along(simd, x, y, axis);
                        assert!((0..16).all(|lane| m1[lane] == before[lane] && p1[lane] == after[lane]));
                        for (rows, step) in star.along(simd, x, y, axis).into_iter().zip([-3, -2, -1, 1, 2, 3]) {
                            for lane in 0..16 {
                                let mut ijk = at(lane);
                                ijk[axis] += step;
                                assert_eq!(rows[lane], value(ijk));
                            }
                        }
                    }
                    assert_eq!((star.centre(simd, x, y)[9], face.centre(simd, x, y)[9]), (value(at(9)), value(at(9))));
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
