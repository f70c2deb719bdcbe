//! Exact unsigned distances to triangles in a narrow band, tile by tile.
//!
//! Triangles are binned into tiles of 32³ voxels; each tile is one task, which lowers the squared distance of every voxel near
//! each of its triangles. A minimum does not depend on the order, so neither does the result on the threads.
//!
//! In the frame of a triangle's edge k (direction ê_k, in-plane inward normal m̂_k, triangle normal n̂) a voxel at x has the
//! coordinates u = ê·(x−a), w = m̂·(x−a), s = n̂·(x−a), and its squared distance is
//! s² where all w_k ≥ 0, else s² + min_k (w_k² + (u_k − clamp(u_k, 0, |e_k|))²).
//! All of these are affine in x: they are set up in f64 about the centre of a block of at most 16³ voxels, so that the f32
//! arithmetic sees numbers of the size of a block only, whatever the size of the triangle or its distance from the origin.
//! The error is below 4e-6 voxels (looked up: below 1e-6 of one plus the distance). A triangle too thin to have a normal is its longest edge.
//!
//! Sixteen voxels are computed at once: eight along z in two rows. Rows start where the triangle's reach does and not at leaves,
//! so that a triangle of a voxel's size takes about 25 vectors. Where triangles are smaller, voxels look theirs up instead
//! ([`gather`](super::gather)).

use fearless_simd::{Select, Simd, SimdBase, SimdFloat, SimdMask, f32x8};
use glam::{DVec3, IVec3};
use rayon::prelude::*;

use super::bins::{Bins, ceil, floor};
use super::block::TILE;
use super::gather::Gather;
use crate::error::Result;
use crate::grid::{LEAF_DIM, LEAF_VOXELS, LeafValues};
use crate::mesh::closest::closest_on_triangle;
use crate::run::RunOptions;
use crate::stencil::simd::{Lanes, Work, dispatch};

/// Leaves along the edge of a tile, whose 128 KiB of values stay in the second-level cache while its triangles pass.
const TILE_LEAVES: i32 = TILE / LEAF_DIM;
/// Distance in the tile's values from a row to the next along x and y.
const ROW: [usize; 2] = [(TILE * TILE) as usize, TILE as usize];
/// Longest edge of a block of voxels that one frame serves.
const BLOCK: i32 = 16;
/// A triangle lower than this (in voxels) is treated as its longest edge.
const THIN: f64 = 1e-7;
/// Added to the reach where voxels are left out: more than the rounding of f32 in a block.
const SLACK: f32 = 1e-3;

/// Triangles wider than this (voxels) have rows that their box holds and their reach does not.
const WIDE: f32 = 2.0;
/// Slopes below this cut nothing.
const FLAT: f32 = 1e-3;

/// A leaf of unsigned distances in voxels; those beyond the band are the half width itself.
#[derive(Clone, Debug)]
pub struct UnsignedLeaf {
    /// Its first voxel.
    pub origin: IVec3,
    /// The distances.
    pub distance: LeafValues,
}

/// The exact distance, where it is less than `half_width` voxels, to `count` triangles in index space. Leaves come tile by
/// tile, in an order that depends on the triangles alone; those without a voxel in the band are left out.
///
/// Corners must be finite and stay within the range of i32 by the half width and a tile.
pub fn distance_to_triangles(
    count: usize,
    triangle: impl Fn(usize) -> [DVec3; 3] + Sync,
    half_width: f32,
    run: &RunOptions,
) -> Result<Vec<UnsignedLeaf>> {
    let leaf = |origin, distance: &LeafValues| Some(UnsignedLeaf { origin, distance: distance.clone() });
    Ok(leaves_near_triangles(count, triangle, half_width, run, leaf)?.into_iter().flatten().collect())
}

/// What `leaf` makes of the leaves of [`distance_to_triangles`], given their origins and distances, tile by tile. It is called
/// while their values are still in the cache.
pub(crate) fn leaves_near_triangles<R: Send>(
    count: usize,
    triangle: impl Fn(usize) -> [DVec3; 3] + Sync,
    half_width: f32,
    run: &RunOptions,
    leaf: impl Fn(IVec3, &LeafValues) -> Option<R> + Sync,
) -> Result<Vec<Vec<R>>> {
    let bins = Bins::new(count, |t, tiles| tiles_near(tiles, triangle(t), f64::from(half_width), TILE));
    run.check(OPERATION)?;
    let task = run.task("distances", bins.len() as u64);
    let per_tile: Vec<Vec<R>> = (0..bins.len())
        .into_par_iter()
        .map_init(
            || (vec![0.0; ROW[0] * TILE as usize], Gather::default(), Vec::new()),
            |(values, gather, rest), bin| {
                if run.is_cancelled() {
                    return Vec::new();
                }
                let origin = IVec3::from_array(*bins.key(bin)) * TILE;
                let mut touched = 0;
                values.fill(half_width * half_width);
                gather.take(origin, bins.items(bin), &triangle, half_width, rest);
                gather.lower(origin, &triangle, half_width, values, |voxel| {
                    touched |= leaf_bits(voxel >> 3, voxel >> 3);
                });
                dispatch(LowerTile {
                    values,
                    touched: &mut touched,
                    origin,
                    triangles: rest,
                    triangle: &triangle,
                    half_width,
                });
                let leaves = band_leaves(values, touched, origin, half_width, &leaf);
                task.advance(1);
                leaves
            },
        )
        .collect();
    run.check(OPERATION)?;
    Ok(per_tile)
}

const OPERATION: &str = "mesh to level set";

/// Adds the tiles of `edge` voxels, a power of two, that hold a voxel within `reach` of a triangle, and perhaps some more.
pub(crate) fn tiles_near(tiles: &mut Vec<[i32; 3]>, [a, b, c]: [DVec3; 3], reach: f64, edge: i32) {
    let shift = edge.trailing_zeros();
    let (lo, hi) = (ceil(a.min(b).min(c) - reach) >> shift, floor(a.max(b).max(c) + reach) >> shift);
    add_tiles(tiles, [a, b, c], reach, edge, lo, hi);
}

/// Adds the tiles of a range that a triangle comes near to, halving the range as long as it is large.
fn add_tiles(tiles: &mut Vec<[i32; 3]>, corners: [DVec3; 3], reach: f64, edge: i32, lo: IVec3, hi: IVec3) {
    let size = hi - lo + 1;
    // Up to here the exact test costs more than the tiles that it saves.
    if size.max_element() <= 2 {
        for x in lo.x..=hi.x {
            for y in lo.y..=hi.y {
                tiles.extend((lo.z..=hi.z).map(|z| [x, y, z]));
            }
        }
        return;
    }
    let center = (lo + hi + 1).as_dvec3() * (0.5 * f64::from(edge));
    let range = 0.5 * size.as_dvec3().length() * f64::from(edge) + reach;
    if closest_on_triangle(center, corners).distance_squared(center) > range * range {
        return;
    }
    let axis = if size.x >= size.y && size.x >= size.z {
        0
    } else if size.y >= size.z {
        1
    } else {
        2
    };
    let (mut low_end, mut high_start) = (hi, lo);
    low_end[axis] = lo[axis] + size[axis] / 2 - 1;
    high_start[axis] = low_end[axis] + 1;
    add_tiles(tiles, corners, reach, edge, lo, low_end);
    add_tiles(tiles, corners, reach, edge, high_start, hi);
}

/// Lowers the squared distances of one tile by all of its triangles.
struct LowerTile<'a, T> {
    values: &'a mut [f32],
    /// A bit for each leaf that may have been lowered.
    touched: &'a mut u64,
    origin: IVec3,
    triangles: &'a [u32],
    triangle: &'a T,
    half_width: f32,
}

impl<T: Fn(usize) -> [DVec3; 3]> Work for LowerTile<'_, T> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let reach = f64::from(self.half_width);
        let origin = self.origin.as_dvec3();
        for &t in self.triangles {
            let [a, b, c] = (self.triangle)(t as usize);
            let [a, b, c] = [a - origin, b - origin, c - origin];
            let frame = Frame::new([a, b, c]);
            let bounds = (a.min(b).min(c), a.max(b).max(c));
            // Voxels of the tile in the box of the triangle and its band.
            let lo = ceil((bounds.0 - reach).max(DVec3::ZERO));
            let hi = floor((bounds.1 + reach).min(DVec3::splat(f64::from(TILE - 1))));
            let blocks = ((hi - lo + BLOCK) / BLOCK).max(IVec3::ZERO);
            for block in 0..blocks.x * blocks.y * blocks.z {
                let at = IVec3::new(block / (blocks.y * blocks.z), block / blocks.z % blocks.y, block % blocks.z);
                let start = lo + (hi + 1 - lo) * at / blocks;
                let end = lo + (hi + 1 - lo) * (at + 1) / blocks - 1;
                if let Some(local) = frame.at_block(start, end, reach) {
                    *self.touched |= leaf_bits(start >> 3, end >> 3);
                    local.lower(simd, self.values, bounds, self.half_width);
                }
            }
        }
    }
}

/// The bits of a box of leaves of a tile, both ends included.
#[inline(always)]
fn leaf_bits(lo: IVec3, hi: IVec3) -> u64 {
    let run = |from: i32, to: i32| (1u64 << (to + 1)) - (1u64 << from);
    let mut rows = 0;
    for y in lo.y..=hi.y {
        rows |= run(lo.z, hi.z) << (TILE_LEAVES * y);
    }
    let mut bits = 0;
    for x in lo.x..=hi.x {
        bits |= rows << (TILE_LEAVES * TILE_LEAVES * x);
    }
    bits
}

/// What `leaf` makes of a tile's leaves that hold some of the band.
fn band_leaves<R>(
    squared: &[f32],
    touched: u64,
    origin: IVec3,
    half_width: f32,
    leaf: &impl Fn(IVec3, &LeafValues) -> Option<R>,
) -> Vec<R> {
    let mut leaves = Vec::with_capacity(touched.count_ones() as usize);
    let mut distance = LeafValues::default();
    let mut rest = touched;
    while rest != 0 {
        let slot = rest.trailing_zeros() as i32;
        rest &= rest - 1;
        let at = IVec3::new(slot / TILE_LEAVES / TILE_LEAVES, slot / TILE_LEAVES % TILE_LEAVES, slot % TILE_LEAVES) * 8;
        let mut in_band = false;
        dispatch(Roots { squared, at, distance: &mut distance, limit: half_width * half_width, in_band: &mut in_band });
        if in_band {
            leaves.extend(leaf(origin + at, &distance));
        }
    }
    leaves
}

/// The distances of the leaf at `at` of a tile, and whether any is in the band.
struct Roots<'a> {
    squared: &'a [f32],
    at: IVec3,
    distance: &'a mut LeafValues,
    limit: f32,
    in_band: &'a mut bool,
}

impl Work for Roots<'_> {
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut nearest = f32x8::splat(simd, self.limit);
        for (row, out) in self.distance.0.chunks_exact_mut(8).enumerate() {
            let start = (self.at.x as usize + row / 8) * ROW[0] + (self.at.y as usize + row % 8) * ROW[1];
            let squared = f32x8::from_slice(simd, &self.squared[start + self.at.z as usize..][..8]);
            nearest = nearest.min(squared);
            squared.sqrt().store_slice(out);
        }
        *self.in_band = nearest.simd_lt(self.limit).any_true();
    }
}

/// The frames of a triangle's three edges.
struct Frame {
    normal: DVec3,
    edges: [Edge; 3],
    /// False for a triangle without area, all of whose edges are the longest one.
    has_inside: bool,
}

struct Edge {
    start: DVec3,
    direction: DVec3,
    inward: DVec3,
    length: f64,
}

impl Edge {
    #[inline(always)]
    fn new(start: DVec3, side: DVec3, length: f64, normal: DVec3) -> Self {
        let direction = side / length;
        Self { start, direction, inward: normal.cross(direction), length }
    }
}

impl Frame {
    #[inline(always)]
    fn new([a, b, c]: [DVec3; 3]) -> Self {
        let sides = [b - a, c - b, a - c];
        let lengths = [sides[0].length(), sides[1].length(), sides[2].length()];
        let cross = sides[0].cross(-sides[2]);
        let twice_area = cross.length();
        let longest = lengths[0].max(lengths[1]).max(lengths[2]);
        if twice_area <= THIN * longest {
            return Self::of_longest([a, b, c], lengths);
        }
        let normal = cross / twice_area;
        let edges = [
            Edge::new(a, sides[0], lengths[0], normal),
            Edge::new(b, sides[1], lengths[1], normal),
            Edge::new(c, sides[2], lengths[2], normal),
        ];
        Self { normal, edges, has_inside: true }
    }

    /// The frame of the longest edge alone.
    #[cold]
    fn of_longest([a, b, c]: [DVec3; 3], lengths: [f64; 3]) -> Self {
        let (mut start, mut end, mut length) = (a, b, lengths[0]);
        for (from, to, other) in [(b, c, lengths[1]), (c, a, lengths[2])] {
            if other > length {
                (start, end, length) = (from, to, other);
            }
        }
        let direction = (end - start).try_normalize().unwrap_or(DVec3::X);
        let normal = direction.any_orthonormal_vector();
        let edge = || Edge { start, direction, inward: normal.cross(direction), length };
        Self { normal, edges: [edge(), edge(), edge()], has_inside: false }
    }

    /// The frame about the centre of a block of voxels, both ends included, or `None` where all of it is beyond the band.
    #[inline(always)]
    fn at_block(&self, start: IVec3, end: IVec3, half_width: f64) -> Option<LocalFrame> {
        let center = (start + end).as_dvec3() * 0.5;
        let reach = half_width + 0.5 * (end - start).as_dvec3().length();
        let s = self.normal.dot(center - self.edges[0].start);
        if s.abs() > reach {
            return None;
        }
        // Ends farther than the band can be anywhere beyond it: this keeps long edges as exact as short ones. Vectors
        // overhang the block by less than two rows.
        let far = 2.0 * reach + 16.0;
        let mut local = LocalFrame {
            start,
            end,
            center: center.as_vec3().to_array(),
            values: [0.0; 8],
            gradients: [[0.0; 8]; 3],
            ends: [[0.0; 2]; 3],
            has_inside: self.has_inside,
        };
        local.set(6, self.normal, s);
        for (k, edge) in self.edges.iter().enumerate() {
            let from_start = center - edge.start;
            let u = edge.direction.dot(from_start);
            let w = edge.inward.dot(from_start);
            if self.has_inside && w < -reach {
                return None;
            }
            local.set(2 * k, edge.inward, w);
            local.set(2 * k + 1, edge.direction, 0.0);
            local.ends[k] = [(-u).clamp(-far, far) as f32, (edge.length - u).clamp(-far, far) as f32];
        }
        Some(local)
    }
}

/// The coordinates of a frame as affine functions about the centre of a block: w and u of the three edges, then s.
struct LocalFrame {
    start: IVec3,
    end: IVec3,
    center: [f32; 3],
    values: [f32; 8],
    gradients: [[f32; 8]; 3],
    /// The range of u along each edge.
    ends: [[f32; 2]; 3],
    has_inside: bool,
}

impl LocalFrame {
    #[inline(always)]
    fn set(&mut self, at: usize, gradient: DVec3, value: f64) {
        self.values[at] = value as f32;
        self.gradients[0][at] = gradient.x as f32;
        self.gradients[1][at] = gradient.y as f32;
        self.gradients[2][at] = gradient.z as f32;
    }

    /// Lowers the squared distances of the block's voxels that the reach of the triangle in the box `bounds` may hold.
    #[inline(always)]
    fn lower<S: Simd>(&self, simd: S, values: &mut [f32], bounds: (DVec3, DVec3), half_width: f32) {
        let (lo, hi) = (bounds.0.as_vec3(), bounds.1.as_vec3());
        let reach = half_width + SLACK;
        // By voxel along z in two rows, relative to the first.
        let along_z = Lanes::from_slice(simd, &[0., 1., 2., 3., 4., 5., 6., 7., 0., 1., 2., 3., 4., 5., 6., 7.]);
        let along_y = Lanes::from_slice(simd, &[0., 0., 0., 0., 0., 0., 0., 0., 1., 1., 1., 1., 1., 1., 1., 1.]);
        let mut lanes = [Lanes::splat(simd, 0.0); 7];
        for (k, lane) in lanes.iter_mut().enumerate() {
            *lane = along_z * self.gradients[2][k] + along_y * self.gradients[1][k];
        }
        let gradients = [
            f32x8::from_slice(simd, &self.gradients[0]),
            f32x8::from_slice(simd, &self.gradients[1]),
            f32x8::from_slice(simd, &self.gradients[2]),
        ];
        let zero = Lanes::splat(simd, 0.0);
        // What a triangle without area has no inside of must not be taken for one.
        let never = Lanes::splat(simd, if self.has_inside { f32::INFINITY } else { -1.0 });
        // Rows are cut where the planes of the triangle's sides and the slab about it leave them, if it is worth it.
        let wide = (hi - lo).max_element() > WIDE;
        for x in self.start.x..=self.end.x {
            let fx = x as f32;
            let dx = (lo.x - fx).max(fx - hi.x).max(0.0);
            let left = reach * reach - dx * dx;
            let in_x = f32x8::from_slice(simd, &self.values) + gradients[0] * (fx - self.center[0]);
            let mut y = self.start.y;
            while y <= self.end.y {
                // The last row of a tile goes with the one before it.
                let first = y.min(TILE - 2);
                let fy = first as f32;
                y = first + 2;
                let dy = (lo.y - (fy + 1.0)).max(fy - hi.y).max(0.0);
                let left = left - dy * dy;
                if left < 0.0 {
                    continue;
                }
                let dz = left.sqrt() + SLACK;
                let in_row = in_x + gradients[1] * (fy - self.center[1]);
                let (mut from, mut to) = (lo.z - dz, hi.z + dz);
                if wide {
                    let mut at_center = [0.0; 8];
                    in_row.store_slice(&mut at_center);
                    (from, to) = self.cut(&at_center, reach, (from, to));
                }
                let mut z = ((from + 1.0) as i32).max(self.start.z);
                // A truncated negative is rounded up; the start is never below zero.
                let last = (to as i32).min(self.end.z);
                while z <= last {
                    let first_z = z.min(TILE - 8);
                    z = first_z + 8;
                    let mut base = [0.0; 8];
                    (in_row + gradients[2] * (first_z as f32 - self.center[2])).store_slice(&mut base);
                    let s = lanes[6] + base[6];
                    let mut inner = never;
                    let mut outside = Lanes::splat(simd, f32::INFINITY);
                    for k in 0..3 {
                        let w = lanes[2 * k] + base[2 * k];
                        let u = lanes[2 * k + 1] + base[2 * k + 1];
                        let past = u - u.max(self.ends[k][0]).min(self.ends[k][1]);
                        inner = inner.min(w);
                        outside = outside.min(w * w + past * past);
                    }
                    let squared = s * s + inner.simd_ge(zero).select(zero, outside);
                    let at = x as usize * ROW[0] + first as usize * ROW[1] + first_z as usize;
                    if let Some(rows) = values.get_mut(at..at + ROW[1] + 8) {
                        let (near, far) = rows.split_at_mut(ROW[1]);
                        let (near, far) = (&mut near[..8], &mut far[..8]);
                        let old = simd.combine_f32x8(f32x8::from_slice(simd, near), f32x8::from_slice(simd, far));
                        let (low, high) = simd.split_f32x16(old.min(squared));
                        low.store_slice(near);
                        high.store_slice(far);
                    }
                }
            }
        }
    }

    /// The part of a range of z, in two rows with the given coordinates at the centre of the block, that the slab about the
    /// triangle and the planes of its sides leave.
    #[inline(always)]
    fn cut(&self, at_center: &[f32; 8], reach: f32, mut range: (f32, f32)) -> (f32, f32) {
        let [_, along_y, along_z] = &self.gradients;
        let center = self.center[2];
        cut(&mut range, center, at_center[6].max(at_center[6] + along_y[6]) + reach, along_z[6]);
        cut(&mut range, center, (-at_center[6]).max(-at_center[6] - along_y[6]) + reach, -along_z[6]);
        if self.has_inside {
            for k in [0, 2, 4] {
                cut(&mut range, center, at_center[k].max(at_center[k] + along_y[k]) + reach, along_z[k]);
            }
        }
        range
    }
}

/// Cuts a range of z to where value + slope·(z − center) ≥ 0, or more.
#[inline(always)]
fn cut((from, to): &mut (f32, f32), center: f32, value: f32, slope: f32) {
    if slope > FLAT {
        *from = from.max(center - value / slope - SLACK);
    } else if slope < -FLAT {
        *to = to.min(center - value / slope + SLACK);
    } else if value < -2.0 * BLOCK as f32 * FLAT {
        *to = f32::NEG_INFINITY;
    }
}

/// Bytes of the leaves that triangles of a total area and box (in voxels) need at most, about: half as much again as a
/// smooth surface of the area, or the whole box if that is less.
pub(crate) fn estimated_bytes(area: f64, extent: DVec3, triangles: usize, half_width: f64) -> u64 {
    // A surface element passes through the leaves within the band's half width of it; each reaches half a leaf further.
    let slab = area * (2.0 * half_width + 8.0);
    let boxed = (extent + 2.0 * half_width + 8.0).to_array().iter().product::<f64>();
    let leaves = (1.5 * slab).min(1.2 * boxed).max(boxed.min(LEAF_VOXELS as f64)) / LEAF_VOXELS as f64;
    let bytes = leaves * 2.0 * std::mem::size_of::<LeafValues>() as f64 + triangles as f64 * 160.0;
    // The cast saturates, as it should.
    bytes as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::offset_to_local;
    use crate::mesh::Bvh;
    use crate::mesh::testing::*;

    /// Checks every voxel of the band, and that there is no other.
    fn check(triangles: &[[DVec3; 3]], half_width: f32, tolerance: f64) {
        let leaves =
            distance_to_triangles(triangles.len(), |t| triangles[t], half_width, &RunOptions::default()).unwrap();
        let bvh = Bvh::new(triangles.to_vec());
        let mut worst = 0.0f64;
        for leaf in &leaves {
            for offset in 0..LEAF_VOXELS {
                let p = (leaf.origin + offset_to_local(offset)).as_dvec3();
                let truth =
                    bvh.closest_point(p, half_width as f64).map_or(half_width as f64, |h| h.distance_squared.sqrt());
                worst = worst.max((leaf.distance.0[offset] as f64 - truth).abs());
            }
        }
        assert!(worst < tolerance, "{worst}");
        // Each triangle's surroundings are covered: the voxels nearest to its corners and centre are in the band.
        let found: std::collections::HashSet<[i32; 3]> = leaves.iter().map(|l| l.origin.to_array()).collect();
        for [a, b, c] in triangles {
            for p in [*a, *b, *c, (*a + *b + *c) / 3.0] {
                assert!(found.contains(&crate::grid::leaf_origin(p.round().as_ivec3()).to_array()));
            }
        }
    }

    fn corners(mesh: &crate::mesh::TriangleMesh, scale: f64, offset: DVec3) -> Vec<[DVec3; 3]> {
        (0..mesh.triangles.len()).map(|t| mesh.corners(t).map(|c| c * scale + offset)).collect()
    }

    #[test]
    fn small_and_large_triangles_are_exact() {
        check(&corners(&sphere(DVec3::new(0.3, -7.1, 11.7), 17.0, 40), 1.0, DVec3::ZERO), 3.0, 1e-5);
        check(&corners(&cube(DVec3::new(-30.2, 5.1, 2.7), 61.3), 1.0, DVec3::ZERO), 2.0, 1e-5);
        let slanted = [DVec3::new(-40.0, 3.3, 7.7), DVec3::new(55.0, 60.1, -80.2), DVec3::new(20.0, -31.0, 44.0)];
        check(&[slanted], 4.5, 1e-5);
    }

    #[test]
    fn far_from_the_origin_is_as_exact() {
        check(&corners(&sphere(DVec3::ZERO, 9.0, 20), 1.0, DVec3::new(1e6 + 0.123, -2e7 - 0.4, 3e5)), 3.0, 1e-5);
    }

    #[test]
    fn a_triangle_longer_than_a_thousand_voxels_is_as_exact() {
        let a = DVec3::new(0.3, 0.2, 0.1);
        let long = [a, a + DVec3::new(1500.0, 31.0, 17.0), a + DVec3::new(700.0, 19.0, 4.0)];
        check(&[long], 2.0, 1e-5);
    }

    #[test]
    fn slivers_segments_and_points_are_their_own_distance() {
        for height in [0.0, 1e-14, 1e-9, 1e-6, 1e-3] {
            let a = DVec3::new(0.2, 0.1, -0.4);
            let b = DVec3::new(21.0, 13.0, 7.0);
            check(&[[a, b, a.lerp(b, 0.3) + height * DVec3::new(0.5, -0.7, 0.1)]], 3.0, 1e-5);
        }
        check(&[[DVec3::splat(0.3); 3]], 3.0, 1e-5);
    }

    #[test]
    fn the_estimate_covers_the_leaves() {
        for (radius, half_width) in [(20.0, 3.0), (60.0, 1.5)] {
            let triangles = corners(&sphere(DVec3::ZERO, radius, 30), 1.0, DVec3::ZERO);
            let leaves =
                distance_to_triangles(triangles.len(), |t| triangles[t], half_width, &RunOptions::default()).unwrap();
            let area: f64 = triangles.iter().map(|[a, b, c]| 0.5 * (b - a).cross(c - a).length()).sum();
            let bytes = estimated_bytes(area, DVec3::splat(2.0 * radius), triangles.len(), half_width as f64);
            let used = (leaves.len() * std::mem::size_of::<UnsignedLeaf>()) as u64;
            assert!(used <= bytes && bytes < 8 * used, "{used} {bytes}");
        }
    }
}
