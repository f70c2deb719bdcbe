//! Fillets and rounds by the flow of one-sided curvatures (Whitaker & Breen 1998, equation 19, with the sign for φ negative inside).
//!
//! > fillet: F = C(γ)·(max(−κ₁, 0) + max(−κ₂, 0)), γ = max(−κ₂, 0)·h;  round: F = −C(γ)·(max(κ₁, 0) + max(κ₂, 0)), γ = max(κ₁, 0)·h
//!
//! A fillet adds material where the surface is concave and leaves convex parts alone; a round is its mirror image. A saddle counts with
//! its concave curvature, so that without a limit even a minimal surface moves. Steps of h²/6, Godunov's |∇φ|. With `radius` R the lower
//! cut-off is h/R: what is concave with R or more rests.
//!
//! The edge of two planes at a right angle retreats as 1.04449·√t under the sum of curvatures (the self-similar solution of the
//! shortening flow of curves), until it meets the arc at (√2 − 1)·R, ever more slowly: after 20·R² steps it has 92 % of the way behind it. So where
//! a radius is given and neither steps nor time, the shape in which the flow rests is made at once (`rolling`): that of a ball of the
//! radius that rolls along the edge.
//! `blob` unites solids with the level set first: material that a joint is filled from.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::confine::{Reach, confined, held};
use super::csg::{CsgOperation, csg};
use super::curvature::{CurvatureOptions, unresolved};
use super::params::WorldLength;
use super::registry::{Arity, Operator, Outcome};
use super::rolling::rolled;
use super::shape::sampled;
use super::solver::{EvolutionOptions, SMOOTHING, evolved};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::levelset::expression::Expression;
use crate::pde::{CurvatureFlow, CutOff, FlowCurvature, Report, StopReason};
use crate::region::Region;
use crate::run::RunOptions;

/// Fill concave edges, or round convex ones.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Fillet {
    /// Round convex edges instead of filling concave ones.
    pub rounds: bool,
    /// Stop at this radius: what is as round already stays, and what is sharper becomes an arc of this radius. At once, unless steps or a time say how
    /// far the flow goes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius: Option<WorldLength>,
    /// Solids that are united with the level set first, to fill a joint from; shapes as of `shape`.
    #[schemars(extend("x-list" = true, "x-kind" = "'sphere center=… radius=…'"))]
    pub blob: Vec<String>,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub flow: CurvatureOptions,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub evolution: EvolutionOptions,
}

/// How much sharper than the radius an edge is where it moves at full speed: the ramp of wing blending in table 4 of Museth et al. 2002.
const RAMP: f64 = 1.5;

/// Steps until an edge has all but come to rest at a limit, over the square of its radius in voxels: a disturbance spreads over a distance in a time
/// that goes with its square.
const STEPS: f64 = 20.0;
/// Most steps where nothing is asked for.
const MOST_STEPS: f64 = 20_000.0;

impl Operator for Fillet {
    const NAME: &'static str = "fillet";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        self.evolution.validate(Self::NAME)?;
        let accepted = "concave, or convex together with `rounds`; other curvatures are those of `smooth`";
        self.flow.only(Self::NAME, self.own().curvature, accepted)?;
        self.flow.flow(Self::NAME, self.own())?;
        if let Some(radius) = self.radius {
            let size = radius.world(1.0);
            if !(size > 0.0 && size.is_finite()) {
                return Err(EditError::parameter(
                    Self::NAME,
                    "radius",
                    radius,
                    "a positive length, such as 0.1 or 6vx",
                ));
            }
            if self.flow.curvature_low.is_some() {
                let accepted = "either `radius` or `curvature_low`, which say the same";
                return Err(EditError::parameter(Self::NAME, "radius", radius, accepted));
            }
        }
        self.blob.iter().try_for_each(|blob| Expression::parse(blob).map(drop))
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let level_set = self.seeded(inputs.remove(0), run)?;
        let flow = self.flow_on(level_set.voxel_size())?;
        let mut outcome = evolved(level_set, run, |level_set| fillet(level_set, self, run))?;
        outcome.summary.warnings.extend(unresolved(&flow.cut_off));
        Ok(outcome)
    }
}

impl Fillet {
    fn own(&self) -> CurvatureFlow {
        let curvature = if self.rounds { FlowCurvature::Convex } else { FlowCurvature::Concave };
        CurvatureFlow { curvature, ..CurvatureFlow::MEAN }
    }

    /// What moves the surface on voxels of a size.
    fn flow_on(&self, voxel_size: f64) -> Result<CurvatureFlow> {
        let mut own = self.own();
        if let Some(radius) = self.radius {
            let least = voxel_size / radius.world(voxel_size);
            let cut_off = CutOff::NONE.with_low([least, RAMP * least]);
            own.cut_off = cut_off.map_err(|accepted| EditError::parameter(Self::NAME, "radius", radius, accepted))?;
        }
        self.flow.flow(Self::NAME, own)
    }

    /// The radius, if nothing asks for a part of the way or another one.
    fn radius_at_once(&self) -> Option<WorldLength> {
        let Self { flow, evolution, .. } = self;
        let part = evolution.iterations.is_some() || evolution.max_iterations.is_some() || evolution.time.is_some();
        self.radius.filter(|_| !part && *flow == CurvatureOptions::default())
    }

    /// The level set with the blobs.
    fn seeded(&self, mut level_set: LevelSet, run: &RunOptions) -> Result<LevelSet> {
        for blob in &self.blob {
            let blob = sampled(&Expression::parse(blob)?, level_set.transform(), level_set.half_width(), run)?;
            level_set = csg(&level_set, &[&blob], CsgOperation::Union, run)?;
        }
        Ok(level_set)
    }
}

/// Fillets in place; blobs are [`Operator::apply`]'s business. The band should be at least 3 voxels wide to each side.
pub fn fillet(level_set: &mut LevelSet, params: &Fillet, run: &RunOptions) -> Result<Report> {
    params.validate()?;
    let region = params.evolution.region.on(level_set, run)?;
    let region = region.as_deref();
    if let Some(radius) = params.radius_at_once() {
        return roll(level_set, radius.world(level_set.voxel_size()), params.rounds, region, run);
    }
    let flow = params.flow_on(level_set.voxel_size())?;
    let until = match flow.cut_off.low() {
        Some([least, _]) => params.evolution.until_rest((STEPS / least / least).min(MOST_STEPS) as u32),
        None => params.evolution.until(),
    };
    let solver = params.evolution.solver(SMOOTHING);
    held(level_set, region, run, |moved| flow.evolve(moved, region, until, &solver, run))
}

/// The shape at rest, at once.
fn roll(
    level_set: &mut LevelSet,
    radius: f64,
    rounds: bool,
    region: Option<&dyn Region>,
    run: &RunOptions,
) -> Result<Report> {
    let mut report = Report { steps: 0, time: 0.0, voxels: 0, stopped: StopReason::AtRest };
    let result = match region {
        None => rolled(level_set, radius, rounds, run)?,
        Some(region) => {
            let moves = radius / level_set.voxel_size();
            let reach = Reach { moves, sees: 2.0 * moves };
            let whole = |part: LevelSet| Ok(rolled(&part, radius, rounds, run)?.unwrap_or(part));
            let result = confined(Fillet::NAME, level_set, region, &reach, whole, run)?;
            if result.is_none() {
                report.stopped = StopReason::NothingLeft;
                return Ok(report);
            }
            result
        }
    };
    report.voxels = level_set.grid().active_voxels();
    if let Some(result) = result {
        *level_set = result;
    }
    Ok(report)
}
