//! What a flow says: how fast the surface moves.

use fearless_simd::{Simd, SimdBase};

use super::step::{LeafKernel, Rows};
use crate::grid::{Grid, LeafId, LeafValues};
use crate::stencil::LeafHalo;
use crate::stencil::simd::Lanes;

/// F in φ_t = −F |∇φ|: the speed along the outward normal, world units a unit of time. F > 0 adds material.
///
/// A flow is compiled into the driver: there is no call a voxel, nor a leaf.
pub trait SpeedFunction: Sync {
    /// The neighbourhood that it reads: [`Halo`](crate::stencil::Halo) for the 27 voxels around each,
    /// [`StarHalo`](crate::stencil::StarHalo) for those along the axes.
    type Halo: LeafHalo;

    /// The largest stable time step for a voxel size (world units).
    fn largest_step(&self, voxel_size: f64) -> f64;

    /// Whether it may pile material up at the rim of a region, and has to be held there: flows that are cut off or one-sided.
    fn needs_hold(&self) -> bool {
        false
    }

    /// F|∇φ| at rows (x, y) and (x, y + 1) of the leaf in `halo`. Must be `#[inline(always)]`.
    fn rate<S: Simd>(&self, simd: S, halo: &Self::Halo, x: usize, y: usize, voxel_size: f32) -> Lanes<S>;
}

/// One Euler step φ − dt·F|∇φ|.
pub(super) struct FlowStep<'a, F> {
    pub function: &'a F,
    pub dt: f32,
    pub voxel_size: f32,
}

impl<F: SpeedFunction> LeafKernel for FlowStep<'_, F> {
    const REACH: usize = F::Halo::REACH;

    type Scratch = F::Halo;

    fn scratch(&self) -> F::Halo {
        F::Halo::default()
    }

    #[inline(always)]
    fn euler<S: Simd>(&self, simd: S, grid: &Grid, id: LeafId, rows: Rows, halo: &mut F::Halo, out: &mut LeafValues) {
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        // Copies, so that what depends on them alone is computed once a leaf.
        let (dt, voxel_size) = (self.dt, self.voxel_size);
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let rate = self.function.rate(simd, halo, x, y, voxel_size);
                (halo.centre(simd, x, y) - rate * dt).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}
