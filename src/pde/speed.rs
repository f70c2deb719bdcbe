//! What a flow says: how fast the surface moves, once a leaf, on arrays.

use fearless_simd::{Simd, SimdBase};

use super::step::LeafKernel;
use crate::grid::{Grid, LEAF_VOXELS, LeafId, LeafMask, LeafValues};
use crate::stencil::Halo;
use crate::stencil::curvature::{laplacian, mean_curvature};
use crate::stencil::simd::Lanes;

/// The |∇φ| that a speed is multiplied with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GradientNorm {
    /// Central differences: for purely parabolic speeds.
    Central,
    /// None: the "speed" is −φ_t itself. For diffusion of the field, which is no motion along normals.
    Unit,
}

/// Fields that a speed function wants computed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WantedFields {
    /// [`LeafFields::mean_curvature`] and the central |∇φ|.
    pub mean_curvature: bool,
    /// [`LeafFields::laplacian`].
    pub laplacian: bool,
}

/// Fields of one leaf, computed on the rows that have voxels to move; the others hold values of other leaves.
pub struct LeafFields {
    /// H = (κ₁ + κ₂)/2, 1/world, positive on convex parts.
    pub mean_curvature: [f32; LEAF_VOXELS],
    /// Δφ, 1/world.
    pub laplacian: [f32; LEAF_VOXELS],
    /// |∇φ| by central differences.
    gradient: [f32; LEAF_VOXELS],
}

/// F in φ_t = −F |∇φ|: the speed along the outward normal, world units a unit of time. F > 0 adds material.
pub trait SpeedFunction: Sync {
    /// What it reads.
    fn wants(&self) -> WantedFields;

    /// The |∇φ| that multiplies F.
    fn gradient_norm(&self) -> GradientNorm;

    /// The largest stable time step for a voxel size (world units).
    fn largest_step(&self, voxel_size: f64) -> f64;

    /// Fills F for one leaf.
    fn speed(&self, fields: &LeafFields, speed: &mut [f32; LEAF_VOXELS]);
}

/// One Euler step φ − dt·F|∇φ|.
pub(super) struct FlowStep<'a> {
    pub function: &'a dyn SpeedFunction,
    pub dt: f32,
    pub voxel_size: f32,
}

/// Buffers of a task.
pub(super) struct FlowScratch {
    halo: Halo,
    fields: LeafFields,
    speed: [f32; LEAF_VOXELS],
}

impl LeafKernel for FlowStep<'_> {
    type Scratch = FlowScratch;

    fn scratch(&self) -> FlowScratch {
        const ZERO: [f32; LEAF_VOXELS] = [0.0; LEAF_VOXELS];
        FlowScratch {
            halo: Halo::new(),
            fields: LeafFields { mean_curvature: ZERO, laplacian: ZERO, gradient: ZERO },
            speed: ZERO,
        }
    }

    #[inline(always)]
    fn euler<S: Simd>(
        &self,
        simd: S,
        grid: &Grid,
        id: LeafId,
        rows: LeafMask,
        scratch: &mut FlowScratch,
        out: &mut LeafValues,
    ) {
        let FlowScratch { halo, fields, speed } = scratch;
        let wants = self.function.wants();
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                if wants.mean_curvature {
                    let rows = mean_curvature(simd, halo, x, y, self.voxel_size);
                    rows.mean.store_slice(&mut fields.mean_curvature[at..at + 16]);
                    rows.gradient.store_slice(&mut fields.gradient[at..at + 16]);
                }
                if wants.laplacian {
                    let rows = laplacian(simd, halo, x, y, self.voxel_size);
                    rows.store_slice(&mut fields.laplacian[at..at + 16]);
                }
            },
        );
        self.function.speed(fields, speed);
        let central = self.function.gradient_norm() == GradientNorm::Central;
        rows.for_each_pair(
            #[inline(always)]
            |x, y, _| {
                let at = x * 64 + y * 8;
                let mut rate = Lanes::from_slice(simd, &speed[at..at + 16]) * self.dt;
                if central {
                    rate *= Lanes::from_slice(simd, &fields.gradient[at..at + 16]);
                }
                (halo.rows(simd, x, y, [0; 3]) - rate).store_slice(&mut out.0[at..at + 16]);
            },
        );
    }
}
