//! Filters over boxes of (2·width + 1)³ voxels.
//!
//! - Mean: three box averages in turn, along x, then z, then y. An average is written at active voxels only; the next one
//!   reads it there and ±background elsewhere. This is `LevelSetFilter::box` of OpenVDB 10, whose order of the axes is the one
//!   given here, and its sums begin at the lowest voxel.
//! - Median: the middle one of all values of the box.
//!
//! On a distance field, a box average along an axis has the variance w(w + 1)/3 voxels². Three of them act as the
//! diffusion φ_t = Δφ over half that time, and move a sphere of radius R inwards by w(w + 1)/(3R) voxels.

use fearless_simd::{Select, Simd, SimdBase, f32x8};

use super::cube::{Cube, row_range, slab_room};
use super::simd::Lanes;
use crate::grid::{LeafMask, LeafValues};

/// Intermediate results of one slab.
pub struct SlabScratch {
    along_x: Vec<f32>,
    along_z: Vec<f32>,
}

impl SlabScratch {
    /// Buffers for boxes of this width.
    pub fn new(width: usize) -> Self {
        let slab = vec![0.0; slab_room(width)];
        Self { along_x: slab.clone(), along_z: slab }
    }
}

/// Mean over the box at the rows of the leaf that have a bit in `rows`.
#[inline(always)]
pub fn box_mean<S: Simd>(
    simd: S,
    cube: &Cube,
    background: f32,
    rows: LeafMask,
    scratch: &mut SlabScratch,
    out: &mut LeafValues,
) {
    if cube.width() == 1 {
        // A constant: the loops over the box are unrolled.
        box_mean_of(simd, 1, cube, background, rows, scratch, out);
    } else {
        box_mean_of(simd, cube.width(), cube, background, rows, scratch, out);
    }
}

#[inline(always)]
fn box_mean_of<S: Simd>(
    simd: S,
    width: usize,
    cube: &Cube,
    background: f32,
    rows: LeafMask,
    SlabScratch { along_x, along_z }: &mut SlabScratch,
    out: &mut LeafValues,
) {
    let (length, last) = (8 + 2 * width, 2 * width);
    let share = 1.0 / (2 * width + 1) as f32;
    for (x, &word) in rows.0.iter().enumerate() {
        let Some((first_row, last_row)) = row_range(word) else {
            continue;
        };
        let (begin, end) = (first_row * length, (last_row + 1 + last) * length);
        let centre = cube.slab(x + width);
        // Inactive voxels, and they alone, hold ±background.
        for i in (begin..end).step_by(16) {
            let mut sum = load(simd, cube.slab(x), i);
            for k in 1..=last {
                sum += load(simd, cube.slab(x + k), i);
            }
            let old = load(simd, centre, i);
            old.abs().simd_lt(background).select(sum * share, old).store_slice(&mut along_x[i..i + 16]);
        }
        // From here on z is counted from the leaf, and y from the rim.
        for i in (begin..end).step_by(16) {
            let mut sum = load(simd, along_x, i);
            for k in 1..=last {
                sum += load(simd, along_x, i + k);
            }
            let old = load(simd, along_x, i + width);
            let active = load(simd, centre, i + width).abs().simd_lt(background);
            active.select(sum * share, old).store_slice(&mut along_z[i..i + 16]);
        }
        for y in first_row..=last_row {
            let mut sum = f32x8::from_slice(simd, &along_z[y * length..][..8]);
            for k in 1..=last {
                sum += f32x8::from_slice(simd, &along_z[(y + k) * length..][..8]);
            }
            (sum * share).store_slice(&mut out.0[x * 64 + y * 8..][..8]);
        }
    }
}

#[inline(always)]
fn load<S: Simd>(simd: S, values: &[f32], at: usize) -> Lanes<S> {
    Lanes::from_slice(simd, &values[at..at + 16])
}

/// Buffers of the median.
pub struct MedianScratch {
    /// A slab's triples along x: smallest, middle, largest.
    along_x: [Slab; 3],
    /// The same triples in threes along z: the smallest, middle and largest of each.
    along_z: [Slab; 9],
    /// Medians of a slab, rows a cube's row apart.
    medians: Slab,
    /// All values of a wide box.
    values: Vec<f32>,
}

/// A slab of a cube with a rim of 1.
type Slab = [f32; slab_room(1)];

impl Default for MedianScratch {
    fn default() -> Self {
        const ZERO: Slab = [0.0; slab_room(1)];
        Self { along_x: [ZERO; 3], along_z: [ZERO; 9], medians: ZERO, values: Vec::new() }
    }
}

/// Median of the box at the voxels of the leaf that have a bit in `voxels`.
#[inline(always)]
pub fn box_median<S: Simd>(simd: S, cube: &Cube, voxels: LeafMask, scratch: &mut MedianScratch, out: &mut LeafValues) {
    if cube.width() == 1 {
        median_of_27(simd, cube, voxels, scratch, out);
    } else {
        median_of_many(cube, voxels, &mut scratch.values, out);
    }
}

/// By partial sorting, one voxel after the other.
fn median_of_many(cube: &Cube, voxels: LeafMask, values: &mut Vec<f32>, out: &mut LeafValues) {
    let (length, box_length) = (8 + 2 * cube.width(), 2 * cube.width() + 1);
    for at in voxels.iter() {
        let (x, y, z) = (at / 64, at / 8 % 8, at % 8);
        values.clear();
        for slab in x..x + box_length {
            for row in y..y + box_length {
                values.extend_from_slice(&cube.slab(slab)[row * length + z..][..box_length]);
            }
        }
        let middle = values.len() / 2;
        out.0[at] = *values.select_nth_unstable_by(middle, f32::total_cmp).1;
    }
}

/// By sorting along x, z and y, of which the first two are shared by neighbouring voxels, and a network for what then remains.
#[inline(always)]
fn median_of_27<S: Simd>(
    simd: S,
    cube: &Cube,
    voxels: LeafMask,
    MedianScratch { along_x, along_z, medians, .. }: &mut MedianScratch,
    out: &mut LeafValues,
) {
    const LENGTH: usize = 10;
    for (x, &word) in voxels.0.iter().enumerate() {
        let Some((first_row, last_row)) = row_range(word) else {
            continue;
        };
        let (begin, end) = (first_row * LENGTH, (last_row + 1) * LENGTH);
        for i in (begin..end + 2 * LENGTH).step_by(16) {
            let column =
                [load(simd, cube.slab(x), i), load(simd, cube.slab(x + 1), i), load(simd, cube.slab(x + 2), i)];
            let [low, middle, high] = sorted(column);
            low.store_slice(&mut along_x[0][i..i + 16]);
            middle.store_slice(&mut along_x[1][i..i + 16]);
            high.store_slice(&mut along_x[2][i..i + 16]);
        }
        for i in (begin..end + 2 * LENGTH).step_by(16) {
            for (k, values) in along_x.iter().enumerate() {
                let [low, middle, high] =
                    sorted([load(simd, values, i), load(simd, values, i + 1), load(simd, values, i + 2)]);
                low.store_slice(&mut along_z[3 * k][i..i + 16]);
                middle.store_slice(&mut along_z[3 * k + 1][i..i + 16]);
                high.store_slice(&mut along_z[3 * k + 2][i..i + 16]);
            }
        }
        for i in (begin..end).step_by(16) {
            macro_rules! rows {
                ($k:literal) => {{
                    let values = &along_z[$k];
                    sorted([load(simd, values, i), load(simd, values, i + LENGTH), load(simd, values, i + 2 * LENGTH)])
                }};
            }
            let rows = [rows!(0), rows!(1), rows!(2), rows!(3), rows!(4), rows!(5), rows!(6), rows!(7), rows!(8)];
            median_of_sorted(rows).store_slice(&mut medians[i..i + 16]);
        }
        for y in first_row..=last_row {
            out.0[x * 64 + y * 8..][..8].copy_from_slice(&medians[y * LENGTH..][..8]);
        }
    }
}

#[inline(always)]
fn sorted<S: Simd>([a, b, c]: [Lanes<S>; 3]) -> [Lanes<S>; 3] {
    let (a, b) = (a.min(b), a.max(b));
    let (b, c) = (b.min(c), b.max(c));
    [a.min(b), a.max(b), c]
}

/// The median of 27 values v[3i + j][k] that rise along i, j and k.
///
/// A value is no less than (i + 1)(j + 1)(k + 1) of them, itself among these, and no more than (3 − i)(3 − j)(3 − k): eight values
/// have too many on one side to be the median, four on each, and fall away. The comparisons that are left were found by a search; there
/// are 980 ways for zeros and ones to rise along three axes, and a test tries them all.
#[inline(always)]
fn median_of_sorted<S: Simd>(mut v: [[Lanes<S>; 3]; 9]) -> Lanes<S> {
    // The pair (p, q) leaves the smaller at p; p and q count the values in the order i, j, k.
    macro_rules! compare {
        ($($p:literal $q:literal),*) => {$(
            let (p, q) = (v[$p / 3][$p % 3], v[$q / 3][$q % 3]);
            (v[$p / 3][$p % 3], v[$q / 3][$q % 3]) = (p.min(q), p.max(q));
        )*};
    }
    compare!(
        8 24, 6 18, 8 20, 15 19, 2 15, 5 21, 8 13, 13 21, 4 18, 10 18,
        14 19, 12 18, 8 18, 8 15, 13 16, 11 18, 7 15, 5 7, 15 22, 13 14,
        14 15, 7 11, 7 14, 11 13, 13 14, 13 18, 11 13, 13 18
    );
    v[4][1]
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::*;
    use crate::grid::{Grid, offset_to_local};
    use crate::stencil::simd::{Work, dispatch};

    const BACKGROUND: f32 = 3.0;

    /// Leaves with values of no pattern, some voxels inactive and some leaves absent.
    fn grid() -> Grid {
        let origins: Vec<_> = (0..27).map(|q| IVec3::new(q / 9 - 1, q / 3 % 3 - 1, q % 3 - 1) * 8).collect();
        let origins: Vec<_> = origins.into_iter().filter(|o| o.x + 2 * o.y + 4 * o.z != 16).collect();
        let mut grid = Grid::from_origins(BACKGROUND, &origins);
        grid.update_all(|id, values, mask| {
            for (at, value) in values.0.iter_mut().enumerate() {
                let noise = ((id.index() * 512 + at) as u32).wrapping_mul(2_654_435_761) ^ 0x9e37_79b9;
                let noise = (noise.wrapping_mul(noise | 1) >> 8) as f32 / (1 << 24) as f32;
                let far = noise < 0.3;
                *value = if far { BACKGROUND.copysign(noise - 0.15) } else { (noise - 0.65) * 8.0 };
                mask.set(at, !far);
            }
        });
        grid
    }

    /// The three averages as the module's comment has them, voxel by voxel.
    fn scalar_mean(grid: &Grid, ijk: IVec3, width: i32, axes: &[IVec3]) -> f32 {
        let Some((&axis, before)) = axes.split_last() else {
            return grid.voxel(ijk).0;
        };
        if !grid.voxel(ijk).1 {
            return grid.voxel(ijk).0;
        }
        let mut sum = 0.0;
        for k in -width..=width {
            sum += scalar_mean(grid, ijk + axis * k, width, before);
        }
        sum * (1.0 / (2 * width + 1) as f32)
    }

    fn scalar_median(grid: &Grid, ijk: IVec3, width: i32) -> f32 {
        let side = 2 * width + 1;
        let step = |q| IVec3::new(q / (side * side), q / side % side, q % side) - width;
        let mut values: Vec<f32> = (0..side.pow(3)).map(|q| grid.voxel(ijk + step(q)).0).collect();
        values.sort_by(f32::total_cmp);
        values[values.len() / 2]
    }

    struct Compare<'a>(&'a Grid, usize);

    impl Work for Compare<'_> {
        fn run<S: Simd>(self, simd: S) {
            let Self(grid, width) = self;
            let id = grid.find(IVec3::ZERO);
            // Whole and in part: what is not asked for must not be needed.
            let mut part = LeafMask::EMPTY;
            for at in grid.mask(id).iter().filter(|at| at / 64 % 3 == 1 && (2..5).contains(&(at / 8 % 8))) {
                part.set(at, true);
            }
            for voxels in [grid.mask(id), part] {
                let mut cube = Cube::new(width);
                cube.gather(grid.value_pages(), &grid.neighbours()[id.index()], voxels);
                let (mut mean, mut median) = (LeafValues::default(), LeafValues::default());
                box_mean(simd, &cube, BACKGROUND, voxels, &mut SlabScratch::new(width), &mut mean);
                box_median(simd, &cube, voxels, &mut MedianScratch::default(), &mut median);
                for at in voxels.iter() {
                    let (ijk, w) = (offset_to_local(at), width as i32);
                    // The last axis comes last: y reads what z left, which reads what x left.
                    let expected = scalar_mean(grid, ijk, w, &[IVec3::X, IVec3::Z, IVec3::Y]);
                    assert_eq!(mean.0[at], expected, "mean of width {width} at {ijk}");
                    assert_eq!(median.0[at], scalar_median(grid, ijk, w), "median of width {width} at {ijk}");
                }
            }
        }
    }

    #[test]
    fn filters_are_those_of_the_definition() {
        let grid = grid();
        for width in [1, 2, 3, 8] {
            dispatch(Compare(&grid, width));
        }
    }

    #[test]
    fn the_network_finds_the_median() {
        struct AllMonotone;
        impl Work for AllMonotone {
            fn run<S: Simd>(self, simd: S) {
                let mut cases = 0;
                // How many zeros each column has: no more than the column before it along either axis.
                for code in 0..4usize.pow(9) {
                    let zeros: [usize; 9] = std::array::from_fn(|c| code >> (2 * c) & 3);
                    let falls = |c: usize| {
                        (c < 3 || zeros[c - 3] >= zeros[c]) && (c.is_multiple_of(3) || zeros[c - 1] >= zeros[c])
                    };
                    if !(0..9).all(falls) {
                        continue;
                    }
                    let value = |c: usize, k: usize| if k < zeros[c] { 0.0 } else { 1.0 };
                    let lanes = std::array::from_fn(|c| std::array::from_fn(|k| Lanes::splat(simd, value(c, k))));
                    let median = if zeros.iter().sum::<usize>() > 13 { 0.0 } else { 1.0 };
                    assert_eq!(median_of_sorted(lanes)[0], median, "{zeros:?}");
                    cases += 1;
                }
                assert_eq!(cases, 980);
            }
        }
        dispatch(AllMonotone);
    }
}
