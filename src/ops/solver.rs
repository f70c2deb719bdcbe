//! Options that the evolving operators share: how long, where, and how it is solved.

use std::borrow::Cow;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Deserializer, Serialize};

use super::params::words;
use super::registry::{Outcome, Summary};
use crate::error::{EditError, Result};
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet};
use crate::mesh::with_half_width;
use crate::pde::{Report, SolverOptions, Until, UpwindScheme};
use crate::region::{Region, RegionPlan};
use crate::run::RunOptions;

words! {
    /// One-sided differences of the renormalisation after each step.
    Scheme {
        /// First order.
        First = "first",
        /// HJ-WENO5.
        Weno5 = "weno5",
    }
}

words! {
    /// Whose numerics to use.
    Like {
        /// OpenVDB's `LevelSetFilter`: HJ-WENO5, Euler steps, three normalisations, its epsilon.
        OpenVdb = "openvdb",
    }
}

/// The narrowest band, in voxels, that a flow is run in: the stencils of WENO5 reach three voxels, and in a band of 1.5 they
/// see the cut-off values beside the surface (a smoothed ball got holes). Band widths from files differ in the last digits.
const NARROWEST_BAND: f32 = DEFAULT_HALF_WIDTH - 0.01;

/// How flows by curvature are solved: the cheapest that keeps a ball of 20 voxels within 0.05 voxel of the exact radius in every
/// direction, over 60 steps of mean curvature flow.
pub(super) const SMOOTHING: SolverOptions =
    SolverOptions { scheme: UpwindScheme::HjWeno5, ..SolverOptions::FIRST_ORDER };

/// What `flow` makes of a level set, in a wider band if its own is too narrow; the band keeps its half width.
pub(super) fn evolved(
    mut level_set: LevelSet,
    run: &RunOptions,
    flow: impl FnOnce(&mut LevelSet) -> Result<Report>,
) -> Result<Outcome> {
    let half_width = level_set.half_width();
    let narrow = half_width < NARROWEST_BAND;
    if narrow {
        level_set = with_half_width(&level_set, DEFAULT_HALF_WIDTH, run)?;
    }
    let was_empty = level_set.is_empty();
    let report = flow(&mut level_set)?;
    let mut summary = Summary::from(&report);
    if narrow {
        level_set = level_set.narrowed(half_width);
        summary.warnings.push(format!(
            "a band of {half_width} voxels is too narrow to evolve: exact distances were rebuilt in one of {DEFAULT_HALF_WIDTH} first"
        ));
    }
    if report.voxels == 0 && !level_set.is_empty() {
        summary.warnings.push("the region touches no voxel of the narrow band: nothing was changed".into());
    }
    if level_set.is_empty() && !was_empty {
        summary.warnings.push("nothing is left".into());
    }
    Ok(Outcome { level_set, summary })
}

/// Regions in the order given: each multiplies the ones before; `or …` joins, `not …` leaves out.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct RegionSpecs(pub Vec<String>);

impl<'de> Deserialize<'de> for RegionSpecs {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Form {
            One(String),
            Several(Vec<String>),
        }
        Ok(Self(match Form::deserialize(deserializer)? {
            Form::One(spec) => vec![spec],
            Form::Several(specs) => specs,
        }))
    }
}

impl JsonSchema for RegionSpecs {
    fn schema_name() -> Cow<'static, str> {
        "RegionSpecs".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "type": ["array", "string"], "items": { "type": "string" }, "x-kind": "'sphere center=… radius=…'", "x-list": true
        })
    }
}

impl RegionSpecs {
    /// Refuses what cannot be understood.
    pub fn validate(&self) -> Result<()> {
        RegionPlan::parse(&self.0).map(drop)
    }

    /// Whether all of them are neighbourhoods of points and curves.
    pub fn is_around_curves(&self) -> bool {
        RegionPlan::parse(&self.0).is_ok_and(|plan| plan.is_some_and(|plan| plan.is_around_curves()))
    }

    /// The region on a level set, or `None` for everywhere. Reads the files that are named.
    pub fn on(&self, level_set: &LevelSet, run: &RunOptions) -> Result<Option<Box<dyn Region>>> {
        RegionPlan::parse(&self.0)?.map(|plan| plan.on(level_set, run)).transpose()
    }
}

/// How long a flow runs, where, and how it is solved.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct EvolutionOptions {
    /// Steps of the largest stable size, 10 if neither this, `max_iterations` nor `time` is given and the flow does not stop by itself; of a filter, how often it is applied, 1 if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub iterations: Option<u32>,
    /// Go on until nothing moves any more, for so many steps at most.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_iterations: Option<u32>,
    /// Flow time instead of a number of steps, in world units squared (a sphere of radius R shrinks as R² − 2·time).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time: Option<f64>,
    /// Where to act, and how strongly; everywhere if not given. Kinds: `sphere`, `box`, `bbox`, `cylinder`, `superellipsoid`, `halfspace`, `levelset`, `mesh`, `mask`, `fog`, `points`, `curve`, `component`. Several multiply.
    pub region: RegionSpecs,
    /// One-sided differences of the renormalisation after each step; weno5 if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scheme: Option<Scheme>,
    /// Renormalisations after each step; 1 if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub normalizations: Option<u32>,
    /// Take another tool's scheme, integrator, normalisation count and epsilon, to compare results one to one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub like: Option<Like>,
}

/// Steps where nothing is asked for: enough to see, few enough to take back.
const DEFAULT_ITERATIONS: u32 = 10;

/// Most renormalisations a step: more move the surface instead of repairing the distance.
const MOST_NORMALIZATIONS: u32 = 100;

impl EvolutionOptions {
    /// Refuses what cannot work.
    pub fn validate(&self, operation: &str) -> Result<()> {
        if let (Some(_), Some(time)) = (self.iterations, self.time) {
            return Err(EditError::parameter(operation, "time", time, "either `iterations` or `time`, not both"));
        }
        if let (Some(most), true) = (self.max_iterations, self.iterations.is_some() || self.time.is_some()) {
            let accepted = "without `iterations` and `time`, which say when to stop";
            return Err(EditError::parameter(operation, "max_iterations", most, accepted));
        }
        if let Some(time) = self.time
            && !(time >= 0.0 && time.is_finite())
        {
            return Err(EditError::parameter(
                operation,
                "time",
                time,
                "a finite number of world units squared, 0 or more",
            ));
        }
        if let Some(n) = self.normalizations
            && n > MOST_NORMALIZATIONS
        {
            return Err(EditError::parameter(operation, "normalizations", n, format!("0 to {MOST_NORMALIZATIONS}")));
        }
        if self.like.is_some() && (self.scheme.is_some() || self.normalizations.is_some()) {
            return Err(EditError::parameter(
                operation,
                "like",
                "openvdb",
                "without `scheme` and `normalizations`: it sets both",
            ));
        }
        self.region.validate()
    }

    /// When the flow ends.
    pub fn until(&self) -> Until {
        self.until_or(Until::Iterations(DEFAULT_ITERATIONS))
    }

    /// When a flow ends that stops by itself, after `most` steps if nothing is asked for.
    pub fn until_rest(&self, most: u32) -> Until {
        self.until_or(Until::Rest(most))
    }

    fn until_or(&self, unsaid: Until) -> Until {
        match (self.time, self.iterations, self.max_iterations) {
            (Some(time), ..) => Until::Time(time),
            (_, Some(steps), _) => Until::Iterations(steps),
            (.., Some(most)) => Until::Rest(most),
            _ => unsaid,
        }
    }

    /// How it is solved: `defaults` of the operator, changed by what was given.
    pub fn solver(&self, defaults: SolverOptions) -> SolverOptions {
        if self.like.is_some() {
            return SolverOptions::OPENVDB;
        }
        SolverOptions {
            scheme: match self.scheme {
                None => defaults.scheme,
                Some(Scheme::First) => UpwindScheme::First,
                Some(Scheme::Weno5) => UpwindScheme::HjWeno5,
            },
            normalizations: self.normalizations.unwrap_or(defaults.normalizations),
            ..defaults
        }
    }
}
