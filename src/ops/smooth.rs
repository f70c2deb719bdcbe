//! Smoothing by curvature flow or diffusion, everywhere or in a region.
//!
//! `curvature` moves the surface by its mean curvature, F = −H (Museth et al. 2002, equation 9): the area
//! falls as fast as it can, a sphere of radius R shrinks as R² − 2t. Central |∇φ|, explicit steps of h²/3.
//! `laplacian` diffuses the field, φ_t = Δφ, in steps of h²/6: the mean of the six neighbours. On a distance field it is
//! the same motion twice as fast (Δφ = κ₁ + κ₂); near creases it mixes in the field beyond the medial axis.
//!
//! Degenerate cases: where the gradient vanishes the curvature counts as 0. Parts thinner than the band shrink and vanish.
//!
//! Accuracy, measured on a sphere of 20 voxels over 60 steps: within 0.023 voxel of the exact radius in every direction
//! with one HJ-WENO5 renormalisation a step (the default); first-order renormalisation errs by up to 0.17.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::params::words;
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::EvolutionOptions;
use crate::error::Result;
use crate::grid::LEAF_VOXELS;
use crate::levelset::LevelSet;
use crate::pde::{GradientNorm, LeafFields, Report, SolverOptions, SpeedFunction, UpwindScheme, WantedFields, evolve};
use crate::run::RunOptions;

words! {
    /// How to smooth.
    SmoothMethod {
        /// Mean curvature flow.
        Curvature = "curvature",
        /// Diffusion of the distance field.
        Laplacian = "laplacian",
    }
}

/// Smooth a level set, everywhere or in a region.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Smooth {
    /// How: `curvature` moves the surface by its mean curvature (steps of h²/3), `laplacian` diffuses the field (h²/6).
    pub method: SmoothMethod,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub evolution: EvolutionOptions,
}

impl Default for Smooth {
    fn default() -> Self {
        Self { method: SmoothMethod::Curvature, evolution: EvolutionOptions::default() }
    }
}

/// The cheapest that keeps the sphere of the module's comment within 0.05 voxel.
const SOLVER: SolverOptions = SolverOptions { scheme: UpwindScheme::HjWeno5, ..SolverOptions::FIRST_ORDER };

impl Operator for Smooth {
    const NAME: &'static str = "smooth";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        self.evolution.validate(Self::NAME)
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let mut level_set = inputs.remove(0);
        let report = smooth(&mut level_set, self, run)?;
        let mut summary = Summary::from(&report);
        if report.voxels == 0 && !level_set.is_empty() {
            summary.warnings.push("the region touches no voxel of the narrow band: nothing was changed".into());
        }
        Ok(Outcome { level_set, summary })
    }
}

/// Smooths in place.
pub fn smooth(level_set: &mut LevelSet, params: &Smooth, run: &RunOptions) -> Result<Report> {
    params.validate()?;
    let region = params.evolution.region.parse()?;
    let function: &dyn SpeedFunction = match params.method {
        SmoothMethod::Curvature => &MeanCurvatureFlow,
        SmoothMethod::Laplacian => &Diffusion,
    };
    evolve(level_set, function, region.as_deref(), params.evolution.until(), &params.evolution.solver(SOLVER), run)
}

/// F = −H.
struct MeanCurvatureFlow;

impl SpeedFunction for MeanCurvatureFlow {
    fn wants(&self) -> WantedFields {
        WantedFields { mean_curvature: true, ..WantedFields::default() }
    }

    fn gradient_norm(&self) -> GradientNorm {
        GradientNorm::Central
    }

    fn largest_step(&self, voxel_size: f64) -> f64 {
        voxel_size * voxel_size / 3.0
    }

    fn speed(&self, fields: &LeafFields, speed: &mut [f32; LEAF_VOXELS]) {
        for (f, h) in speed.iter_mut().zip(&fields.mean_curvature) {
            *f = -h;
        }
    }
}

/// −φ_t = −Δφ.
struct Diffusion;

impl SpeedFunction for Diffusion {
    fn wants(&self) -> WantedFields {
        WantedFields { laplacian: true, ..WantedFields::default() }
    }

    fn gradient_norm(&self) -> GradientNorm {
        GradientNorm::Unit
    }

    fn largest_step(&self, voxel_size: f64) -> f64 {
        voxel_size * voxel_size / 6.0
    }

    fn speed(&self, fields: &LeafFields, speed: &mut [f32; LEAF_VOXELS]) {
        for (f, l) in speed.iter_mut().zip(&fields.laplacian) {
            *f = -l;
        }
    }
}
