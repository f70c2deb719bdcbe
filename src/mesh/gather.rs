//! Exact unsigned distances of a tile's voxels from many small triangles: each voxel looks its nearest one up among clusters of
//! sixteen, where each triangle would else lower all voxels around it.
//!
//! Which way is cheaper depends on how many triangles there are in the band's part of a voxel: one that is smaller than a voxel lowers as many
//! voxels as one of a voxel's size, while a voxel looks at a few clusters, however small their triangles are.

use glam::{DVec3, IVec3};

use super::bins::floor;
use super::block::{BLOCK, Block, Lists, TILE};
use super::cluster::{Candidates, Clusters};

/// Largest extent of a triangle along an axis, in voxels: the error of its f32 arithmetic grows with its size.
const LARGEST: f64 = 4.0;
/// A triangle lower than this, in voxels, may be too thin for a cluster.
const THINNEST: f64 = 1e-4;
/// The widest band, in voxels: triangles around a tile are few beside its own up to here.
const WIDEST: f32 = 16.0;

/// Triangles that are put into clusters at a time: 25 MB, however many there are.
const AT_A_TIME: usize = 1 << 18;

/// The most that others may have of the area: around few triangles more voxels look them up than their area tells, and the others lower
/// the same voxels again.
const MOST_LEFT: f64 = 0.25;

/// What it costs to lower a vector of 16 voxels by a triangle, its share of the set-up included; to look a voxel up; to put a triangle into a
/// cluster. Nanoseconds on one machine, of which only ratios count.
const LOWERED: f64 = 27.0;
const LOOKED_UP: f64 = 120.0;
const GATHERED: f64 = 60.0;

/// Buffers for one tile after the other.
#[derive(Default)]
pub(super) struct Gather {
    /// The triangles that are looked up; above their numbers their places along a curve on which neighbours are near to each other.
    order: Vec<u64>,
    clusters: Clusters,
    lists: Lists,
}

impl Gather {
    /// Takes those of a tile's triangles that are better looked up. The others are put into `rest`, all of them if it is not worth it.
    pub fn take(
        &mut self,
        tile: IVec3,
        triangles: &[u32],
        triangle: &impl Fn(usize) -> [DVec3; 3],
        half_width: f32,
        rest: &mut Vec<u32>,
    ) {
        self.order.clear();
        rest.clear();
        let (mut twice_area, mut twice_rest) = (0.0, 0.0);
        if half_width <= WIDEST {
            let tile = tile.as_dvec3();
            for &t in triangles {
                let [a, b, c] = triangle(t as usize);
                let (lo, hi) = (a.min(b).min(c), a.max(b).max(c));
                let extent = (hi - lo).max_element();
                let twice = (b - a).cross(c - a).length();
                // No side is longer than √3 extents.
                if extent <= LARGEST && twice > THINNEST * 3f64.sqrt() * extent {
                    self.order.push(u64::from(place((a + b + c) / 3.0 - tile)) << 32 | u64::from(t));
                    twice_area += twice;
                } else {
                    rest.push(t);
                    twice_rest += twice;
                }
            }
        }
        let (count, width) = (self.order.len() as f64, f64::from(2.0 * half_width));
        let vectors = (width + (twice_area / count.max(1.0)).sqrt()).powi(3) / 16.0;
        let voxels = 0.5 * twice_area * width;
        let worth_it = count * vectors * LOWERED > voxels * LOOKED_UP + count * GATHERED;
        if !worth_it || twice_rest > MOST_LEFT * (twice_area + twice_rest) {
            self.order.clear();
            rest.clear();
            rest.extend_from_slice(triangles);
        }
    }

    /// Lowers the squared distances of a tile by the triangles that were taken; `touch` is told the blocks that may be lowered.
    pub fn lower(
        &mut self,
        tile: IVec3,
        triangle: &impl Fn(usize) -> [DVec3; 3],
        half_width: f32,
        values: &mut [f32],
        mut touch: impl FnMut(IVec3),
    ) {
        let Self { order, clusters, lists } = self;
        if order.is_empty() {
            return;
        }
        order.sort_unstable();
        // A minimum does not depend on how they are divided.
        for part in order.chunks(AT_A_TIME) {
            clusters.clear();
            for &place_and_number in part {
                let [a, b, c] = triangle(place_and_number as u32 as usize);
                let voxel = floor(a);
                let origin = voxel.as_dvec3();
                // By hand: a closure would not be inlined.
                let corners = [(a - origin).as_vec3(), (b - origin).as_vec3(), (c - origin).as_vec3()];
                clusters.push((voxel - tile).as_vec3(), corners);
            }
            clusters.finish();
            let mut tile = Tile { clusters, half_width, values, touch: &mut touch };
            tile.halves(Block::WHOLE, &clusters.boxes, lists);
        }
    }
}

/// A tile whose voxels look up their distances.
struct Tile<'a, F> {
    clusters: &'a Clusters,
    half_width: f32,
    values: &'a mut [f32],
    touch: F,
}

impl<F: FnMut(IVec3)> Tile<'_, F> {
    /// Goes down into the eight halves of a block, whose candidates are `from`.
    fn halves(&mut self, block: Block, from: &Candidates, lists: &mut [Candidates]) {
        let Some((list, lists)) = lists.split_first_mut() else { return };
        for mut half in block.halves() {
            let distance = half.distance(self.clusters, from, self.half_width);
            if distance - half.radius() >= self.half_width {
                continue;
            }
            half.narrow(distance, self.half_width, from, list);
            if half.edge == BLOCK {
                self.fill(&half, list);
            } else {
                self.halves(half, list, lists);
            }
        }
    }

    fn fill(&mut self, block: &Block, candidates: &Candidates) {
        let start_of = |row: usize| {
            let at = block.origin + IVec3::new(row as i32 / BLOCK, row as i32 % BLOCK, 0);
            ((at.x * TILE + at.y) * TILE + at.z) as usize
        };
        let mut squared = [[0.0; BLOCK as usize]; (BLOCK * BLOCK) as usize];
        for (row, squared) in squared.iter_mut().enumerate() {
            squared.copy_from_slice(&self.values[start_of(row)..][..BLOCK as usize]);
        }
        block.look_up(self.clusters, candidates, &mut squared);
        for (row, squared) in squared.iter().enumerate() {
            self.values[start_of(row)..][..BLOCK as usize].copy_from_slice(squared);
        }
        (self.touch)(block.origin);
    }
}

/// The place of a position (voxels about the tile) along Morton's curve.
fn place(position: DVec3) -> u32 {
    const HALF: i32 = 512;
    let cell = (floor(position) + HALF).clamp(IVec3::ZERO, IVec3::splat(2 * HALF - 1)).as_uvec3();
    spread(cell.x) << 2 | spread(cell.y) << 1 | spread(cell.z)
}

/// The lowest ten bits, two zeros after each.
fn spread(mut bits: u32) -> u32 {
    bits = (bits | bits << 16) & 0x0300_00ff;
    bits = (bits | bits << 8) & 0x0300_f00f;
    bits = (bits | bits << 4) & 0x030c_30c3;
    (bits | bits << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::distance_to_triangles;
    use crate::mesh::testing::sphere;
    use crate::run::RunOptions;

    /// Exact squares of the distances from one tile's voxels, up to a limit.
    fn check(triangles: &[[DVec3; 3]], tile: IVec3, half_width: f32) {
        let of = |t: usize| triangles[t];
        let numbers: Vec<u32> = (0..triangles.len() as u32).collect();
        let (mut gather, mut rest) = (Gather::default(), Vec::new());
        gather.take(tile, &numbers, &of, half_width, &mut rest);
        let taken = triangles.len() - rest.len();
        assert!(taken > triangles.len() / 2, "{taken} of {}", triangles.len());
        let limit = half_width * half_width;
        let mut values = vec![limit; (TILE * TILE * TILE) as usize];
        let mut touched = std::collections::BTreeSet::new();
        gather.lower(tile, &of, half_width, &mut values, |block| {
            touched.insert(block.to_array());
        });
        let left: Vec<[DVec3; 3]> =
            numbers.iter().filter(|t| !rest.contains(t)).map(|&t| triangles[t as usize]).collect();
        let bvh = crate::mesh::Bvh::new(left);
        let mut inside = 0;
        for (at, &squared) in (0..).zip(&values) {
            let local = IVec3::new(at / (TILE * TILE), at / TILE % TILE, at % TILE);
            let truth = bvh.closest_point((tile + local).as_dvec3(), f64::INFINITY).unwrap().distance_squared.sqrt();
            let expected = truth.min(f64::from(half_width));
            assert!(
                (f64::from(squared.sqrt()) - expected).abs() < 1e-6 * (1.0 + expected),
                "{local}: {squared} {truth}"
            );
            if squared < limit {
                inside += 1;
                assert!(touched.contains(&(local / BLOCK * BLOCK).to_array()), "{local}");
            }
        }
        assert!(inside > 1000, "{inside}");
    }

    fn dense_ball(centre: DVec3, radius: f64) -> Vec<[DVec3; 3]> {
        let mesh = sphere(centre, radius, 120);
        (0..mesh.triangles.len()).map(|t| mesh.corners(t)).collect()
    }

    #[test]
    fn small_triangles_are_exact_and_others_are_left() {
        let mut triangles = dense_ball(DVec3::new(40.3, -20.1, 5.2), 11.0);
        check(&triangles, IVec3::new(32, -32, 0), 3.0);
        // Too large, and without area.
        triangles.push([DVec3::new(33.0, -30.0, 1.0), DVec3::new(43.0, -30.0, 1.0), DVec3::new(33.0, -24.0, 9.0)]);
        triangles.push([DVec3::new(34.0, -29.0, 1.0); 3]);
        check(&triangles, IVec3::new(32, -32, 0), 3.0);
        check(&triangles, IVec3::new(32, -32, 0), 9.0);
        // Far from the origin.
        let far = IVec3::new(1 << 20, -(1 << 24), 1 << 13);
        let shifted = |t: [DVec3; 3]| t.map(|p| p + far.as_dvec3());
        check(&triangles.iter().copied().map(shifted).collect::<Vec<_>>(), far + IVec3::new(32, -32, 0), 3.0);
    }

    #[test]
    fn large_triangles_are_left_to_be_scattered() {
        let mesh = sphere(DVec3::splat(16.0), 12.0, 6);
        let numbers: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
        let (mut gather, mut rest) = (Gather::default(), Vec::new());
        gather.take(IVec3::ZERO, &numbers, &|t| mesh.corners(t), 3.0, &mut rest);
        assert_eq!(rest, numbers);
    }

    #[test]
    fn both_ways_together_are_exact() {
        // A finely divided ball on a plate of two triangles.
        let mut triangles = dense_ball(DVec3::new(3.0, 2.0, 9.0), 9.5);
        let [a, b, c, d] = [(-8.0, -8.0), (8.0, -8.0), (8.0, 8.0), (-8.0, 8.0)].map(|(x, y)| DVec3::new(x, y, 0.2));
        triangles.extend([[a, b, c], [a, c, d]]);
        let leaves = distance_to_triangles(triangles.len(), |t| triangles[t], 4.0, &RunOptions::default()).unwrap();
        let bvh = crate::mesh::Bvh::new(triangles);
        for leaf in &leaves {
            for at in (0..512).step_by(7) {
                let ijk = leaf.origin + crate::grid::offset_to_local(at);
                let truth = bvh.closest_point(ijk.as_dvec3(), f64::INFINITY).unwrap().distance_squared.sqrt().min(4.0);
                assert!((f64::from(leaf.distance.0[at]) - truth).abs() < 1e-5, "{ijk}");
            }
        }
        assert!(leaves.len() > 30, "{}", leaves.len());
    }
}
