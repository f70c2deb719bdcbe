//! Sharpening: curvature flow run backwards, F = +C(γ)·k̄ (Museth et al. 2002, equation 9), in steps of h²/6.
//!
//! Backwards the flow is ill-posed. [`pde::sharpen`] says what makes it bearable, and with what evidence: k̄ is a mean of the
//! curvature over 3×3×3 voxels, nothing is made sharper than the upper limits (0.15 to 0.25/voxel if none are given), and the
//! surface stays within `max_displacement` of where it was. Noise is not made smooth: it grows as well, but less than what is larger.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::confine::held;
use super::curvature::{CurvatureOptions, unresolved};
use super::params::VoxelLength;
use super::registry::{Arity, Operator, Outcome};
use super::solver::{EvolutionOptions, SMOOTHING, evolved};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::pde::{self, CurvatureFlow, CutOff, Report};
use crate::run::RunOptions;

/// Sharpen what is curved, everywhere or in a region.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Sharpen {
    /// The farthest that the surface moves from where it was.
    pub max_displacement: VoxelLength,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub flow: CurvatureOptions,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub evolution: EvolutionOptions,
}

impl Default for Sharpen {
    fn default() -> Self {
        Self {
            max_displacement: VoxelLength::new(1.0),
            flow: CurvatureOptions::default(),
            evolution: EvolutionOptions::default(),
        }
    }
}

/// What is sharper than a radius of four voxels is sharp enough; the growth of what is blunter slows down from seven voxels on.
const HIGH: [f64; 2] = [0.15, 0.25];

impl Operator for Sharpen {
    const NAME: &'static str = "sharpen";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        self.evolution.validate(Self::NAME)?;
        let reach = self.max_displacement.voxels(1.0);
        if !(reach > 0.0 && reach.is_finite()) {
            let accepted = "a positive length, such as 1 or 0.5wu";
            return Err(EditError::parameter(Self::NAME, "max_displacement", self.max_displacement, accepted));
        }
        self.driven().map(drop)
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let mut outcome = evolved(inputs.remove(0), run, |level_set| sharpen(level_set, self, run))?;
        outcome.summary.warnings.extend(unresolved(&self.driven()?.cut_off));
        Ok(outcome)
    }
}

impl Sharpen {
    fn driven(&self) -> Result<CurvatureFlow> {
        let refuse = |accepted| EditError::parameter(Self::NAME, "curvature_high", format!("{HIGH:?}"), accepted);
        let cut_off = CutOff::NONE.with_high(HIGH).map_err(refuse)?;
        self.flow.flow(Self::NAME, CurvatureFlow { cut_off, ..CurvatureFlow::MEAN })
    }
}

/// Sharpens in place. The band should be at least 3 voxels wide to each side.
pub fn sharpen(level_set: &mut LevelSet, params: &Sharpen, run: &RunOptions) -> Result<Report> {
    params.validate()?;
    let reach = params.max_displacement.world(level_set.voxel_size());
    let region = params.evolution.region.on(level_set, run)?;
    let (until, solver) = (params.evolution.until(), params.evolution.solver(SMOOTHING));
    let (flow, region) = (params.driven()?, region.as_deref());
    held(level_set, region, run, |moved| pde::sharpen(moved, &flow, reach, region, until, &solver, run))
}
