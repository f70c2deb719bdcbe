//! Blending: a constructive operation, then a flow near the curve where the two surfaces meet (Museth et al. 2002, sections 4.2 and 5.2, equation 8).
//!
//! > F = D_p(d)·C(γ)·G, D_p(d) = 1 − P(d; d_min, d_max)
//!
//! with d the distance to the intersection curve, C the cut-off and P the ramp of [`ramp`](crate::region::ramp). `curvature` takes
//! G = −H (steps of h²/3), `fillet` the one-sided curvatures of [`fillet`](super::fillet). Of a union material is added, of a difference or an
//! intersection removed, unless asked otherwise. The flow goes on until nothing moves, or until it has spread to d_max: a straight edge
//! of 90° rests as an arc of radius 1/(2γ) under `curvature`, 1/γ under `fillet`, γ the lower limit, if d_max is at least that far; otherwise
//! the region shapes it. The limits of `curvature` are those of the paper; those of `fillet` are set for a radius of d_min.
//!
//! `gaussian` takes an anisotropic Gaussian ([`filter_anisotropic`]) instead of a flow, whose kernels fade with D_p, or, near `surfaces`, with the distance to both
//! surfaces: Π (1 − P(|φᵢ|; d_min, d_max)), the region of the thesis of 2006.
//!
//! d is measured to the curve and not to both surfaces, so that surfaces that come near each other without meeting are not
//! joined. Beyond d_max the result has the bits of `csg`. Where faces coincide the curve is a patch: the region is then wider, and rests as it is flat.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::compare::{Change, change};
use super::confine::held;
use super::csg::{CsgOperation, align, csg};
use super::curvature::{CurvatureOptions, unresolved};
use super::params::{VoxelLength, words};
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::{EvolutionOptions, SMOOTHING, evolved};
use crate::error::{EditError, Result};
use crate::grid::offset_to_local;
use crate::levelset::{CurvatureKind, LevelSet, curvature_of, curve_length};
use crate::mesh::with_half_width;
use crate::pde::{AnisotropicGaussian, CurvatureFlow, CutOff, Direction, FlowCurvature, filter_anisotropic};
use crate::region::{Combined, Near, NearSurface, Region, touched_leaves};
use crate::run::RunOptions;

words! {
    /// What flows near the curve.
    BlendMethod {
        /// Mean curvature, or another of the curvatures.
        Curvature = "curvature",
        /// The sum of concave curvatures, or of convex ones where material is removed.
        Fillet = "fillet",
        /// An anisotropic Gaussian instead of a flow.
        Gaussian = "gaussian",
    }
}

words! {
    /// What a blend acts near.
    BlendNear {
        /// The curve where the surfaces meet.
        Curve = "curve",
        /// Both surfaces at once, whether they meet or not.
        Surfaces = "surfaces",
    }
}

/// Unite, subtract or intersect level sets and blend the edge where they meet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Blend {
    /// What to do with the second input, and then with each further one.
    pub operation: CsgOperation,
    /// How to blend: `curvature` by mean curvature or what `curvature` says, `fillet` by the concave curvatures alone (the convex ones where material is removed),
    /// `gaussian` by one pass, or as many as `iterations` says, of a Gaussian along the surface, which is far faster.
    pub method: BlendMethod,
    /// What it acts near: the `curve` where the surfaces meet; or, of `gaussian`, both `surfaces` (the region of the thesis of 2006), which also joins
    /// surfaces that come within `d_max` of each other without meeting.
    pub near: BlendNear,
    /// Distance from the curve within which it acts in full; 7 voxels if not given, of `gaussian` half of `d_max`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub d_min: Option<VoxelLength>,
    /// Distance from the curve beyond which nothing changes; 9 voxels if not given, of `gaussian` 3 s₂, or 4 voxels from both surfaces.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub d_max: Option<VoxelLength>,
    /// Of `gaussian`: standard deviations along the normal and along the surface in voxels, the first not larger; 1.5,2.25 if not given. A right-angled edge is
    /// filled up to 0.8 s₂ from it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma: Option<[f32; 2]>,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub flow: CurvatureOptions,
    #[serde(flatten)]
    #[allow(missing_docs)]
    pub evolution: EvolutionOptions,
}

/// Table 4 of Museth et al. 2002, wing blending.
impl Default for Blend {
    fn default() -> Self {
        Self {
            operation: CsgOperation::Union,
            method: BlendMethod::Curvature,
            near: BlendNear::Curve,
            d_min: None,
            d_max: None,
            sigma: None,
            flow: CurvatureOptions::default(),
            evolution: EvolutionOptions::default(),
        }
    }
}

/// The lower limits of the curvature, of the same table.
const LOW: [f64; 2] = [0.04, 0.06];
/// The upper of the lower limits over the lower one, there.
const RAMP: f64 = 1.5;

/// Voxels from both surfaces up to which the thesis filters.
const BAND: f64 = 4.0;

/// Steps in which a blend spreads to a distance, over the square of the distance in voxels: mean curvature flow reaches √(2t) or so, and
/// 162 steps for 9 voxels are the 54 units of time after which the cylinder on a slab of the tests hardly changes.
const STEPS: f64 = 2.0;
/// Most steps where nothing is asked for.
const MOST_STEPS: f64 = 20_000.0;

impl Operator for Blend {
    const NAME: &'static str = "blend";
    const ARITY: Arity = Arity::Many;

    fn validate(&self) -> Result<()> {
        self.evolution.validate(Self::NAME)?;
        if let Some(low) = self.d_min
            && !(low.voxels(1.0) >= 0.0 && low.voxels(1.0).is_finite())
        {
            return Err(EditError::parameter(Self::NAME, "d_min", low, "a length of 0 or more, such as 7"));
        }
        if let Some(high) = self.d_max
            && !(high.voxels(1.0) > 0.0 && high.voxels(1.0).is_finite())
        {
            return Err(EditError::parameter(Self::NAME, "d_max", high, "a positive length, such as 9"));
        }
        match (self.gaussian(), self.sigma) {
            (Some(gaussian), _) => {
                gaussian.validate(Self::NAME)?;
                if let Some(time) = self.evolution.time {
                    let accepted = "`iterations` instead: a filter has no time";
                    return Err(EditError::parameter(Self::NAME, "time", time, accepted));
                }
                if let Some(most) = self.evolution.max_iterations {
                    let accepted = "`iterations` instead: a filter does not stop by itself";
                    return Err(EditError::parameter(Self::NAME, "max_iterations", most, accepted));
                }
                let flow = CurvatureOptions { direction: None, ..self.flow.clone() };
                if flow != CurvatureOptions::default() {
                    return Err(flow.misplaced(Self::NAME, "with the methods curvature and fillet"));
                }
            }
            (None, Some([a, b])) => {
                let accepted = "only with the method gaussian";
                return Err(EditError::parameter(Self::NAME, "sigma", format!("{a},{b}"), accepted));
            }
            _ => {}
        }
        if self.near == BlendNear::Surfaces && self.method != BlendMethod::Gaussian {
            return Err(EditError::parameter(Self::NAME, "near", "surfaces", "curve, or the method gaussian"));
        }
        if self.method == BlendMethod::Fillet {
            let accepted =
                "concave where material is added, convex where it is removed; others with the method curvature";
            self.flow.only(Self::NAME, self.own().0, accepted)?;
        }
        self.driven(1.0).map(drop)
    }

    fn apply(&self, inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let (aligned, mut warnings) = align(inputs, run)?;
        let Some((first, others)) = aligned.split_first() else { unreachable!("the registry counts the inputs") };
        let (mut level_set, mut summary) = (first.clone(), Summary::default());
        let mut total = Blended::default();
        for other in others {
            let (outcome, blended) = blend(&level_set, other, self, run)?;
            total.add(&blended);
            (level_set, summary) = (outcome.level_set, outcome.summary);
            warnings.append(&mut summary.warnings);
        }
        warnings.extend(unresolved(&self.driven(level_set.voxel_size())?.cut_off));
        summary.warnings = warnings;
        if let Ok(serde_json::Value::Object(details)) = serde_json::to_value(total) {
            summary.details = details;
        }
        Ok(Outcome { level_set, summary })
    }
}

impl Blend {
    /// The curvature and the direction where none are asked for.
    fn own(&self) -> (FlowCurvature, Direction) {
        let adds = self.operation == CsgOperation::Union;
        let curvature = match (self.method, adds) {
            (BlendMethod::Curvature | BlendMethod::Gaussian, _) => FlowCurvature::Mean,
            (BlendMethod::Fillet, true) => FlowCurvature::Concave,
            (BlendMethod::Fillet, false) => FlowCurvature::Convex,
        };
        (curvature, if adds { Direction::Add } else { Direction::Remove })
    }

    /// The filter, if that is the method.
    fn gaussian(&self) -> Option<AnisotropicGaussian> {
        (self.method == BlendMethod::Gaussian).then(|| AnisotropicGaussian {
            sigma: self.sigma.unwrap_or(AnisotropicGaussian::DEFAULT_SIGMA),
            critical_curvature: None,
            direction: self.flow.direction.unwrap_or(self.own().1),
            fades_kernels: true,
        })
    }

    /// Between which distances from the curve it fades, in world units.
    fn reach(&self, voxel_size: f64) -> [f64; 2] {
        let world =
            |given: Option<VoxelLength>, voxels: f64| given.unwrap_or(VoxelLength::new(voxels)).world(voxel_size);
        match self.gaussian() {
            None => [world(self.d_min, 7.0), world(self.d_max, 9.0)],
            Some(gaussian) => {
                let most = match self.near {
                    BlendNear::Curve => 3.0 * f64::from(gaussian.sigma[1]),
                    BlendNear::Surfaces => BAND,
                };
                let most = world(self.d_max, most);
                [self.d_min.map_or(most / 2.0, |d| d.world(voxel_size)), most]
            }
        }
    }

    /// What moves the surface.
    fn driven(&self, voxel_size: f64) -> Result<CurvatureFlow> {
        let (curvature, direction) = self.own();
        let low = match self.method {
            BlendMethod::Curvature | BlendMethod::Gaussian => LOW,
            // An arc that meets the planes of a right angle at d_min.
            BlendMethod::Fillet => [1.0, RAMP].map(|k| k / (self.reach(voxel_size)[0] / voxel_size).max(1.0)),
        };
        let refuse = |accepted| EditError::parameter(Self::NAME, "curvature_low", format!("{low:?}"), accepted);
        let cut_off = CutOff::NONE.with_low(low).map_err(refuse)?;
        let flow = self.flow.flow(Self::NAME, CurvatureFlow { curvature, cut_off, direction })?;
        // The preset's direction is that of a union.
        Ok(CurvatureFlow { direction: self.flow.direction.unwrap_or(direction), ..flow })
    }
}

/// What blending did. World units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Blended {
    /// Length of the curve where the surfaces meet.
    pub curve_length: f64,
    /// Radius of curvature of the sharpest place that is left where the flow acts in full: 1/max(−κ₂) where material is added,
    /// 1/max(κ₁) where it is removed; the smaller of both for `both`. None if nothing is curved that way.
    pub fillet_radius: Option<f64>,
    /// Voxels that differ from the result of `csg`.
    pub voxels_touched: u64,
    /// Volume that the flow added to the result of `csg`.
    pub volume_added: f64,
}

impl Blended {
    fn add(&mut self, next: &Self) {
        self.curve_length += next.curve_length;
        self.voxels_touched += next.voxels_touched;
        self.volume_added += next.volume_added;
        self.fillet_radius = match (self.fillet_radius, next.fillet_radius) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        };
    }
}

/// Combines two level sets of the same lattice and half width and blends their edge.
pub fn blend(first: &LevelSet, second: &LevelSet, params: &Blend, run: &RunOptions) -> Result<(Outcome, Blended)> {
    params.validate()?;
    let joined = csg(first, &[second], params.operation, run)?;
    let voxel_size = joined.voxel_size();
    let curve = first.intersection_curve(second);
    if curve.is_empty() && params.near == BlendNear::Curve {
        let warning = "the surfaces do not meet: the result is that of `csg`, nothing was blended".into();
        let summary = Summary { warnings: vec![warning], ..Summary::default() };
        return Ok((Outcome { level_set: joined, summary }, Blended::default()));
    }
    let reach = params.reach(voxel_size);
    if reach[0] > reach[1] {
        let [low, high] = reach.map(|d| VoxelLength::new(d / voxel_size));
        return Err(EditError::parameter(Blend::NAME, "d_min", low, format!("at most d_max, {high}")));
    }
    let mut region: Box<dyn Region> = match params.near {
        BlendNear::Curve => Box::new(Near::new(&curve, reach)?),
        BlendNear::Surfaces => {
            let near = |level_set: &LevelSet| -> Result<Box<dyn Region>> {
                let wide = with_half_width(level_set, (reach[1] / voxel_size) as f32 + 1.0, run)?;
                Ok(Box::new(NearSurface::new(wide, reach)))
            };
            Box::new(Combined::All(vec![near(first)?, near(second)?]))
        }
    };
    if let Some(further) = params.evolution.region.on(&joined, run)? {
        region = Box::new(Combined::All(vec![region, further]));
    }
    let spread = reach[1] / voxel_size;
    let until = params.evolution.until_rest((STEPS * spread * spread).min(MOST_STEPS).ceil() as u32);
    let flow = params.driven(voxel_size)?;
    let solver = params.evolution.solver(SMOOTHING);
    let outcome = evolved(joined.clone(), run, |level_set| match params.gaussian() {
        None => held(level_set, Some(&*region), run, |moved| flow.evolve(moved, Some(&*region), until, &solver, run)),
        Some(what) => {
            let (times, solver) = (params.evolution.iterations.unwrap_or(1), params.evolution.solver(what.repair()));
            filter_anisotropic(level_set, &what, times, Some(&*region), &solver, run)
        }
    })?;
    let Change { voxels, volume } = change(&joined, &outcome.level_set);
    let blended = Blended {
        curve_length: curve_length(&curve, voxel_size),
        fillet_radius: sharpest(&outcome.level_set, &*region, flow.direction, run)?.map(|k| 1.0 / k),
        voxels_touched: voxels,
        volume_added: volume,
    };
    Ok((outcome, blended))
}

/// The largest curvature, against which a flow of `direction` works, of the surface where the region is 1.
fn sharpest(level_set: &LevelSet, region: &dyn Region, direction: Direction, run: &RunOptions) -> Result<Option<f64>> {
    let grid = level_set.grid();
    let leaves = touched_leaves(grid, level_set.transform(), region);
    let nearest = (0.5 * level_set.voxel_size()) as f32;
    let of_kind = |kind, sign: f32| -> Result<f32> {
        let field = curvature_of(level_set, kind, &leaves, run)?;
        let of_leaf = |id| {
            let (curved, phi) = (&field.grid().values(id).0, &grid.values(id).0);
            let on_surface = |at: &usize| phi[*at].abs() < nearest && sign * curved[*at] > 0.0;
            let found: Vec<usize> = field.grid().mask(id).iter().filter(on_surface).collect();
            let place = |at: &usize| level_set.transform().voxel_to_world(grid.origin(id) + offset_to_local(*at));
            let mut alpha = vec![0.0; found.len()];
            region.weights(&found.iter().map(place).collect::<Vec<_>>(), &mut alpha);
            let full = found.iter().zip(alpha).filter(|(_, alpha)| *alpha >= 1.0);
            full.map(|(at, _)| sign * curved[*at]).fold(0.0, f32::max)
        };
        Ok(grid.map_leaves(of_leaf).into_iter().fold(0.0, f32::max))
    };
    let largest = match direction {
        Direction::Add => of_kind(CurvatureKind::Min, -1.0)?,
        Direction::Remove => of_kind(CurvatureKind::Max, 1.0)?,
        Direction::Both => of_kind(CurvatureKind::Min, -1.0)?.max(of_kind(CurvatureKind::Max, 1.0)?),
    };
    Ok((largest > 0.0).then_some(f64::from(largest)))
}
