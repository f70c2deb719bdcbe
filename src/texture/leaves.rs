//! The leaves that a texture is sampled on.
//!
//! Leaves far from its surface are left out, each by a look at its middle. Where the map folds, or ends, what it leads to jumps, and a leaf left out may meet
//! one with the other sign: such leaves are made in full, until the signs on both sides of all borders agree.

use glam::IVec3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::OPERATION;
use crate::error::Result;
use crate::grid::{LEAF_DIM, LeafMask, LeafValues, leaf_offset};
use crate::levelset::{BYTES_A_LEAF, LevelSet};
use crate::run::RunOptions;

/// What a large patch is refused with.
pub(super) const ADVICE: &str = "take a smaller patch or height, or larger voxels";

/// Leaves of a grid: origin, values, which are active.
pub(super) type Leaves = Vec<(IVec3, LeafValues, LeafMask)>;

/// The voxels of a block.
pub(super) fn block(edge: i32) -> impl Iterator<Item = IVec3> {
    (0..edge.pow(3)).map(move |i| IVec3::new(i / (edge * edge), i / edge % edge, i % edge))
}

/// From the middle of a block of so many voxels along each axis to its outermost ones.
pub(super) fn radius(edge: i32) -> f64 {
    f64::from(edge - 1) / 2.0 * 3.0f64.sqrt()
}

/// A leaf in the making; what is not set is outside.
pub(super) struct Made {
    values: LeafValues,
    mask: LeafMask,
    background: f32,
    voxel_size: f64,
}

impl Made {
    /// Of a level set like `base`.
    pub fn new(base: &LevelSet) -> Self {
        let background = (base.voxel_size() * f64::from(base.half_width())) as f32;
        let voxel_size = base.voxel_size();
        Self { values: LeafValues::filled(background), mask: LeafMask::EMPTY, background, voxel_size }
    }

    /// A value in voxels.
    pub fn set(&mut self, local: IVec3, distance: f64) {
        let offset = leaf_offset(local);
        let value = (distance * self.voxel_size) as f32;
        self.values.0[offset] = value.clamp(-self.background, self.background);
        self.mask.set(offset, value.abs() < self.background);
    }

    /// A block far from the surface.
    pub fn fill(&mut self, local: IVec3, edge: i32, inside: bool) {
        let distance = f64::from(self.background) * 2.0 / self.voxel_size;
        for offset in block(edge) {
            self.set(local + offset, if inside { -distance } else { distance });
        }
    }

    /// What it is found to be: of one sign and without a band, or not.
    pub fn found(self, origin: IVec3) -> Found {
        let inside = self.values.0[0] < 0.0;
        let is_whole = self.mask.is_empty() && self.values.0.iter().all(|v| (*v < 0.0) == inside);
        if is_whole { Found::Whole(origin, inside) } else { Found::Leaf(origin, Box::new(self)) }
    }
}

/// A leaf that was looked at.
pub(super) enum Found {
    /// All of it is inside, or outside.
    Whole(IVec3, bool),
    /// It has a surface, or a band.
    Leaf(IVec3, Box<Made>),
}

/// All leaves that a level set needs: what was found (leaves not named are outside), and those beside them that meet another sign, which `full` makes.
pub(super) fn closed(found: Vec<Found>, full: impl Fn(IVec3) -> Made + Sync, run: &RunOptions) -> Result<Leaves> {
    let mut made: FxHashMap<IVec3, Box<Made>> = FxHashMap::default();
    let mut inside: FxHashSet<IVec3> = FxHashSet::default();
    let mut new = Vec::with_capacity(found.len());
    for leaf in found {
        match leaf {
            Found::Whole(_, false) => continue,
            Found::Whole(origin, true) => {
                inside.insert(origin);
                new.push(origin);
            }
            Found::Leaf(origin, leaf) => {
                made.insert(origin, leaf);
                new.push(origin);
            }
        }
    }
    while !new.is_empty() {
        let beside = |origin: &IVec3| {
            let (origin, own) = (*origin, made.get(origin));
            let absent = block(3).map(move |c| (c - 1, origin + (c - 1) * LEAF_DIM));
            let absent = absent.filter(|(_, other)| !made.contains_key(other));
            let meets = |&(step, other): &(IVec3, IVec3)| {
                let beyond = inside.contains(&other);
                own.map_or(!beyond, |own| border(step).any(|at| (own.values.0[leaf_offset(at)] < 0.0) != beyond))
            };
            absent.filter(meets).map(|(_, other)| other.to_array()).collect::<Vec<_>>()
        };
        let mut wanted: Vec<[i32; 3]> = new.par_iter().flat_map_iter(beside).collect();
        wanted.sort_unstable();
        wanted.dedup();
        run.reserve(OPERATION, wanted.len() as u64 * BYTES_A_LEAF, ADVICE)?;
        new = wanted.into_iter().map(IVec3::from_array).collect();
        let more: Vec<Box<Made>> = new.par_iter().map(|origin| Box::new(full(*origin))).collect();
        run.check(OPERATION)?;
        for (origin, leaf) in new.iter().zip(more) {
            inside.remove(origin);
            made.insert(*origin, leaf);
        }
    }
    Ok(made.into_iter().map(|(origin, leaf)| (origin, leaf.values, leaf.mask)).collect())
}

/// The voxels of a leaf that are next to the leaf a step away.
fn border(step: IVec3) -> impl Iterator<Item = IVec3> {
    let range = |s: i32| match s {
        -1 => 0..1,
        1 => LEAF_DIM - 1..LEAF_DIM,
        _ => 0..LEAF_DIM,
    };
    let [xs, ys, zs] = step.to_array().map(range);
    xs.flat_map(move |x| {
        let zs = zs.clone();
        ys.clone().flat_map(move |y| zs.clone().map(move |z| IVec3::new(x, y, z)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::grid_of_leaves;
    use crate::levelset::testing::ball;
    use crate::mesh::level_set_to_mesh;
    use glam::DVec3;

    #[test]
    fn leaves_that_meet_another_sign_are_made() {
        let base = ball(DVec3::ZERO, 3.0);
        // Two blocks of 16³ voxels, the first all inside, the second with a hole that ends at its border: nothing of them has a band.
        let solid = |ijk: IVec3| {
            let inside = ijk.cmpge(IVec3::ZERO).all() && ijk.cmplt(IVec3::new(32, 16, 16)).all();
            inside && !(ijk.x >= 24 && ijk.y < 8 && ijk.z < 8)
        };
        let full = |origin: IVec3| {
            let mut made = Made::new(&base);
            for at in block(LEAF_DIM) {
                made.set(at, if solid(origin + at) { -9.0 } else { 9.0 });
            }
            made
        };
        let leaves = block(4).map(|c| c * LEAF_DIM).filter(|o| o.y < 16 && o.z < 16);
        let found = leaves.map(|origin| full(origin).found(origin)).collect();
        let closed = closed(found, full, &RunOptions::default()).unwrap();
        assert!(closed.iter().all(|(_, _, mask)| mask.is_empty()));
        let level_set = LevelSet::new(grid_of_leaves(3.0, closed), *base.transform());
        let mesh = level_set_to_mesh(&level_set, 0.0, &RunOptions::default()).unwrap();
        let (lo, hi) = mesh.bounding_box().unwrap();
        assert_eq!((lo, hi), (DVec3::splat(-0.5), DVec3::new(31.5, 15.5, 15.5)));
    }
}
