//! Carrying a surface along with a velocity field: φ_t + V·∇φ = 0 ([`crate::pde::advect`]).
//!
//! V is a grid of vectors of a `.vdb` in world units a unit of time, interpolated linearly; beyond what is stored it is the
//! grid's background. Staggered grids, as solvers of fluids write them, are read as such.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::confine::held;
use super::registry::{Arity, Operator, Outcome};
use super::solver::{EvolutionOptions, evolved};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::pde::{SolverOptions, TimeIntegrator, Until, UpwindScheme, advect};
use crate::region::files;
use crate::run::RunOptions;

/// Carry a surface along with a velocity field, a grid of vectors of a `.vdb`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Advect {
    /// The `.vdb` with the velocities: a grid of vec3s or vec3d, in world units a unit of time.
    #[schemars(extend("x-kind" = "FILE"))]
    pub velocity: PathBuf,
    /// The grid in it; the only grid of vectors if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub velocity_grid: Option<String>,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub evolution: EvolutionOptions,
}

/// Second order in time, fifth in space: a first-order transport would round every edge.
const SOLVER: SolverOptions =
    SolverOptions { scheme: UpwindScheme::HjWeno5, integrator: TimeIntegrator::TvdRk2, ..SolverOptions::FIRST_ORDER };

impl Operator for Advect {
    const NAME: &'static str = "advect";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        if self.velocity.as_os_str().is_empty() {
            return Err(EditError::parameter(Self::NAME, "velocity", "nothing", "a `.vdb` with a grid of vectors"));
        }
        self.evolution.validate(Self::NAME)
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let vectors = files::vectors(&self.velocity, self.velocity_grid.as_deref(), run)?;
        let velocity = |xyz| vectors.trilinear(xyz);
        // A unit of time, as long as the velocities are per, where nothing is asked for.
        let asked = self.evolution.time.is_some()
            || self.evolution.iterations.is_some()
            || self.evolution.max_iterations.is_some();
        let until = if asked { self.evolution.until() } else { Until::Time(1.0) };
        let region = self.evolution.region.on(&inputs[0], run)?;
        let mut outcome = evolved(inputs.remove(0), run, |level_set| {
            let (region, solver) = (region.as_deref(), self.evolution.solver(SOLVER));
            held(level_set, region, run, |moved| advect(moved, &velocity, region, until, &solver, run))
        })?;
        if outcome.summary.steps == Some(0) && outcome.summary.warnings.is_empty() {
            outcome.summary.warnings.push("the velocity is 0 wherever the surface is: nothing was changed".into());
        }
        Ok(outcome)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals() {
        assert_eq!(Advect::default().validate().unwrap_err().exit_code(), 2);
        let absent = Advect { velocity: "absent.vdb".into(), ..Advect::default() };
        let level_set = crate::levelset::testing::ball(glam::DVec3::ZERO, 5.0);
        assert_eq!(absent.apply(vec![level_set], &RunOptions::default()).err().unwrap().exit_code(), 3);
    }
}
