//! A number at each voxel of a band: what is computed of a level set and is no distance.

use std::ops::Range;

use glam::{DVec3, IVec3};
use rustc_hash::FxHashMap;

use super::LevelSet;
use crate::error::Result;
use crate::grid::{Accessor, Grid, LeafId, MAX_COORD, Transform, offset_to_local};

/// A float a voxel, beside a level set: active where it has a value, 0 elsewhere. Cheap to clone.
#[derive(Clone)]
pub struct Field {
    grid: Grid,
    transform: Transform,
}

impl Field {
    /// A field of a grid whose background and inactive voxels are 0 ([`Grid::zeroed`]).
    pub(crate) fn new(grid: Grid, transform: Transform) -> Self {
        Self { grid, transform }
    }

    /// Three numbers for each active voxel of a level set, found for the world positions of those of a leaf, as a field each.
    pub(crate) fn three_of(
        level_set: &LevelSet,
        find: impl Fn(&[DVec3]) -> Result<Vec<[f32; 3]>>,
    ) -> Result<[Self; 3]> {
        let (grid, transform) = (level_set.grid(), *level_set.transform());
        let voxels: Vec<(LeafId, usize)> =
            grid.leaves().iter().flat_map(|&id| grid.mask(id).iter().map(move |offset| (id, offset))).collect();
        let xyz: Vec<DVec3> = voxels
            .iter()
            .map(|&(id, offset)| transform.voxel_to_world(grid.origin(id) + offset_to_local(offset)))
            .collect();
        let found = find(&xyz)?;
        let mut of_leaf: FxHashMap<LeafId, Range<usize>> = FxHashMap::default();
        for (n, (id, _)) in voxels.iter().enumerate() {
            of_leaf.entry(*id).or_insert(n..n).end = n + 1;
        }
        let component = |axis: usize| {
            let mut component = grid.zeroed();
            component.update_all(|id, values, _| {
                for n in of_leaf.get(&id).cloned().into_iter().flatten() {
                    if let Some(numbers) = found.get(n) {
                        values.0[voxels[n].1] = numbers[axis];
                    }
                }
            });
            Self::new(component, transform)
        };
        Ok([component(0), component(1), component(2)])
    }

    /// Values and active voxels.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Index space ↔ world space.
    pub fn transform(&self) -> &Transform {
        &self.transform
    }

    /// Reads single voxels.
    pub fn accessor(&self) -> Accessor<'_> {
        self.grid.accessor()
    }

    /// Trilinear interpolation in index space over the voxels that have a value; `None` where none of a cell's has.
    pub fn trilinear(accessor: &mut Accessor<'_>, ijk: DVec3) -> Option<f32> {
        let limit = f64::from(MAX_COORD - 2);
        if ijk.is_nan() || ijk.abs().max_element() >= limit {
            return None;
        }
        let (cell, t) = (ijk.floor(), ijk - ijk.floor());
        let (mut sum, mut weights) = (0.0, 0.0);
        for c in 0..8 {
            let step = IVec3::new(c >> 2, c >> 1 & 1, c & 1);
            let part = |t: f64, one: i32| if one == 1 { t } else { 1.0 - t };
            let weight = part(t.x, step.x) * part(t.y, step.y) * part(t.z, step.z);
            let voxel = cell.as_ivec3() + step;
            if weight > 0.0 && accessor.is_active(voxel) {
                (sum, weights) = (sum + weight * f64::from(accessor.value(voxel)), weights + weight);
            }
        }
        (weights > 0.0).then(|| (sum / weights) as f32)
    }

    /// Smallest and largest value of the active voxels; `None` if there are none.
    pub fn range(&self) -> Option<(f32, f32)> {
        let of_leaf = |id| {
            let values = &self.grid.values(id).0;
            self.grid.mask(id).iter().map(|o| (values[o], values[o])).reduce(join)
        };
        self.grid.map_leaves(of_leaf).into_iter().flatten().reduce(join)
    }
}

fn join(a: (f32, f32), b: (f32, f32)) -> (f32, f32) {
    (a.0.min(b.0), a.1.max(b.1))
}
