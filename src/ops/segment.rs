//! Segmentation of scalar volumes: the part where the numbers are in a range, its surface kept smooth.
//!
//! The motion is that of [`grow_by_threshold`] (Lefohn, Cates & Whitaker 2003): F = h [(1 − β) D(I) − 2 β h H]. With `iso` alone,
//! D = (I − iso)/ε: all that is brighter. With `upper` as well, T and ε are the middle and half of the range and D = 1 − |I − T|/ε, as in the paper.
//! D ends at ±1. It starts at the surface D = 0 of the volume, or from a solid in it (`seed`), from which it can only reach what is connected.
//!
//! A smooth part of R voxels comes out smaller where D is not steep: by 2β/((1 − β) R) over the slope of D a voxel. Specks vanish when
//! their curvature outweighs D, below about 2β/(1 − β) voxels of radius. The field is a distance at the end: it is rebuilt.

use std::path::Path;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::registry::{Arity, Operator, Outcome, Summary};
use crate::error::{EditError, Result};
use crate::levelset::expression::Expression;
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet};
use crate::mesh::{MeshToLevelSet, Rebuild, rebuild};
use crate::pde::{SolverOptions, Until, UpwindScheme, grow_by_threshold};
use crate::region::read_volume;
use crate::run::RunOptions;
use crate::scan::{Inside, Scan, is_scan};

/// Find a part of a scan or density by its values, with a smooth surface.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Segment {
    /// The volume: a `.vdb` with a float grid, a `.nrrd` or a `.nii`.
    #[schemars(extend("x-kind" = "FILE"))]
    pub volume: String,
    /// Which grid of a `.vdb`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub volume_grid: Option<String>,
    /// The value at the part's surface: inside is above it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub iso: Option<f64>,
    /// The part ends at this value as well: inside is from `iso` to here.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub upper: Option<f64>,
    /// Take what is below `iso` instead.
    pub invert: bool,
    /// Difference to `iso` at which the surface moves at full speed; a quarter of the volume's range if not given, half of iso to upper if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epsilon: Option<f64>,
    /// Part of the curvature in the motion, 0 (the values alone) to 1 (curvature alone).
    pub smoothness: f64,
    /// Most steps; it stops by itself when the surface rests.
    pub iterations: u32,
    /// Where to start, as a solid such as `sphere center=1,2,3 radius=4`: only what is connected to it is found. All of the range if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<String>,
    /// Half width of the band in voxels.
    pub half_width: f32,
}

impl Default for Segment {
    fn default() -> Self {
        Self {
            volume: String::new(),
            volume_grid: None,
            iso: None,
            upper: None,
            invert: false,
            epsilon: None,
            smoothness: 0.3,
            iterations: 300,
            seed: None,
            half_width: DEFAULT_HALF_WIDTH,
        }
    }
}

/// First-order renormalisation would eat into the surface over so many steps.
const SOLVER: SolverOptions = SolverOptions { scheme: UpwindScheme::HjWeno5, ..SolverOptions::FIRST_ORDER };

/// Epsilon, where none is given, as a part of the volume's range.
const DEFAULT_EPSILON: f64 = 0.25;

impl Operator for Segment {
    const NAME: &'static str = "segment";
    const ARITY: Arity = Arity::Source;

    fn validate(&self) -> Result<()> {
        let refuse = |field: &str, value: String, accepted: &str| {
            Err(EditError::parameter(Self::NAME, field, value, accepted.to_owned()))
        };
        let Some(iso) = self.iso.filter(|v| v.is_finite()) else {
            return refuse(
                "iso",
                self.iso.unwrap_or(f64::NAN).to_string(),
                "the value at the surface: a finite number",
            );
        };
        if let Some(upper) = self.upper {
            if !(upper > iso && upper.is_finite()) {
                return refuse("upper", upper.to_string(), "a finite number above `iso`");
            }
            if self.invert || self.epsilon.is_some() {
                return refuse("upper", upper.to_string(), "without `invert` and `epsilon`, which belong to one value");
            }
        }
        if let Some(epsilon) = self.epsilon
            && !(epsilon > 0.0 && epsilon.is_finite())
        {
            return refuse("epsilon", epsilon.to_string(), "a positive difference of values");
        }
        if !(0.0..=1.0).contains(&self.smoothness) {
            return refuse("smoothness", self.smoothness.to_string(), "a number from 0 to 1");
        }
        if let Some(seed) = &self.seed {
            Expression::parse(seed)?;
        }
        let file = Path::new(&self.volume);
        if self.volume.is_empty() || !file.exists() {
            return Err(EditError::input(file, "cannot be opened: there is no such file"));
        }
        MeshToLevelSet { half_width: self.half_width, ..MeshToLevelSet::new(1.0) }.validate()
    }

    fn apply(&self, _: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        self.validate()?;
        let path = Path::new(&self.volume);
        let naming = |error: EditError| match error {
            EditError::Input { problem, .. } => EditError::input(path, problem),
            error => error,
        };
        let scan = match is_scan(path) {
            true => Scan::read(path, run)?,
            false => {
                let volume = read_volume(path, self.volume_grid.as_deref(), run)?;
                Scan::of_volume(&volume, run)?.ok_or_else(|| EditError::input(path, "the volume is empty"))?
            }
        };
        let (scan, resampled) = scan.on_cubes(run).map_err(|problem| EditError::input(path, problem))?;
        let mut outcome = segment(&scan, self, run).map_err(naming)?;
        outcome.summary.warnings.extend(resampled.map(|said| format!("{}: {said}", path.display())));
        Ok(outcome)
    }
}

/// Segments a scan whose voxels are cubes. Its file is not read again.
pub fn segment(scan: &Scan, params: &Segment, run: &RunOptions) -> Result<Outcome> {
    let nothing = |what: &str| EditError::input(&params.volume, what.to_owned());
    let Some(iso) = params.iso else { return Err(EditError::parameter(Segment::NAME, "iso", "", "a number")) };
    let (least, most) = scan.range().ok_or_else(|| nothing("holds no numbers"))?;
    // D as a straight line, or two of them.
    let epsilon = match params.upper {
        Some(upper) => (upper - iso) / 2.0,
        None => params.epsilon.unwrap_or(DEFAULT_EPSILON * (f64::from(most) - f64::from(least))),
    };
    let (sign, middle) = (if params.invert { -1.0 } else { 1.0 }, params.upper.map(|upper| (iso + upper) / 2.0));
    let membership = |value: f32| {
        let value = f64::from(value);
        let d = match middle {
            Some(middle) => 1.0 - (value - middle).abs() / epsilon,
            None => sign * (value - iso) / epsilon,
        };
        // NaN, and what is outside of the scan, belongs to nothing.
        if d.is_nan() { -1.0 } else { d.clamp(-1.0, 1.0) as f32 }
    };
    let mut level_set = match &params.seed {
        Some(seed) => seeded(scan, seed, run)?,
        None => {
            let field = scan.clone().mapped(membership).iso_field(0.0, Inside::Above, run)?;
            let field = field.ok_or_else(|| nothing("no voxel is in the range: there is no surface"))?;
            rebuild(&field, &Rebuild::band(DEFAULT_HALF_WIDTH), run)?
        }
    };
    let at = |ijk| membership(scan.value(ijk));
    let until = Until::Iterations(params.iterations);
    let report = grow_by_threshold(&mut level_set, &at, params.smoothness, None, until, &SOLVER, run)?;
    let mut summary = Summary::from(&report);
    if level_set.is_empty() {
        summary.warnings.push("nothing is left: all parts were smaller than their curvature bears".into());
        return Ok(Outcome { level_set: LevelSet::empty(*level_set.transform(), params.half_width), summary });
    }
    Ok(Outcome { level_set: rebuild(&level_set, &Rebuild::band(params.half_width), run)?, summary })
}

/// A solid on the lattice of a scan.
fn seeded(scan: &Scan, seed: &str, run: &RunOptions) -> Result<LevelSet> {
    let transform = scan.transform().map_err(|problem| EditError::parameter(Segment::NAME, "volume", "", problem))?;
    let solid = Expression::parse(seed)?;
    let size = transform.voxel_size();
    let refuse = || EditError::parameter(Segment::NAME, "seed", seed, "a solid that overlaps the volume");
    let (lo, hi) = solid.bounds().ok_or_else(refuse)?;
    let corners = (0..8).map(|c| {
        let pick = |axis: usize| if c >> axis & 1 == 1 { hi[axis] } else { lo[axis] };
        transform.world_to_index(DVec3::new(pick(0), pick(1), pick(2)))
    });
    let (lo, hi) = corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)));
    let top = DVec3::from(scan.size().map(|n| n as f64));
    if !(lo.cmple(top).all() && hi.cmpge(DVec3::ZERO).all()) {
        return Err(refuse());
    }
    // Values of implicit functions are about distances: a wide band, made exact by the rebuild.
    const ROUGH_BAND: f32 = 8.0;
    let rim = f64::from(ROUGH_BAND) + 2.0;
    let (lo, hi) = (lo.max(DVec3::splat(-rim)) - rim, hi.min(top + rim) + rim);
    let value = |ijk: DVec3| solid.value(transform.index_to_world(ijk)) / size;
    let rough =
        LevelSet::from_distance(transform, ROUGH_BAND, (lo.floor().as_ivec3(), hi.ceil().as_ivec3()), value, run)?;
    rebuild(&rough, &Rebuild::band(DEFAULT_HALF_WIDTH), run)
}

#[cfg(test)]
mod tests {
    use glam::DAffine3;

    use super::*;

    /// A ball of 100 on 0 with edges one voxel wide, and noise of a standard deviation, in a box of n³.
    fn noisy_ball(n: usize, radius: f64, deviation: f64) -> Scan {
        let mut state = 42u64;
        let mut random = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let centre = DVec3::splat(n as f64 / 2.0) + DVec3::new(0.3, -0.2, 0.1);
        let values = (0..n * n * n).map(|i| {
            let p = DVec3::new((i % n) as f64, (i / n % n) as f64, (i / n / n) as f64);
            let clean = 100.0 * (radius - (p - centre).length() + 0.5).clamp(0.0, 1.0);
            // Twelve uniform numbers have a variance of 1.
            let noise: f64 = (0..12).map(|_| random()).sum::<f64>() - 6.0;
            (clean + deviation * noise) as f32
        });
        let to_world = DAffine3::from_scale_rotation_translation(DVec3::splat(0.5), glam::DQuat::IDENTITY, DVec3::ONE);
        Scan::new([n; 3], values.collect(), to_world).unwrap()
    }

    #[test]
    fn a_ball_is_found_in_noise() {
        let run = RunOptions::default();
        let scan = noisy_ball(64, 20.0, 30.0);
        let plain = scan.iso_field(50.0, Inside::Above, &run).unwrap().unwrap();
        assert!(plain.measure(&run).unwrap().components > 1000, "noise alone is no surface");
        for seed in [None, Some("sphere center=17,17,17 radius=4".to_owned())] {
            let params = Segment { iso: Some(50.0), seed, smoothness: 0.4, ..Segment::default() };
            let Outcome { level_set, summary } = segment(&scan, &params, &run).unwrap();
            let measured = level_set.measure(&run).unwrap();
            assert_eq!((measured.components, measured.euler), (1, 2), "{params:?} {summary:?}");
            assert_eq!(summary.stopped_because.as_deref(), Some("nothing moves any more"));
            let radius = (measured.volume * 3.0 / 4.0 / std::f64::consts::PI).cbrt() / 0.5;
            assert!((radius - 20.0).abs() < 0.2, "{params:?}: {radius}");
            assert!(level_set.check().is_empty(), "{:?}", level_set.check());
        }
    }

    #[test]
    fn a_range_and_the_other_side() {
        let run = RunOptions::default();
        // Numbers rise by 10 a voxel from the centre of a box of 48³: a range is a shell.
        let n = 48;
        let p = |i: usize| DVec3::new((i % n) as f64, (i / n % n) as f64, (i / n / n) as f64) - 23.5;
        let values = (0..n * n * n).map(|i| (10.0 * p(i).length()) as f32).collect();
        let scan = Scan::new([n; 3], values, DAffine3::IDENTITY).unwrap();
        let ball = |r: f64| 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
        let volume = |params: &Segment| {
            let level_set = segment(&scan, params, &run).unwrap().level_set;
            assert!(level_set.check().is_empty());
            level_set.measure(&run).unwrap()
        };
        let shell = volume(&Segment { iso: Some(100.0), upper: Some(180.0), smoothness: 0.0, ..Segment::default() });
        assert!((shell.volume / (ball(18.0) - ball(10.0)) - 1.0).abs() < 0.01, "{}", shell.volume);
        let below = Segment { iso: Some(120.0), invert: true, smoothness: 0.0, ..Segment::default() };
        assert!((volume(&below).volume / ball(12.0) - 1.0).abs() < 0.01);
        let nothing = Segment { iso: Some(1e6), ..Segment::default() };
        assert_eq!(segment(&scan, &nothing, &run).err().unwrap().exit_code(), 3);
        let aside =
            Segment { iso: Some(100.0), seed: Some("sphere center=900,0,0 radius=1".into()), ..Segment::default() };
        assert_eq!(segment(&scan, &aside, &run).err().unwrap().exit_code(), 2);
    }

    #[test]
    fn what_cannot_work_is_refused() {
        let file = tempfile::NamedTempFile::with_suffix(".nrrd").unwrap();
        let volume = file.path().display().to_string();
        let check = |change: fn(&mut Segment)| {
            let mut params = Segment { volume: volume.clone(), iso: Some(1.0), ..Segment::default() };
            change(&mut params);
            params.validate().map_err(|e| e.to_string())
        };
        assert_eq!(check(|_| ()), Ok(()));
        for (change, part) in [
            ((|p| p.iso = None) as fn(&mut Segment), "iso"),
            (|p| p.upper = Some(0.5), "above `iso`"),
            (|p| (p.upper, p.epsilon) = (Some(2.0), Some(1.0)), "without"),
            (|p| p.epsilon = Some(0.0), "positive"),
            (|p| p.smoothness = 2.0, "0 to 1"),
            (|p| p.seed = Some("spere radius=1".into()), "sphere"),
            (|p| p.volume = "nowhere.nrrd".into(), "no such file"),
            (|p| p.half_width = 0.0, "half_width"),
        ] {
            assert!(check(change).unwrap_err().contains(part), "{part}: {:?}", check(change));
        }
    }
}
