//! Flows by curvature: φ_t = −F|∇φ| with F = ∓C(γ)·k, k one of the curvatures (Museth et al. 2002, equations 8 and 9; Whitaker & Breen
//! 1998, table 1).
//!
//! | kind | k, 1/length, positive on convex parts | γ |
//! |---|---|---|
//! | mean | H = (κ₁ + κ₂)/2 | abs(H) h |
//! | gaussian | sign(H) √max(κ₁κ₂, 0) | abs(k) h |
//! | max, min | κ₁, κ₂ | abs(k) h |
//! | convex | max(κ₁, 0) + max(κ₂, 0) | max(κ₁, 0) h |
//! | concave | min(κ₁, 0) + min(κ₂, 0) | max(−κ₂, 0) h |
//!
//! F = −k smooths, F = +k sharpens, which is ill-posed and only bearable within limits. Each k grows with the curvature matrix, so
//! that smoothing by it is a (degenerate) parabolic flow: stable up to steps of h²/3 for H, of h²/6 for those with the weight of both curvatures.
//! K itself has the unit 1/length² and does not grow with the matrix where K < 0: only its root is offered.
//!
//! On the way to rest (`Until::Rest`) the lower half of C is replaced by max(γ − l₀, 0)/γ ([`CutOff::excess`]): the flow by the excess of
//! curvature rests where the other does and gets there in steps that do not overshoot.
//!
//! Curvatures are those of [`normals`](crate::stencil::normals), clamped to what the grid resolves, 0 where |∇φ| < 0.1. |∇φ| is
//! Godunov's with the sign of the final F: a speed that is cut off or one-sided moves fronts, which central differences
//! would smear. The plain mean curvature flow alone is parabolic everywhere and takes central differences.

use fearless_simd::{Simd, SimdBase, SimdFloat};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::evolve::{Report, Until, evolve};
use super::{CutOff, Direction, SolverOptions, SpeedFunction};
use crate::error::Result;
use crate::levelset::LevelSet;
use crate::region::Region;
use crate::run::RunOptions;
use crate::stencil::curvature::mean_curvature;
use crate::stencil::normals::{Curvatures, curvatures};
use crate::stencil::simd::{Lanes, with_sign};
use crate::stencil::upwind::godunov_first;
use crate::stencil::{Halo, LeafHalo};

/// Which curvature drives a flow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[schemars(inline)]
pub enum FlowCurvature {
    /// H = (κ₁ + κ₂)/2.
    #[default]
    Mean,
    /// sign(H) √max(K, 0), K = κ₁κ₂.
    Gaussian,
    /// κ₂, the smaller principal curvature.
    Min,
    /// κ₁, the larger principal curvature.
    Max,
    /// max(κ₁, 0) + max(κ₂, 0): convex parts alone.
    Convex,
    /// min(κ₁, 0) + min(κ₂, 0): concave parts alone.
    Concave,
}

/// A flow that smooths by curvature.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CurvatureFlow {
    /// What the speed follows.
    pub curvature: FlowCurvature,
    /// Between which limits of γ.
    pub cut_off: CutOff,
    /// Which way.
    pub direction: Direction,
}

impl CurvatureFlow {
    /// F = −H, without limits.
    pub const MEAN: Self = Self { curvature: FlowCurvature::Mean, cut_off: CutOff::NONE, direction: Direction::Both };

    /// Moves a surface by this flow, everywhere or weighted by a region.
    pub fn evolve(
        &self,
        level_set: &mut LevelSet,
        region: Option<&dyn Region>,
        until: Until,
        solver: &SolverOptions,
        run: &RunOptions,
    ) -> Result<Report> {
        match until {
            _ if *self == Self::MEAN => evolve(level_set, &MeanCurvatureFlow, region, until, solver, run),
            Until::Rest(_) => evolve(level_set, &ToRest(*self), region, until, solver, run),
            _ => evolve(level_set, self, region, until, solver, run),
        }
    }
}

impl SpeedFunction for CurvatureFlow {
    type Halo = Halo;

    fn largest_step(&self, voxel_size: f64) -> f64 {
        let weight = if self.curvature == FlowCurvature::Mean { 3.0 } else { 6.0 };
        voxel_size * voxel_size / weight
    }

    #[inline(always)]
    fn rate<S: Simd>(&self, simd: S, halo: &Halo, x: usize, y: usize, voxel_size: f32) -> Lanes<S> {
        let (k, gamma) = self.curvature.of(simd, &curvatures(simd, halo, x, y, voxel_size), voxel_size);
        let speed = self.direction.constrain(simd, -k * self.cut_off.weights(simd, gamma));
        speed * upwind_gradient(simd, halo, x, y, speed, voxel_size)
    }
}

/// A flow by the excess of curvature over the lower limit.
struct ToRest(CurvatureFlow);

impl SpeedFunction for ToRest {
    type Halo = Halo;

    fn largest_step(&self, voxel_size: f64) -> f64 {
        self.0.largest_step(voxel_size)
    }

    #[inline(always)]
    fn rate<S: Simd>(&self, simd: S, halo: &Halo, x: usize, y: usize, voxel_size: f32) -> Lanes<S> {
        let (k, gamma) = self.0.curvature.of(simd, &curvatures(simd, halo, x, y, voxel_size), voxel_size);
        let speed = self.0.direction.constrain(simd, -k * self.0.cut_off.excess(simd, gamma));
        speed * upwind_gradient(simd, halo, x, y, speed, voxel_size)
    }
}

/// Godunov's |∇φ| for a speed F.
#[inline(always)]
pub(super) fn upwind_gradient<S: Simd>(
    simd: S,
    halo: &impl LeafHalo,
    x: usize,
    y: usize,
    speed: Lanes<S>,
    voxel_size: f32,
) -> Lanes<S> {
    godunov_first(simd, halo, x, y, speed).sqrt() * (1.0 / voxel_size)
}

impl FlowCurvature {
    /// k (1/world) and γ (1/voxel).
    #[inline(always)]
    pub(super) fn of<S: Simd>(self, simd: S, c: &Curvatures<S>, voxel_size: f32) -> (Lanes<S>, Lanes<S>) {
        let zero = Lanes::splat(simd, 0.0);
        let (k, largest) = match self {
            Self::Mean => (c.mean, c.mean.abs()),
            Self::Gaussian => {
                let root = c.gaussian.max(zero).sqrt();
                (with_sign(simd, root, c.mean), root)
            }
            Self::Min => (c.min, c.min.abs()),
            Self::Max => (c.max, c.max.abs()),
            Self::Convex => (c.max.max(zero) + c.min.max(zero), c.max.max(zero)),
            Self::Concave => (c.max.min(zero) + c.min.min(zero), -c.min.min(zero)),
        };
        (k, largest * voxel_size)
    }
}

/// F = −H by central differences: nothing is cut off, so there are no fronts, and no normals have to be found.
struct MeanCurvatureFlow;

impl SpeedFunction for MeanCurvatureFlow {
    type Halo = Halo;

    fn largest_step(&self, voxel_size: f64) -> f64 {
        voxel_size * voxel_size / 3.0
    }

    #[inline(always)]
    fn rate<S: Simd>(&self, simd: S, halo: &Halo, x: usize, y: usize, voxel_size: f32) -> Lanes<S> {
        -mean_curvature(simd, halo, x, y, voxel_size).motion
    }
}
