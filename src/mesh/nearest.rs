//! Exact signed distances to the surface of a field, in the band around the surface at an offset.
//!
//! Space is gone through in tiles of 32³ voxels, each one task. A tile collects the triangles near it in clusters of
//! sixteen and is halved down to blocks of 4³ voxels. Each [block](super::block) gets the clusters that can be nearest to any of its voxels.
//! If its centre has the distance D and its radius is r, D − r ≤ |φ| ≤ D + r tells the blocks without any voxel of the band, which are left.
//! In the last blocks each voxel looks at the clusters whose box is nearer than the nearest triangle found so far. So every
//! distance is that of the nearest triangle, whatever the field is; no property of φ but its sign is used.
//!
//! No array of all triangles is made: those at the border of tiles are made once for each tile that they are near.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::block::{BLOCK, Block, Lists, TILE};
use super::cluster::{Candidates, Clusters, SLACK};
use crate::error::Result;
use crate::grid::{Grid, LEAF_DIM, LEAF_VOXELS, LeafMask, LeafValues, leaf_offset};
use crate::levelset::BYTES_A_LEAF;
use crate::levelset::isosurface::IsoSurface;
use crate::levelset::sharp::SharpEdges;
use crate::run::RunOptions;

/// Where distances are wanted, in voxels: where the distance from the surface, less `offset`, is within the half width.
#[derive(Clone, Copy, Debug)]
pub(super) struct Band {
    /// Distance of the new surface from the field's, positive outwards.
    pub offset: f64,
    /// Half width of the band around it.
    pub half_width: f64,
    /// World units a voxel.
    pub voxel_size: f64,
    /// |φ| beyond the band, in world units.
    pub background: f32,
    /// Whether the surface at an offset is that of the field's sharp edges, not of the polygons that cut them off.
    pub sharp: bool,
    /// Whether voxels of cubes of [`BLOCK`]³ that are not wanted stay as they are in the field, within leaves that are. Without an offset only.
    pub keeps: bool,
}

impl Band {
    /// Unsigned distances from the surface that can occur in the band.
    fn reach(&self) -> f32 {
        (self.offset.abs() + self.half_width) as f32
    }

    /// The same on one side of the surface.
    fn limit(&self, inside: bool) -> f32 {
        let outwards = if inside { -self.offset } else { self.offset };
        (self.half_width + outwards).max(0.0) as f32
    }

    /// Where a block lies whose distances are between `lo` and `hi`.
    fn side(&self, lo: f32, hi: f32) -> Side {
        let slack = f64::from(SLACK);
        if f64::from(lo) > self.offset + self.half_width + slack {
            Side::Outside
        } else if f64::from(hi) < self.offset - self.half_width - slack {
            Side::Inside
        } else {
            Side::Near
        }
    }
}

/// Where a block lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    Inside,
    Outside,
    /// Some of it may be in the band.
    Near,
}

/// A leaf with its first voxel.
pub(crate) type Leaf = (IVec3, LeafValues, LeafMask);

/// The leaves of a band, those of each tile together, tiles in the order of their origins; only those for whose first and last voxel `wanted`
/// holds, as it must for every box around one.
pub(super) fn leaves_of_band(
    operation: &str,
    surface: &IsoSurface,
    field: &Grid,
    iso: f32,
    band: Band,
    wanted: impl Fn(IVec3, IVec3) -> bool + Sync,
    run: &RunOptions,
) -> Result<Vec<Vec<Leaf>>> {
    // Outwards the edges of the inside count, inwards those of the outside.
    let of = (if band.offset >= 0.0 { 1.0 } else { -1.0 }, band.voxel_size.recip() as f32);
    let sharp = band.sharp.then(|| SharpEdges::new(surface, field, of, operation, run)).transpose()?;
    let search = Search { sources: Sources::new(surface, field), surface, sharp, field, iso, band, wanted: &wanted };
    let mut tiles = search.sources.tiles_within(band.reach());
    tiles.retain(|&tile| {
        let (first, last) = tile_bounds(tile);
        wanted(first, last)
    });
    let task = run.task("distances", tiles.len() as u64);
    let (before, made) = (run.memory_in_use(), AtomicU64::new(0));
    tiles
        .par_iter()
        .map_init(Scratch::default, |scratch, &tile| {
            run.check(operation)?;
            let mut leaves = Vec::new();
            let triangles = search.collect(tile, scratch);
            // Neither the triangles of a tile nor all leaves so far may need more than there is.
            run.reserve_since(before, operation, triangles * Clusters::BYTES_A_TRIANGLE, "take a smaller distance")?;
            search.tile(tile, scratch, &mut leaves);
            let made = made.fetch_add(leaves.len() as u64, Ordering::Relaxed) + leaves.len() as u64;
            let advice = "take a narrower band, a smaller distance or larger voxels";
            run.reserve_since(before, operation, made * BYTES_A_LEAF, advice)?;
            task.advance(1);
            Ok(leaves)
        })
        .collect()
}

/// The leaves that the surface crosses, by tile.
struct Sources {
    /// Origin, and place among the surface's leaves.
    leaves: Vec<(IVec3, usize)>,
    tiles: FxHashMap<IVec3, Range<usize>>,
}

impl Sources {
    fn new(surface: &IsoSurface, field: &Grid) -> Self {
        let mut leaves: Vec<(IVec3, usize)> =
            surface.leaves().iter().enumerate().map(|(place, leaf)| (field.origin(leaf.id), place)).collect();
        leaves.sort_unstable_by_key(|(origin, _)| (tile_of(*origin).to_array(), origin.to_array()));
        let mut tiles = FxHashMap::default();
        let mut first = 0;
        for run in leaves.chunk_by(|a, b| tile_of(a.0) == tile_of(b.0)) {
            tiles.insert(tile_of(run[0].0), first..first + run.len());
            first += run.len();
        }
        Self { leaves, tiles }
    }

    /// How many tiles away a tile can be whose triangles are within reach.
    fn steps(reach: f32) -> i32 {
        1 + reach as i32 / TILE
    }

    /// All tiles with leaves within reach, in the order of their origins.
    fn tiles_within(&self, reach: f32) -> Vec<IVec3> {
        let mut tiles: Vec<[i32; 3]> = Vec::new();
        for &tile in self.tiles.keys() {
            for_each_around(tile, Self::steps(reach), |other| tiles.push(other.to_array()));
        }
        tiles.sort_unstable();
        tiles.dedup();
        tiles.into_iter().map(IVec3::from_array).collect()
    }
}

fn tile_of(ijk: IVec3) -> IVec3 {
    ijk.div_euclid(IVec3::splat(TILE))
}

/// The first and the last voxel of a tile.
fn tile_bounds(tile: IVec3) -> (IVec3, IVec3) {
    (tile * TILE, tile * TILE + (TILE - 1))
}

fn for_each_around(tile: IVec3, steps: i32, mut f: impl FnMut(IVec3)) {
    for x in -steps..=steps {
        for y in -steps..=steps {
            for z in -steps..=steps {
                f(tile + IVec3::new(x, y, z));
            }
        }
    }
}

/// Square of the distance between two boxes of lattice points.
fn gap_squared(a: (IVec3, IVec3), b: (IVec3, IVec3)) -> i32 {
    (b.0 - a.1).max(a.0 - b.1).max(IVec3::ZERO).length_squared()
}

/// Buffers that a thread uses for one tile after the other.
#[derive(Default)]
struct Scratch {
    /// Places of leaves of the surface, with the squares of their distances from the tile.
    near: Vec<(usize, i32)>,
    /// The part of the tile that is wanted, by its first and last voxel.
    bounds: (IVec3, IVec3),
    /// Square of the distance up to which triangles can be nearest to a voxel of it.
    farthest: i32,
    clusters: Clusters,
    lists: Lists,
}

struct Search<'a> {
    sources: Sources,
    surface: &'a IsoSurface<'a>,
    /// Its sharp edges, if they are to be kept.
    sharp: Option<SharpEdges>,
    field: &'a Grid,
    iso: f32,
    band: Band,
    wanted: &'a (dyn Fn(IVec3, IVec3) -> bool + Sync),
}

impl Search<'_> {
    /// Finds the leaves of the surface near a tile, none if no voxel of it can be in the band; returns the number of their triangles.
    fn collect(&self, tile: IVec3, scratch: &mut Scratch) -> u64 {
        scratch.bounds = self.wanted_part(tile);
        let Scratch { near, bounds, farthest, .. } = scratch;
        let bounds = *bounds;
        let reach = self.band.reach();
        // No voxel of it is farther from the surface than from the farthest point of any leaf with some of it.
        *farthest = (reach * reach).ceil() as i32;
        let mut nearest = i32::MAX;
        near.clear();
        for_each_around(tile, Sources::steps(reach), |other| {
            let Some(range) = self.sources.tiles.get(&other) else { return };
            for &(first, place) in &self.sources.leaves[range.clone()] {
                let last = first + LEAF_DIM;
                let gap = gap_squared(bounds, (first, last));
                nearest = nearest.min(gap);
                *farthest = (*farthest).min((last - bounds.0).max(bounds.1 - first).length_squared());
                near.push((place, gap));
            }
        });
        let side = if nearest == 0 {
            Side::Near
        } else {
            let (lo, hi) = ((nearest as f32).sqrt(), (*farthest as f32).sqrt());
            // Beyond the reach the upper bound is none.
            let hi = if hi < reach { hi } else { f32::INFINITY };
            if self.inside(bounds.0) { self.band.side(-hi, -lo) } else { self.band.side(lo, hi) }
        };
        near.retain(|(_, gap)| side == Side::Near && *gap <= *farthest);
        let triangles = |&(place, _): &(usize, i32)| {
            let sharp = self.sharp.as_ref().map_or(0, |edges| edges.triangles_at_most(place));
            u64::from(self.surface.leaves()[place].triangles) + sharp
        };
        near.iter().map(triangles).sum()
    }

    /// The box of the leaves of a tile that are wanted. At an offset the tile itself: blocks that reach beyond the box are then judged by the sign of a voxel
    /// whose triangles were not collected; without, both sides of the band are alike.
    fn wanted_part(&self, tile: IVec3) -> (IVec3, IVec3) {
        let whole = tile_bounds(tile);
        if self.band.offset != 0.0 {
            return whole;
        }
        let along = || (0..TILE / LEAF_DIM).map(|k| k * LEAF_DIM);
        let leaves = along().flat_map(|x| along().flat_map(move |y| along().map(move |z| IVec3::new(x, y, z))));
        let leaves = leaves.map(|leaf| (whole.0 + leaf, whole.0 + leaf + (LEAF_DIM - 1)));
        let wanted = leaves.filter(|&(first, last)| (self.wanted)(first, last));
        wanted.reduce(|(lo, hi), (first, last)| (lo.min(first), hi.max(last))).unwrap_or(whole)
    }

    /// Adds the leaves of a tile that have voxels in the band, from the triangles of what was collected.
    fn tile(&self, tile: IVec3, scratch: &mut Scratch, leaves: &mut Vec<Leaf>) {
        let Scratch { near, bounds, farthest, clusters, lists } = scratch;
        if near.is_empty() {
            return;
        }
        let first = tile_bounds(tile).0;
        clusters.clear();
        for &(place, _) in near.iter() {
            let leaf = &self.surface.leaves()[place];
            let from = self.field.origin(leaf.id);
            let wanted = |cell: IVec3| gap_squared(*bounds, (from + cell, from + cell + 1)) <= *farthest;
            self.surface.for_each_triangle(leaf, wanted, |cell, corners| {
                clusters.push((from + cell - first).as_vec3(), corners);
            });
            if let Some(edges) = &self.sharp {
                edges.for_each_triangle(self.surface, place, wanted, |cell, corners| {
                    clusters.push((from + cell - first).as_vec3(), corners);
                });
            }
        }
        clusters.finish();
        self.halves(first, Block::WHOLE, clusters, &clusters.boxes, lists, leaves);
    }

    /// Goes down into the eight halves of a block, whose candidates are `from`.
    fn halves(
        &self,
        tile: IVec3,
        block: Block,
        clusters: &Clusters,
        from: &Candidates,
        lists: &mut [Candidates],
        leaves: &mut Vec<Leaf>,
    ) {
        let Some((list, lists)) = lists.split_first_mut() else { return };
        for mut half in block.halves() {
            let first = tile + half.origin;
            if half.edge >= LEAF_DIM && !(self.wanted)(first, first + (half.edge - 1)) {
                continue;
            }
            if self.enter(tile, &mut half, clusters, from, list) != Side::Near {
                continue;
            }
            if half.edge == LEAF_DIM {
                if let [last, ..] = lists {
                    leaves.push((tile + half.origin, LeafValues::default(), LeafMask::EMPTY));
                    if let Some((_, values, active)) = leaves.last_mut() {
                        self.leaf(tile, half, clusters, list, last, values, active);
                        if active.is_empty() {
                            leaves.pop();
                        }
                    }
                }
            } else {
                self.halves(tile, half, clusters, list, lists, leaves);
            }
        }
    }

    /// Where a block lies; if it is near, `list` gets those of its candidates that can be nearest to a voxel of it.
    fn enter(
        &self,
        tile: IVec3,
        block: &mut Block,
        clusters: &Clusters,
        from: &Candidates,
        list: &mut Candidates,
    ) -> Side {
        let reach = self.band.reach();
        let (distance, radius) = (block.distance(clusters, from, reach), block.radius());
        let (lo, hi) = (distance - radius, distance + radius);
        let side = if lo <= 0.0 {
            self.band.side(-hi, hi)
        } else if self.inside(tile + block.origin) {
            // No edge of the lattice crosses the surface within the block: its voxels have one sign.
            self.band.side(-hi, -lo)
        } else {
            self.band.side(lo, hi)
        };
        if side == Side::Near {
            block.narrow(distance, reach, from, list);
        }
        side
    }

    /// Fills the leaf at a block.
    #[expect(clippy::too_many_arguments, reason = "buffers that are reused from leaf to leaf")]
    fn leaf(
        &self,
        tile: IVec3,
        block: Block,
        clusters: &Clusters,
        from: &Candidates,
        list: &mut Candidates,
        values: &mut LeafValues,
        active: &mut LeafMask,
    ) {
        let Band { offset, voxel_size, background, .. } = self.band;
        let [limit_outside, limit_inside] = [false, true].map(|inside| self.band.limit(inside));
        let origin = tile + block.origin;
        let id = self.field.find(origin);
        let (field, was) = (&self.field.values(id).0, self.field.mask(id));
        for mut half in block.halves() {
            let first = tile + half.origin;
            if self.band.keeps && !(self.wanted)(first, first + (half.edge - 1)) {
                let first = half.origin - block.origin;
                for (x, y) in (0..BLOCK).flat_map(|x| (0..BLOCK).map(move |y| (x, y))) {
                    let start = leaf_offset(first + IVec3::new(x, y, 0));
                    let row = start..start + BLOCK as usize;
                    values.0[row.clone()].copy_from_slice(&field[row.clone()]);
                    row.for_each(|at| active.set(at, was.get(at)));
                }
                continue;
            }
            let side = self.enter(tile, &mut half, clusters, from, list);
            let mut squared = [[f32::INFINITY; BLOCK as usize]; (BLOCK * BLOCK) as usize];
            let first = half.origin - block.origin;
            let start_of = |row: usize| (first.x * 64 + first.y * 8 + first.z) as usize + row / 4 * 64 + row % 4 * 8;
            if side == Side::Near {
                for (row, squared) in squared.iter_mut().enumerate() {
                    for (value, squared) in field[start_of(row)..].iter().zip(squared) {
                        let limit = if *value < self.iso { limit_inside } else { limit_outside };
                        *squared = limit * limit;
                    }
                }
                half.look_up(clusters, list, &mut squared);
            }
            for (row, squared) in squared.iter().enumerate() {
                let start = start_of(row);
                for (at, squared) in (start..LEAF_VOXELS).zip(squared) {
                    let distance = squared.sqrt();
                    let unsigned = f64::from(distance);
                    let (signed, limit) = if field[at] < self.iso {
                        (-unsigned - offset, limit_inside)
                    } else {
                        (unsigned - offset, limit_outside)
                    };
                    let phi = (signed * voxel_size) as f32;
                    // What lies beyond the limit is farther than the band.
                    let known = distance < limit;
                    let (near, phi) = match side {
                        Side::Near => (known && phi.abs() < background, phi),
                        Side::Inside => (false, -background),
                        Side::Outside => (false, background),
                    };
                    values.0[at] = if near { phi } else { background.copysign(phi) };
                    active.set(at, near);
                }
            }
        }
    }

    fn inside(&self, ijk: IVec3) -> bool {
        self.field.voxel(ijk).0 < self.iso
    }
}
