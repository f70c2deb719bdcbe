//! A surface as a narrow-band level set: signed distance φ near the surface, its sign everywhere.
//!
//! φ is in world units and negative inside. Voxels with |φ| < background are active and hold the distance, all others are
//! ±background; background = half width · voxel size. [`check`](LevelSet::check) verifies these invariants.

mod build;
mod check;
mod components;
mod curvature;
mod curve;
pub(crate) mod dual;
pub mod expression;
mod field;
mod geodesic;
pub(crate) mod isosurface;
mod lattice;
pub(crate) mod marching;
mod measure;
pub(crate) mod sample;
pub mod shapes;
pub(crate) mod sharp;
pub mod smooth_csg;
mod specks;
mod sweep;
#[cfg(test)]
pub(crate) mod testing;
mod union_find;
mod violation;

use glam::{DVec3, IVec3};

pub(crate) use build::grid_of_parts;
pub use build::{BYTES_A_LEAF, grid_of_leaves};
pub use components::Components;
pub use curvature::{CurvatureKind, curvature, curvature_of};
pub use curve::curve_length;
pub use field::Field;
pub use geodesic::Geodesic;
pub use measure::Measures;
pub use sample::{Interpolation, Sampler};
pub use sweep::{extend_field, sweep_distance};
pub(crate) use union_find::UnionFind;
pub use violation::{Violation, ViolationKind};

use crate::grid::{Grid, Transform};

/// The half width of the narrow band used where none is asked for, in voxels; OpenVDB's default as well.
pub const DEFAULT_HALF_WIDTH: f32 = 3.0;

/// A narrow-band level set: a [`Grid`] of signed distances and its place in the world. Cheap to clone.
#[derive(Clone)]
pub struct LevelSet {
    grid: Grid,
    transform: Transform,
}

impl LevelSet {
    /// A level set from a grid of distances in world units.
    pub fn new(grid: Grid, transform: Transform) -> Self {
        Self { grid, transform }
    }

    /// No surface at all: outside everywhere.
    pub fn empty(transform: Transform, half_width: f32) -> Self {
        Self::new(Grid::empty(background(half_width, &transform)), transform)
    }

    /// The field φ.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// The field φ, to be changed. The invariants are the caller's business.
    pub fn grid_mut(&mut self) -> &mut Grid {
        &mut self.grid
    }

    /// The field alone.
    pub fn into_grid(self) -> Grid {
        self.grid
    }

    /// Index space ↔ world space.
    pub fn transform(&self) -> &Transform {
        &self.transform
    }

    /// The same field elsewhere in the world. The voxel size must be the same, because φ is in world units.
    pub fn with_transform(self, transform: Transform) -> Self {
        debug_assert!((transform.voxel_size() / self.voxel_size() - 1.0).abs() < 1e-6);
        Self { transform, ..self }
    }

    /// Edge of a voxel in world units.
    pub fn voxel_size(&self) -> f64 {
        self.transform.voxel_size()
    }

    /// |φ| outside the band, in world units.
    pub fn background(&self) -> f32 {
        self.grid.background()
    }

    /// Half width of the band in voxels, derived from the background.
    ///
    /// The quotient is rounded twice and may miss the number that the background was made of by its last bit. So a decimal
    /// number of few digits that gives the same background is taken instead: what is converted to this width gets the same bits.
    pub fn half_width(&self) -> f32 {
        const DIGITS: f64 = 1e5;
        let quotient = f64::from(self.background()) / self.voxel_size();
        let decimal = ((quotient * DIGITS).round() / DIGITS) as f32;
        match background(decimal, self.transform()) == self.background() {
            true => decimal,
            false => quotient as f32,
        }
    }

    /// Whether there is no surface: no active voxel and no inside.
    pub fn is_empty(&self) -> bool {
        self.grid.leaves().is_empty() && self.grid.inside_tiles().is_empty()
    }

    /// World-space box around the active voxels; `None` if there are none.
    pub fn world_bounds(&self) -> Option<(DVec3, DVec3)> {
        let (lo, hi) = self.grid.active_bounds()?;
        Some(
            box_corners(lo, hi)
                .map(|c| self.transform.index_to_world(c))
                .into_iter()
                .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(a, b), c| (a.min(c), b.max(c))),
        )
    }

    /// Reads φ at any point.
    pub fn sampler(&self) -> Sampler<'_> {
        Sampler::new(&self.grid, self.voxel_size())
    }
}

/// |φ| outside a band of `half_width` voxels, as stored: rounded to f32 from the product in f64.
pub fn background(half_width: f32, transform: &Transform) -> f32 {
    (f64::from(half_width) * transform.voxel_size()) as f32
}

fn box_corners(lo: IVec3, hi: IVec3) -> [DVec3; 8] {
    let (lo, hi) = (lo.as_dvec3(), hi.as_dvec3());
    std::array::from_fn(|c| {
        DVec3::new(
            if c & 4 == 0 { lo.x } else { hi.x },
            if c & 2 == 0 { lo.y } else { hi.y },
            if c & 1 == 0 { lo.z } else { hi.z },
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_half_width_comes_back_to_the_last_bit() {
        for half_width in [1.5, 2.25, 3.0, 3.7, 10.0, 512.0] {
            for size in [0.05, 0.1, 0.7, 1.0 / 3.0, 1.0, 1e-9, 7.3e8] {
                let transform = Transform::uniform(size);
                assert_eq!(LevelSet::empty(transform, half_width).half_width(), half_width, "{size}");
            }
        }
    }
}
