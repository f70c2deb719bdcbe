//! A number at each voxel of a band: what is computed of a level set and is no distance.

use glam::{DVec3, IVec3};

use crate::grid::{Accessor, Grid, MAX_COORD, Transform};

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
        if !(ijk.abs().max_element() < limit) {
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
