//! Exact unsigned distances to triangles in a narrow band, leaf by leaf.
//!
//! Triangles are sorted into tiles of 32³ voxels; each tile is one task, which lowers the squared distance of every voxel near
//! each of its triangles. A minimum does not depend on the order, so neither does the result on the threads.
//!
//! In the frame of a triangle's edge k (direction ê_k, in-plane inward normal m̂_k, triangle normal n̂) a voxel at x has the
//! coordinates u = ê·(x−a), w = m̂·(x−a), s = n̂·(x−a), and its squared distance is
//! s² where all w_k ≥ 0, else s² + min_k (w_k² + (u_k − clamp(u_k, 0, |e_k|))²).
//! All of these are affine in x: they are set up in f64 about each leaf's centre, so that the f32 arithmetic on a row of eight
//! voxels sees numbers of the size of a leaf only, whatever the size of the triangle or its distance from the origin.
//! The error is below 4e-6 voxels. A triangle too thin to have a normal is its longest edge.

use glam::{DVec3, IVec3};
use rayon::prelude::*;

use crate::error::Result;
use crate::grid::{LEAF_VOXELS, LeafValues};
use crate::mesh::closest::closest_on_triangle;
use crate::run::RunOptions;

/// Leaves along a tile's edge: a tile's 128 KiB of values stay in the second-level cache while its triangles pass.
const TILE_LEAVES: i32 = 4;
/// Voxels along a tile's edge.
const TILE: i32 = 8 * TILE_LEAVES;
/// A triangle lower than this (in voxels) is treated as its longest edge.
const THIN: f64 = 1e-7;
/// Half the diagonal of the lattice of a leaf's voxels, 3.5·√3, rounded up.
const LEAF_RADIUS: f64 = 6.1;

/// A leaf of unsigned distances in voxels; those beyond the band are the half width itself.
#[derive(Clone, Debug)]
pub struct UnsignedLeaf {
    /// Its first voxel.
    pub origin: IVec3,
    /// The distances.
    pub distance: LeafValues,
}

/// The exact distance, where it is less than `half_width` voxels, to `count` triangles in index space. Leaves are in the order of
/// their origins (x, then y, then z); those without a voxel in the band are left out.
///
/// Corners must be finite and stay within the range of i32 by the half width and a tile.
pub fn distance_to_triangles(
    count: usize,
    triangle: impl Fn(usize) -> [DVec3; 3] + Sync,
    half_width: f32,
    run: &RunOptions,
) -> Result<Vec<UnsignedLeaf>> {
    let pairs = tiles_of_triangles(count, &triangle, half_width as f64);
    let tiles: Vec<&[(IVec3Key, u32)]> = pairs.chunk_by(|a, b| a.0 == b.0).collect();
    let task = run.task("distances", tiles.len() as u64);
    let per_tile: Vec<Vec<UnsignedLeaf>> = tiles
        .par_iter()
        .map_init(
            || vec![LeafValues::default(); (TILE_LEAVES * TILE_LEAVES * TILE_LEAVES) as usize],
            |scratch, tile| {
                if run.is_cancelled() {
                    return Vec::new();
                }
                let leaves = fill_tile(scratch, tile, &triangle, half_width);
                task.advance(1);
                leaves
            },
        )
        .collect();
    run.check("mesh to level set")?;
    let mut leaves: Vec<UnsignedLeaf> = per_tile.into_iter().flatten().collect();
    leaves.par_sort_unstable_by_key(|leaf| leaf.origin.to_array());
    Ok(leaves)
}

/// Tile coordinates, ordered.
type IVec3Key = [i32; 3];

/// All pairs of a tile and a triangle near it, sorted.
fn tiles_of_triangles(
    count: usize,
    triangle: &(impl Fn(usize) -> [DVec3; 3] + Sync),
    half_width: f64,
) -> Vec<(IVec3Key, u32)> {
    const CHUNK: usize = 4096;
    let chunks: Vec<Vec<(IVec3Key, u32)>> = (0..count.div_ceil(CHUNK))
        .into_par_iter()
        .map(|chunk| {
            let mut pairs = Vec::with_capacity(2 * CHUNK);
            for t in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                let corners = triangle(t);
                let (lo, hi) = tile_range(corners, half_width);
                add_tiles(&mut pairs, t as u32, corners, half_width, lo, hi);
            }
            pairs
        })
        .collect();
    let mut pairs = chunks.concat();
    pairs.par_sort_unstable();
    pairs
}

/// The tiles that the box of a triangle and its band touches, both ends included.
fn tile_range([a, b, c]: [DVec3; 3], half_width: f64) -> (IVec3, IVec3) {
    let tile = |p: DVec3| p.as_ivec3().div_euclid(IVec3::splat(TILE));
    (tile((a.min(b).min(c) - half_width).ceil()), tile((a.max(b).max(c) + half_width).floor()))
}

/// Adds the tiles of a range that the band of a triangle touches, halving the range as long as it is large.
fn add_tiles(pairs: &mut Vec<(IVec3Key, u32)>, t: u32, corners: [DVec3; 3], half_width: f64, lo: IVec3, hi: IVec3) {
    let size = hi - lo + 1;
    // Up to here the exact test costs more than the tiles that it saves.
    if size.max_element() <= 2 {
        for x in lo.x..=hi.x {
            for y in lo.y..=hi.y {
                pairs.extend((lo.z..=hi.z).map(|z| ([x, y, z], t)));
            }
        }
        return;
    }
    let center = (lo + hi + 1).as_dvec3() * (0.5 * TILE as f64);
    let reach = 0.5 * size.as_dvec3().length() * TILE as f64 + half_width;
    if closest_on_triangle(center, corners).distance_squared(center) > reach * reach {
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
    add_tiles(pairs, t, corners, half_width, lo, low_end);
    add_tiles(pairs, t, corners, half_width, high_start, hi);
}

/// Lowers the distances of one tile by all of its triangles and returns the leaves that hold some of the band.
fn fill_tile(
    scratch: &mut [LeafValues],
    tile: &[(IVec3Key, u32)],
    triangle: &impl Fn(usize) -> [DVec3; 3],
    half_width: f32,
) -> Vec<UnsignedLeaf> {
    let Some((key, _)) = tile.first() else { return Vec::new() };
    let origin = IVec3::from_array(*key) * TILE;
    let limit = half_width * half_width;
    scratch.iter_mut().for_each(|leaf| leaf.0.fill(limit));
    let hw = half_width as f64;
    for &(_, t) in tile {
        let corners = triangle(t as usize).map(|c| c - origin.as_dvec3());
        let frame = Frame::new(corners);
        // Voxels of the tile in the box of the triangle and its band.
        let [a, b, c] = corners;
        let lo = (a.min(b).min(c) - hw).ceil().max(DVec3::ZERO).as_ivec3();
        let hi = (a.max(b).max(c) + hw).floor().min(DVec3::splat((TILE - 1) as f64)).as_ivec3();
        for x in lo.x >> 3..=hi.x >> 3 {
            for y in lo.y >> 3..=hi.y >> 3 {
                for z in lo.z >> 3..=hi.z >> 3 {
                    let leaf = IVec3::new(x, y, z);
                    let slot = ((x * TILE_LEAVES + y) * TILE_LEAVES + z) as usize;
                    let rows = (lo - leaf * 8).max(IVec3::ZERO)..(hi - leaf * 8).min(IVec3::splat(7)) + 1;
                    if let Some(local) = frame.at_leaf(leaf * 8, half_width) {
                        local.lower(&mut scratch[slot], rows, half_width);
                    }
                }
            }
        }
    }
    let mut leaves = Vec::new();
    for (slot, values) in (0..).zip(scratch.iter()) {
        if values.0.iter().any(|&d| d < limit) {
            let leaf =
                IVec3::new(slot / TILE_LEAVES / TILE_LEAVES, slot / TILE_LEAVES % TILE_LEAVES, slot % TILE_LEAVES);
            let mut distance = LeafValues::default();
            distance.0.iter_mut().zip(&values.0).for_each(|(d, d2)| *d = d2.sqrt());
            leaves.push(UnsignedLeaf { origin: origin + leaf * 8, distance });
        }
    }
    leaves
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

impl Frame {
    fn new([a, b, c]: [DVec3; 3]) -> Self {
        let cross = (b - a).cross(c - a);
        let ends = [(a, b), (b, c), (c, a)];
        let longest = ends
            .into_iter()
            .fold(ends[0], |x, y| if y.0.distance_squared(y.1) > x.0.distance_squared(x.1) { y } else { x });
        let longest_length = longest.0.distance(longest.1);
        let twice_area = cross.length();
        let has_inside = twice_area > THIN * longest_length;
        let (normal, ends) = if has_inside {
            (cross / twice_area, ends)
        } else {
            let axis = (longest.1 - longest.0).try_normalize().unwrap_or(DVec3::X);
            (axis.any_orthonormal_vector(), [longest; 3])
        };
        let edges = ends.map(|(start, end)| {
            let length = start.distance(end);
            // The normal of a thin triangle is not quite square to its edges; the frame must be.
            let direction = ((end - start) / length.max(f64::MIN_POSITIVE)).try_normalize();
            let direction = direction.unwrap_or_else(|| normal.any_orthonormal_vector());
            Edge { start, direction, inward: normal.cross(direction), length }
        });
        Self { normal, edges, has_inside }
    }

    /// The frame about the centre of the leaf at `origin`, or `None` where the leaf is beyond the band.
    fn at_leaf(&self, origin: IVec3, half_width: f32) -> Option<LocalFrame> {
        let center = origin.as_dvec3() + 3.5;
        let reach = half_width as f64 + LEAF_RADIUS;
        let s = self.normal.dot(center - self.edges[0].start);
        if s.abs() > reach {
            return None;
        }
        let mut edges = [LocalEdge::default(); 3];
        for (local, edge) in edges.iter_mut().zip(&self.edges) {
            let from_start = center - edge.start;
            let u = edge.direction.dot(from_start);
            let w = edge.inward.dot(from_start);
            if self.has_inside && w < -reach {
                return None;
            }
            // Ends farther than the band can be anywhere beyond it: this keeps long edges as exact as short ones.
            let far = 2.0 * reach;
            *local = LocalEdge {
                along: Affine::new(edge.direction, 0.0),
                inward: Affine::new(edge.inward, w),
                lowest: (-u).clamp(-far, far) as f32,
                highest: (edge.length - u).clamp(-far, far) as f32,
            };
        }
        Some(LocalFrame { height: Affine::new(self.normal, s), edges, has_inside: self.has_inside })
    }
}

/// value + gradient · (x − centre of the leaf)
#[derive(Clone, Copy, Default)]
struct Affine {
    gradient: [f32; 3],
    value: f32,
}

impl Affine {
    fn new(gradient: DVec3, value: f64) -> Self {
        Self { gradient: gradient.as_vec3().to_array(), value: value as f32 }
    }

    /// Its value in the middle of row (x, y), between the lanes 3 and 4.
    #[inline(always)]
    fn row(&self, x: f32, y: f32) -> f32 {
        self.value + (self.gradient[0] * x + self.gradient[1] * y)
    }
}

#[derive(Clone, Copy, Default)]
struct LocalEdge {
    along: Affine,
    inward: Affine,
    lowest: f32,
    highest: f32,
}

struct LocalFrame {
    height: Affine,
    edges: [LocalEdge; 3],
    has_inside: bool,
}

impl LocalFrame {
    /// Lowers the squared distances in the rows `x`, `y` of a range.
    #[inline]
    fn lower(&self, leaf: &mut LeafValues, range: std::ops::Range<IVec3>, half_width: f32) {
        const LANES: [f32; 8] = [-3.5, -2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 3.5];
        let [e0, e1, e2] = &self.edges;
        // What a triangle without area has no inside of must not be taken for one.
        let never = if self.has_inside { f32::INFINITY } else { -1.0 };
        for x in range.start.x..range.end.x {
            let fx = x as f32 - 3.5;
            for y in range.start.y..range.end.y {
                let fy = y as f32 - 3.5;
                let s = self.height.row(fx, fy);
                // A row whose nearest lane to the plane, or to the inner side of an edge, is beyond the band.
                if s.abs() - 3.5 * self.height.gradient[2].abs() > half_width {
                    continue;
                }
                let w = self.edges.map(|e| e.inward.row(fx, fy));
                let beyond = |k: usize| w[k] + 3.5 * self.edges[k].inward.gradient[2].abs() < -half_width;
                if self.has_inside && (beyond(0) || beyond(1) || beyond(2)) {
                    continue;
                }
                let u = self.edges.map(|e| e.along.row(fx, fy));
                let start = (x * 64 + y * 8) as usize;
                let Some(row) = leaf.0[start..].first_chunk_mut::<8>() else { continue };
                for lane in 0..8 {
                    let z = LANES[lane];
                    let s = s + self.height.gradient[2] * z;
                    let (w0, d0) = e0.planar(w[0], u[0], z);
                    let (w1, d1) = e1.planar(w[1], u[1], z);
                    let (w2, d2) = e2.planar(w[2], u[2], z);
                    let inner = smaller(smaller(w0, w1), smaller(w2, never));
                    let outside = smaller(smaller(d0, d1), d2);
                    let planar = if inner >= 0.0 { 0.0 } else { outside };
                    row[lane] = smaller(row[lane], s * s + planar);
                }
            }
        }
    }
}

impl LocalEdge {
    /// In a row with the mid values `w` and `u`, at `z`: distance inwards from the line, and squared distance from the edge
    /// within the plane.
    #[inline(always)]
    fn planar(&self, w: f32, u: f32, z: f32) -> (f32, f32) {
        let w = w + self.inward.gradient[2] * z;
        let u = u + self.along.gradient[2] * z;
        let past = u - smaller(larger(u, self.lowest), self.highest);
        (w, w * w + past * past)
    }
}

/// One machine instruction, unlike `f32::min`, which minds NaN.
#[inline(always)]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// The greater of two.
#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
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
        assert!(leaves.is_sorted_by_key(|l| l.origin.to_array()));
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
