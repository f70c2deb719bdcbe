//! What a flow says: how fast the surface moves, once a leaf, on arrays.

use super::step::{LeafKernel, for_each_row};
use crate::grid::{Grid, LEAF_VOXELS, LeafId, LeafMask, LeafValues};
use crate::stencil::Halo;
use crate::stencil::curvature::{laplacian, mean_curvature};

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
    halo: Halo<10>,
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
    fn euler(&self, grid: &Grid, id: LeafId, rows: LeafMask, scratch: &mut FlowScratch, out: &mut LeafValues) {
        let FlowScratch { halo, fields, speed } = scratch;
        let wants = self.function.wants();
        halo.gather(grid.value_pages(), &grid.neighbours()[id.index()]);
        for_each_row(rows, |x, y| {
            let at = x * 64 + y * 8;
            if wants.mean_curvature {
                let row = mean_curvature(halo, x, y, self.voxel_size);
                fields.mean_curvature[at..at + 8].copy_from_slice(&row.mean);
                fields.gradient[at..at + 8].copy_from_slice(&row.gradient);
            }
            if wants.laplacian {
                fields.laplacian[at..at + 8].copy_from_slice(&laplacian(halo, x, y, self.voxel_size));
            }
        });
        self.function.speed(fields, speed);
        let phi = &grid.values(id).0;
        match self.function.gradient_norm() {
            GradientNorm::Central => {
                for i in 0..LEAF_VOXELS {
                    out.0[i] = phi[i] - self.dt * speed[i] * fields.gradient[i];
                }
            }
            GradientNorm::Unit => {
                for i in 0..LEAF_VOXELS {
                    out.0[i] = phi[i] - self.dt * speed[i];
                }
            }
        }
    }
}
