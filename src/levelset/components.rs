//! Connected parts of the inside: 6 neighbours, as the surface separates them.
//!
//! Each leaf is split into its own connected parts by bit masks, and the solid space between leaves into runs of
//! absent leaves along z; parts and runs that touch are then joined. A large interior costs one run a column of
//! leaves, not its voxels.

use std::cmp::Reverse;

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use smallvec::SmallVec;

use super::LevelSet;
use super::isosurface::{IsoSurface, MEMORY_ADVICE};
use super::union_find::UnionFind;
use crate::error::Result;
use crate::grid::{Face, Grid, LEAF_DIM, LeafId, LeafMask, leaf_offset, leaf_origin, neighbour_index};
use crate::run::RunOptions;

const OPERATION: &str = "components";

/// The connected parts of the inside of a level set, numbered from the largest.
pub struct Components {
    grid: Grid,
    split: Split,
    /// Component by number of part or run.
    labels: Vec<u32>,
    voxels: Vec<u64>,
}

impl LevelSet {
    /// Finds the connected parts of the inside.
    pub fn components(&self, run: &RunOptions) -> Result<Components> {
        let grid = self.grid();
        let surface = IsoSurface::new(grid, 0.0, OPERATION, run)?;
        run.reserve(OPERATION, bytes_needed(grid), MEMORY_ADVICE)?;
        let split = Split::new(grid, &surface);
        run.check(OPERATION)?;
        Ok(Components::new(grid.clone(), split))
    }
}

impl Components {
    fn new(grid: Grid, split: Split) -> Self {
        let sizes: Vec<u64> = split.parts.iter().flatten().map(|part| u64::from(part.count())).collect();
        let column = (LEAF_DIM * LEAF_DIM) as u64;
        let of_runs = split.runs.iter().map(|run| u64::from(run.end.abs_diff(run.origin.z)) * column);
        let roots: Vec<u32> = (0..split.count_of_numbers()).map(|i| split.sets.root(i)).collect();
        let mut of_root = vec![0u64; roots.len()];
        for (&root, size) in roots.iter().zip(sizes.into_iter().chain(of_runs)) {
            of_root[root as usize] += size;
        }
        let mut order: Vec<u32> = (0..split.count_of_numbers()).filter(|&i| roots[i as usize] == i).collect();
        // Equally large ones keep the order in which they begin.
        order.sort_by_key(|&root| Reverse(of_root[root as usize]));
        let mut of = vec![0u32; roots.len()];
        for (label, &root) in (0..).zip(&order) {
            of[root as usize] = label;
        }
        let labels = roots.iter().map(|&root| of[root as usize]).collect();
        let voxels = order.iter().map(|&root| of_root[root as usize]).collect();
        Self { grid, split, labels, voxels }
    }

    /// Inside voxels of each component, the largest first.
    pub fn voxels(&self) -> &[u64] {
        &self.voxels
    }

    /// The component of an inside voxel; `None` outside.
    pub fn at(&self, ijk: IVec3) -> Option<u32> {
        let origin = leaf_origin(ijk);
        let id = self.grid.find(origin);
        let number = match id {
            LeafId::OUTSIDE => return None,
            LeafId::INSIDE => self.split.run_number(find_run(&self.split.runs, origin)?),
            _ => {
                let part = self.split.parts_of(id).iter().position(|part| part.get(leaf_offset(ijk)))?;
                self.split.first_part[id.index()] + part as u32
            }
        };
        self.labels.get(number as usize).copied()
    }

    /// The component of an index-space position near the surface: that of the nearest inside voxel among the corners of its
    /// cell, or of the cells around where all are outside (as beside a voxel on the surface); `None` far outside.
    pub fn nearest(&self, ijk: DVec3) -> Option<u32> {
        let limit = f64::from(crate::grid::MAX_COORD - 4);
        if ijk.is_nan() || ijk.abs().max_element() >= limit {
            return None;
        }
        let first = ijk.floor().as_ivec3();
        let nearest_of = |lo: i32, hi: i32| {
            let voxels =
                (lo..=hi).flat_map(|x| (lo..=hi).flat_map(move |y| (lo..=hi).map(move |z| IVec3::new(x, y, z))));
            let inside = voxels.filter_map(|step| {
                let voxel = first + step;
                self.at(voxel).map(|label| (voxel.as_dvec3().distance_squared(ijk), label))
            });
            inside.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, label)| label)
        };
        nearest_of(0, 1).or_else(|| nearest_of(-1, 2))
    }
}

/// Number of connected parts of the inside.
pub(super) fn count(grid: &Grid, surface: &IsoSurface) -> u64 {
    Split::new(grid, surface).sets.count()
}

/// The parts of the leaves and the runs between them, joined. Parts are numbered leaf by leaf, the runs behind them.
struct Split {
    /// Parts by place of the leaf.
    parts: Vec<Parts>,
    /// Number of the first part, and place in `parts`, by slot.
    first_part: Vec<u32>,
    place: Vec<u32>,
    total: u32,
    runs: Vec<Run>,
    sets: UnionFind,
}

impl Split {
    fn new(grid: &Grid, surface: &IsoSurface) -> Self {
        let leaves = grid.leaves();
        let parts: Vec<Parts> = grid.map_leaves(|id| split(*surface.inside(id)));
        let mut first_part = vec![0u32; grid.slot_count()];
        let place = grid.places();
        let mut total = 0;
        for (&id, parts) in leaves.iter().zip(&parts) {
            first_part[id.index()] = total;
            total += parts.len() as u32;
        }
        let runs = runs_of(&grid.inside_tiles());
        let run_number = |i: usize| total + i as u32;
        let sets = UnionFind::new(total as usize + runs.len());

        leaves.par_iter().zip(&parts).with_min_len(64).for_each(|(&id, own)| {
            let origin = grid.origin(id);
            for face in Face::ALL {
                let beyond = grid.neighbours()[id.index()][neighbour_index(face.step())];
                if beyond == LeafId::OUTSIDE {
                    continue;
                }
                let upper = matches!(face, Face::XPlus | Face::YPlus | Face::ZPlus);
                for (i, part) in own.iter().enumerate() {
                    let spill = part.spill(face);
                    let number = first_part[id.index()] + i as u32;
                    if beyond == LeafId::INSIDE {
                        let run = find_run(&runs, origin + face.step() * LEAF_DIM).filter(|_| !spill.is_empty());
                        if let Some(run) = run {
                            sets.join(number, run_number(run));
                        }
                    } else if upper {
                        for (k, other) in parts[place[beyond.index()] as usize].iter().enumerate() {
                            if !spill.zip(*other, |a, b| a & b).is_empty() {
                                sets.join(number, first_part[beyond.index()] + k as u32);
                            }
                        }
                    }
                }
            }
        });
        runs.par_iter().enumerate().for_each(|(i, run)| {
            for step in [IVec3::X, IVec3::Y] {
                let beside = run.origin + step * LEAF_DIM;
                // The first run of that column that ends above this one's beginning.
                let first = runs.partition_point(|r| (r.origin.x, r.origin.y, r.end) <= (beside.x, beside.y, beside.z));
                let touching = runs[first..]
                    .iter()
                    .take_while(|r| (r.origin.x, r.origin.y) == (beside.x, beside.y) && r.origin.z < run.end);
                for k in 0..touching.count() {
                    sets.join(run_number(i), run_number(first + k));
                }
            }
        });
        Self { parts, first_part, place, total, runs, sets }
    }

    fn run_number(&self, run: usize) -> u32 {
        self.total + run as u32
    }

    /// How many parts and runs there are.
    fn count_of_numbers(&self) -> u32 {
        self.total + self.runs.len() as u32
    }

    fn parts_of(&self, id: LeafId) -> &[LeafMask] {
        &self.parts[self.place[id.index()] as usize]
    }
}

/// Bytes that [`count`] needs, where few leaves have more than one part.
pub(super) fn bytes_needed(grid: &Grid) -> u64 {
    (grid.leaves().len() * (size_of::<Parts>() + 3 * size_of::<u32>())) as u64
}

/// The connected parts of one leaf's inside: rarely more than one.
pub(super) type Parts = SmallVec<[LeafMask; 1]>;

pub(super) fn split(inside: LeafMask) -> Parts {
    let mut rest = inside;
    let mut parts = Parts::new();
    while let Some(seed) = rest.iter().next() {
        let mut part = LeafMask::EMPTY;
        part.set(seed, true);
        loop {
            let grown = part.dilated().zip(rest, |a, b| a & b);
            if grown == part {
                break;
            }
            part = grown;
        }
        rest = rest.zip(part, |a, b| a & !b);
        parts.push(part);
    }
    parts
}

/// A row of absent inside leaves along z, from the voxel `origin` up to z = `end` (excluded).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Run {
    origin: IVec3,
    end: i32,
}

/// The runs of all tiles (by origin, with their edges), sorted by origin.
fn runs_of(tiles: &[(IVec3, i32)]) -> Vec<Run> {
    let (large, small): (Vec<_>, Vec<_>) = tiles.iter().copied().partition(|(_, edge)| *edge > LEAF_DIM);
    // Tiles of one size come column by column; whole nodes are joined along z before they are cut into columns of
    // leaves.
    let mut runs = join_along_z(small.into_iter().map(|(origin, edge)| Run { origin, end: origin.z + edge }));
    for (edge, tower) in towers(&large) {
        for x in (0..edge).step_by(LEAF_DIM as usize) {
            for y in (0..edge).step_by(LEAF_DIM as usize) {
                runs.push(Run { origin: tower.origin + IVec3::new(x, y, 0), ..tower });
            }
        }
    }
    runs.par_sort_unstable_by_key(|r| (r.origin.x, r.origin.y, r.origin.z));
    join_along_z(runs.into_iter())
}

/// Whole nodes joined along z, with their edge.
fn towers(tiles: &[(IVec3, i32)]) -> Vec<(i32, Run)> {
    let Some(&(_, edge)) = tiles.first() else { return Vec::new() };
    let runs = tiles.iter().map(|&(origin, edge)| Run { origin, end: origin.z + edge });
    join_along_z(runs).into_iter().map(|run| (edge, run)).collect()
}

/// Joins runs that continue the one before.
fn join_along_z(runs: impl Iterator<Item = Run>) -> Vec<Run> {
    let mut joined: Vec<Run> = Vec::new();
    for run in runs {
        match joined.last_mut() {
            Some(last) if last.origin.with_z(last.end) == run.origin => last.end = run.end,
            _ => joined.push(run),
        }
    }
    joined
}

/// The run that holds the absent leaf at `origin`.
fn find_run(runs: &[Run], origin: IVec3) -> Option<usize> {
    let after = runs.partition_point(|r| (r.origin.x, r.origin.y, r.origin.z) <= (origin.x, origin.y, origin.z));
    let run = after.checked_sub(1)?;
    let Run { origin: first, end } = runs[run];
    ((first.x, first.y) == (origin.x, origin.y) && origin.z < end).then_some(run)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{block, noise, sampled};

    #[test]
    fn tiles_become_runs_along_z() {
        let tiles =
            [(IVec3::new(0, 0, -8), 8), (IVec3::ZERO, 128), (IVec3::new(0, 0, 128), 128), (IVec3::new(0, 8, 256), 8)];
        let runs = runs_of(&tiles);
        assert_eq!(runs.len(), 256);
        assert_eq!(runs[0], Run { origin: IVec3::new(0, 0, -8), end: 256 });
        assert_eq!(runs[1], Run { origin: IVec3::new(0, 8, 0), end: 264 });
        assert_eq!(find_run(&runs, IVec3::new(0, 8, 256)), Some(1));
        assert_eq!(find_run(&runs, IVec3::new(0, 8, 264)), None);
        assert_eq!(find_run(&runs, IVec3::new(0, 0, -16)), None);
        assert_eq!(find_run(&runs, IVec3::new(128, 0, 0)), None);
    }

    #[test]
    fn components_are_numbered_from_the_largest() {
        // A ball with an absent interior, a small one, and two voxels that touch at an edge of theirs only.
        let balls = sampled(60, |p| {
            let large = (p - DVec3::new(-20.0, 0.0, 0.0)).length() - 30.0;
            large.min((p - DVec3::new(40.0, 3.0, 0.0)).length() - 9.0)
        });
        let components = balls.components(&RunOptions::default()).unwrap();
        let volumes = [30.0f64, 9.0].map(|r| 4.0 / 3.0 * std::f64::consts::PI * r.powi(3));
        assert_eq!(components.voxels().len(), 2);
        for (&voxels, volume) in components.voxels().iter().zip(volumes) {
            // The lattice has none of the points right on the small ball: 3 % of its volume.
            assert!((voxels as f64 / volume - 1.0).abs() < 0.03, "{voxels} {volume}");
        }
        for (ijk, label) in [((-20, 0, 0), Some(0)), ((9, 0, 0), Some(0)), ((40, 3, 0), Some(1)), ((20, 0, 0), None)] {
            assert_eq!(components.at(ijk.into()), label, "{ijk:?}");
        }
        assert_eq!(components.nearest(DVec3::new(10.0, 0.1, 0.1)), Some(0));
        assert_eq!(components.nearest(DVec3::new(31.0, 3.0, 0.0)), Some(1));
        assert_eq!(components.nearest(DVec3::splat(f64::NAN)), None);
        let pair = block(2, |ijk| if ijk == IVec3::splat(7) || ijk == IVec3::new(7, 8, 8) { -0.5 } else { 0.5 });
        assert_eq!(pair.components(&RunOptions::default()).unwrap().voxels(), [1, 1]);
    }

    #[test]
    fn noise_has_as_many_components_as_measured() {
        for (seed, inside) in [(1, 0.2), (2, 0.4)] {
            let level_set = noise(3, seed, inside);
            let components = level_set.components(&RunOptions::default()).unwrap();
            let measures = level_set.measure(&RunOptions::default()).unwrap();
            assert_eq!(components.voxels().len() as u64, measures.components);
            assert!(components.voxels().is_sorted_by(|a, b| a >= b));
            // Neighbours along the axes belong together, and every voxel counts once.
            let mut counts = vec![0; components.voxels().len()];
            for i in 0..24 * 24 * 24 {
                let ijk = IVec3::new(i / 576, i / 24 % 24, i % 24);
                let Some(label) = components.at(ijk) else { continue };
                counts[label as usize] += 1;
                assert!(components.at(ijk + IVec3::X).is_none_or(|other| other == label));
            }
            assert_eq!(counts, components.voxels());
        }
    }

    #[test]
    fn a_leaf_is_split_into_its_parts() {
        // Voxels that touch at edges and corners only stay apart; a snake through the whole leaf is one.
        let mut checkerboard = LeafMask::EMPTY;
        let mut snake = LeafMask::EMPTY;
        for offset in 0..512 {
            let p = crate::grid::offset_to_local(offset);
            checkerboard.set(offset, p.element_sum() % 2 == 0);
            let turn = if p.y % 4 == 1 { p.z == 7 } else { p.z == 0 };
            snake.set(offset, p.x % 2 == 0 && (p.y % 2 == 0 || turn) || (p.x % 2 == 1 && p.y == 0 && p.z == 0));
        }
        assert_eq!(split(checkerboard).len(), 256);
        assert_eq!(split(snake).len(), 1);
        assert!(split(LeafMask::EMPTY).is_empty());
    }
}
