//! A number at each voxel of a band: what is computed of a level set and is no distance.

use crate::grid::{Accessor, Grid, Transform};

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
