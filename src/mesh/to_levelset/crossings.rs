//! The integer winding number of a closed triangle mesh at every voxel, by crossings along the rows of the grid.
//!
//! Going up a row in z, the winding number rises by one where the row enters the surface and falls by one where it leaves.
//! The crossings are found by scan conversion: a triangle meets the line y = j in two points of its edges, which bound
//! the columns x = i that it covers (lower end included, upper excluded). The point on an edge is computed from the edge alone,
//! lower end first, so both triangles at an edge get the same bits, and each column between them is covered once: at shared
//! edges, vertices and in degenerate positions nothing is lost or counted twice, whatever the rounding, and the crossings of a
//! closed mesh in a row add up to zero exactly.

use glam::{DVec3, IVec3, Vec3Swizzles};
use rayon::prelude::*;

use crate::grid::{LeafMask, leaf_origin};
use crate::mesh::bins::{Bins, ceil, ceil1, floor};

/// Columns along the edge of a tile: the unit of parallel work.
const TILE: i32 = 32;
/// Crossings nearer than this (in voxels) count as one place when levels between them are judged: rounding may order
/// coincident triangles either way.
const COINCIDENT: f64 = 1e-6;

/// The axis along which levels are asked for.
const Z: usize = 2;

/// More than the rounding of a column at the largest coordinates, in voxels.
const ROUNDING: f64 = 1e-6;

/// A change of the winding number in a row.
#[derive(Clone, Copy, Debug)]
struct Crossing {
    /// First voxel of the row at or above the crossing.
    first: i32,
    step: i32,
}

/// The crossings of 32² rows, row by row in ascending z.
struct Tile {
    key: [i32; 2],
    starts: Vec<u32>,
    crossings: Vec<Crossing>,
    overlaps: Vec<IVec3>,
}

/// The crossings of all rows in z with a closed mesh.
pub(super) struct Crossings {
    tiles: Vec<Tile>,
    overlaps: Vec<IVec3>,
}

impl Crossings {
    /// Finds the crossings of the triangles, given in index space and fit for i32, and overlaps along all axes: rows along z miss some in
    /// what is thin and upright.
    pub fn new(count: usize, triangle: impl Fn(usize) -> [DVec3; 3] + Sync) -> Self {
        let bins = Bins::new(count, |t, tiles: &mut Vec<[i32; 3]>| {
            let corners = triangle(t);
            let [a, b, c] = corners;
            // Columns are found with rounding, rows without. Most triangles smaller than a voxel have none.
            let (lo, hi) = (ceil(a.min(b).min(c) - ROUNDING), floor(a.max(b).max(c) + ROUNDING));
            for axis in [0, 1, Z] {
                let (x, y) = ((axis + 1) % 3, (axis + 2) % 3);
                if lo[x] > hi[x] || lo[y] > hi[y] {
                    continue;
                }
                let columns = lo[x].div_euclid(TILE)..=hi[x].div_euclid(TILE);
                let (first, last) = (lo[y].div_euclid(TILE), hi[y].div_euclid(TILE));
                let is_large = columns.end() - columns.start() > 1 && last - first > 1;
                for i in columns {
                    let (mut first, mut last) = (first, last);
                    if is_large {
                        let (from, to) = extent_in_strip(corners, [x, y], i);
                        if from > to {
                            continue;
                        }
                        // Of long edges the ends are rounded more than columns; a voxel covers that by far.
                        first = first.max(ceil1(from - 1.0).div_euclid(TILE));
                        last = last.min(ceil1(to + 1.0).div_euclid(TILE));
                    }
                    tiles.extend((first..=last).map(|j| [axis as i32, i, j]));
                }
            }
        });
        // Of the axes beside Z only the overlaps are wanted.
        let scan = |bin| {
            let &[axis, x, y] = bins.key(bin);
            let axis = axis as usize;
            let mut tile = scan_tile([x, y], bins.items(bin), |t| turned(triangle(t), axis))?;
            // The axes of the tile are (axis + 1, axis + 2, axis).
            let back = |o: IVec3| IVec3::from_array([0, 1, Z].map(|k| o[(k + Z - axis) % 3]));
            let overlaps: Vec<IVec3> = std::mem::take(&mut tile.overlaps).into_iter().map(back).collect();
            Some(((axis == Z).then_some(tile), overlaps))
        };
        let found: Vec<(Option<Tile>, Vec<IVec3>)> = (0..bins.len()).into_par_iter().filter_map(scan).collect();
        let (tiles, overlaps): (Vec<_>, Vec<_>) = found.into_iter().unzip();
        Self { tiles: tiles.into_iter().flatten().collect(), overlaps: overlaps.concat() }
    }

    /// Leaves where a row passes to or from levels other than 0 and 1: parts of the surface lie inside each other or
    /// face the wrong way.
    pub fn overlaps(&self) -> &[IVec3] {
        &self.overlaps
    }

    /// The winding number of a voxel.
    pub fn level(&self, ijk: IVec3) -> i32 {
        let key = [ijk.x.div_euclid(TILE), ijk.y.div_euclid(TILE)];
        let Ok(found) = self.tiles.binary_search_by_key(&key, |t| t.key) else { return 0 };
        self.tiles[found].row(ijk.x, ijk.y).iter().take_while(|c| c.first <= ijk.z).map(|c| c.step).sum()
    }

    /// Which voxels of the leaf at `origin` have a winding number of 1 or more.
    pub fn inside(&self, origin: IVec3) -> LeafMask {
        self.at_least(origin, 1)
    }

    /// Which voxels of the leaf at `origin` have a winding number of at least `least`.
    pub fn at_least(&self, origin: IVec3, least: i32) -> LeafMask {
        let mut mask = LeafMask::EMPTY;
        let key = [origin.x.div_euclid(TILE), origin.y.div_euclid(TILE)];
        let Ok(found) = self.tiles.binary_search_by_key(&key, |t| t.key) else {
            return if least > 0 { mask } else { LeafMask::FULL };
        };
        let tile = &self.tiles[found];
        for (x, word) in (origin.x..).zip(&mut mask.0) {
            for (y, shift) in (origin.y..).zip((0..64).step_by(8)) {
                *word |= u64::from(at_least_in_row(tile.row(x, y), origin.z, least)) << shift;
            }
        }
        mask
    }
}

/// A bit for each of eight voxels from `start`, set where the winding number is at least `least`.
fn at_least_in_row(row: &[Crossing], start: i32, least: i32) -> u8 {
    let (mut level, mut inside) = (0, if least > 0 { 0u8 } else { 0xff });
    for crossing in row {
        let above = crossing.first.saturating_sub(start);
        if above >= 8 {
            break;
        }
        let was = level >= least;
        level += crossing.step;
        if was != (level >= least) {
            // All from here up change.
            inside ^= 0xff << above.max(0);
        }
    }
    inside
}

impl Tile {
    fn row(&self, x: i32, y: i32) -> &[Crossing] {
        let row = (x.rem_euclid(TILE) * TILE + y.rem_euclid(TILE)) as usize;
        &self.crossings[self.starts[row] as usize..self.starts[row + 1] as usize]
    }
}

/// A crossing while its tile is scanned.
#[derive(Clone, Copy)]
struct Found {
    row: u32,
    step: i32,
    height: f64,
}

/// Where along axis `y` a triangle lies within the strip of tiles number `strip` along axis `x`, which it meets.
fn extent_in_strip(corners: [DVec3; 3], [x, y]: [usize; 2], strip: i32) -> (f64, f64) {
    // The voxels of the strip, and what rounding may add.
    let (from, to) = (f64::from(strip * TILE) - ROUNDING, f64::from(strip * TILE + TILE - 1) + ROUNDING);
    let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
    for (p, q) in [(0, 1), (1, 2), (2, 0)] {
        let (p, q) = (corners[p], corners[q]);
        let (p, q) = if p[x] <= q[x] { (p, q) } else { (q, p) };
        if q[x] < from || p[x] > to {
            continue;
        }
        // An edge square to the axis counts with both ends.
        let at = |limit: f64| p[y] + (q[y] - p[y]) * ((limit - p[x]) / (q[x] - p[x])).clamp(0.0, 1.0);
        let ends = if q[x] > p[x] { [at(p[x].max(from)), at(q[x].min(to))] } else { [p[y], q[y]] };
        (lo, hi) = (lo.min(ends[0]).min(ends[1]), hi.max(ends[0]).max(ends[1]));
    }
    (lo, hi)
}

/// A triangle seen along an axis: with that as z, and the same orientation.
#[inline(always)]
fn turned([a, b, c]: [DVec3; 3], axis: usize) -> [DVec3; 3] {
    match axis {
        0 => [a.yzx(), b.yzx(), c.yzx()],
        1 => [a.zxy(), b.zxy(), c.zxy()],
        _ => [a, b, c],
    }
}

/// The crossings in one tile; `None` if there are none.
fn scan_tile(key: [i32; 2], triangles: &[u32], triangle: impl Fn(usize) -> [DVec3; 3]) -> Option<Tile> {
    let mut found: Vec<Found> = Vec::with_capacity(triangles.len());
    for &t in triangles {
        scan_triangle(triangle(t as usize), key, &mut found);
    }
    let any = *found.first()?;
    // Gathered by row, then sorted within each: rows are short.
    let mut starts = vec![0u32; (TILE * TILE) as usize + 1];
    found.iter().for_each(|f| starts[f.row as usize + 1] += 1);
    for row in 1..starts.len() {
        starts[row] += starts[row - 1];
    }
    let mut next = starts.clone();
    let mut by_row = vec![any; found.len()];
    for f in &found {
        let at = &mut next[f.row as usize];
        by_row[*at as usize] = *f;
        *at += 1;
    }
    let mut overlaps = Vec::new();
    for row in by_row.chunk_by_mut(|a, b| a.row == b.row) {
        row.sort_unstable_by(|a, b| a.height.total_cmp(&b.height).then(a.step.cmp(&b.step)));
        let mut level = 0;
        for (i, f) in row.iter().enumerate() {
            level += f.step;
            let settled = row.get(i + 1).is_none_or(|next| next.height - f.height > COINCIDENT);
            if settled && !(0..=1).contains(&level) {
                let [x, y] = [f.row as i32 / TILE + key[0] * TILE, f.row as i32 % TILE + key[1] * TILE];
                let ends = [Some(f), row.get(i + 1)].into_iter().flatten();
                overlaps.extend(ends.map(|f| leaf_origin(IVec3::new(x, y, ceil1(f.height)))));
            }
        }
    }
    overlaps.sort_unstable_by_key(IVec3::to_array);
    overlaps.dedup();
    let crossings = by_row.iter().map(|f| Crossing { first: ceil1(f.height), step: f.step }).collect();
    Some(Tile { key, starts, crossings, overlaps })
}

/// Adds the crossings of one triangle with the rows of tile `key`.
fn scan_triangle([a, b, c]: [DVec3; 3], key: [i32; 2], found: &mut Vec<Found>) {
    let first = [key[0] * TILE, key[1] * TILE];
    let low = ceil1(a.y.min(b.y).min(c.y)).max(first[1]);
    let high = (-ceil1(-a.y.max(b.y).max(c.y))).min(first[1] + TILE - 1);
    for j in low..=high {
        let y = f64::from(j);
        let (mut rising, mut falling) = (None, None);
        for (from, to) in [(a, b), (b, c), (c, a)] {
            match (from.y <= y, to.y <= y) {
                (true, false) => rising = Some(point_at(from, to, y)),
                (false, true) => falling = Some(point_at(to, from, y)),
                _ => {}
            }
        }
        let (Some(rising), Some(falling)) = (rising, falling) else { continue };
        // Seen from above, a triangle that faces up runs counter-clockwise: its rising edge is the right one.
        let (left, right, step) = if rising.0 > falling.0 { (falling, rising, -1) } else { (rising, falling, 1) };
        let start = ceil1(left.0).max(first[0]);
        let end = ceil1(right.0).min(first[0] + TILE);
        for i in start..end {
            let t = (f64::from(i) - left.0) / (right.0 - left.0);
            let height = left.1 + t * (right.1 - left.1);
            found.push(Found { row: ((i - first[0]) * TILE + (j - first[1])) as u32, step, height });
        }
    }
}

/// x and z where the edge from `lower` to `upper` meets the line of `y`, which lies between them.
fn point_at(lower: DVec3, upper: DVec3, y: f64) -> (f64, f64) {
    let t = (y - lower.y) / (upper.y - lower.y);
    (lower.x + t * (upper.x - lower.x), lower.z + t * (upper.z - lower.z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::{leaf_offset, offset_to_local};
    use crate::mesh::TriangleMesh;
    use crate::mesh::testing::*;

    fn crossings(mesh: &TriangleMesh) -> Crossings {
        Crossings::new(mesh.triangles.len(), |t| mesh.corners(t))
    }

    fn inside(crossings: &Crossings, ijk: IVec3) -> bool {
        crossings.inside(crate::grid::leaf_origin(ijk)).get(leaf_offset(ijk))
    }

    #[test]
    fn large_slanted_triangles_are_in_the_tiles_that_they_meet_and_in_few_others() {
        // A bar along the diagonal of space: its box has 31² tiles seen from each side.
        let along = DVec3::splat(1.0).normalize();
        let (u, v) = (along.any_orthonormal_vector(), along.cross(along.any_orthonormal_vector()));
        let mut bar = cube(DVec3::splat(-0.5), 1.0);
        for p in &mut bar.positions {
            *p = along * p.z * 1731.0 + u * p.x * 9.0 + v * p.y * 9.0 + DVec3::new(0.3, 0.1, -0.2);
        }
        let (found, mut state) = (crossings(&bar), 1u64);
        assert!(found.overlaps.is_empty() && found.tiles.len() < 150, "{}", found.tiles.len());
        let mut random = |n: f64| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            ((state >> 33) as f64 / (1u64 << 31) as f64 - 0.5) * n
        };
        let mut within = 0;
        for _ in 0..4000 {
            let p = along * random(1760.0) + u * random(14.0) + v * random(14.0);
            let ijk = p.round().as_ivec3();
            let q = ijk.as_dvec3() - DVec3::new(0.3, 0.1, -0.2);
            let beyond = DVec3::new(q.dot(u).abs() - 4.5, q.dot(v).abs() - 4.5, q.dot(along).abs() - 865.5);
            assert_eq!(found.level(ijk), i32::from(beyond.max_element() < 0.0), "{ijk}");
            within += found.level(ijk);
        }
        assert!(within > 1000, "{within}");
    }

    #[test]
    fn faces_edges_and_corners_on_voxels_are_counted_once() {
        // Every face, edge and corner of this cube lies on voxels.
        let cube = crossings(&cube(DVec3::splat(-3.0), 8.0));
        assert!(cube.overlaps().is_empty());
        let count = (-8..8).flat_map(|x| (-8..8).flat_map(move |y| (-8..8).map(move |z| IVec3::new(x, y, z))));
        // Half-open: each of the 8 unit intervals of an axis holds one voxel.
        assert_eq!(count.filter(|&ijk| inside(&cube, ijk)).count(), 512);
    }

    #[test]
    fn voxels_of_a_sphere_are_inside_exactly_when_they_are() {
        let center = DVec3::new(3.3, -40.1, 0.4);
        let mesh = sphere(center, 21.0, 60);
        let crossings = crossings(&mesh);
        for x in -3..4 {
            for y in -9..-1 {
                for z in -4..4 {
                    let origin = IVec3::new(x, y, z) * 8;
                    let mask = crossings.inside(origin);
                    for offset in 0..512 {
                        let r = (origin + offset_to_local(offset)).as_dvec3().distance(center);
                        // The facets fall short of the sphere by less than 21·(1 − cos(π/60)).
                        if (r - 20.985).abs() > 0.03 {
                            assert_eq!(mask.get(offset), r < 20.985, "{origin} {offset}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn overlaps_and_wrong_sides_are_noticed_cavities_are_not() {
        let a = cube(DVec3::splat(0.5), 6.0);
        let overlapping = crossings(&joined(a.clone(), &cube(DVec3::splat(2.5), 9.0)));
        assert!(!overlapping.overlaps().is_empty() && inside(&overlapping, IVec3::splat(4)));
        assert!(!crossings(&reversed(a.clone())).overlaps().is_empty());
        let hollow = crossings(&joined(a.clone(), &reversed(cube(DVec3::splat(2.5), 2.0))));
        assert!(hollow.overlaps().is_empty() && !inside(&hollow, IVec3::splat(4)) && inside(&hollow, IVec3::splat(2)));
        // Shells that touch in a plane are no overlap.
        assert!(crossings(&joined(a, &cube(DVec3::new(0.5, 0.5, 6.5), 6.0))).overlaps().is_empty());
    }
}
