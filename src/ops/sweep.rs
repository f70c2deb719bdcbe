//! Sweeping: the union of a solid at all places along a spline.
//!
//! The path is a natural cubic spline through points, straight between two. The solid goes with it as it lies at the first point; a frame that
//! turns as little as possible goes along, by double reflection (Wang, Jüttler, Zheng and Liu 2008), fourth order in the spacing of samples:
//!
//! > x(s) = C(s) + F(s) F(0)ᵀ (x − C(0))
//!
//! The solid is united at so many places that no point of it moves by more than half a voxel from one to the next: what is left between two
//! balls of radius r is δ²/8r, 0.003 voxel at r = 10. The union is min φ(x(s)⁻¹); distances are then made exact from its surface.

use glam::{DAffine3, DMat3, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

use super::emboss::read_polylines;
use super::keep::kept;
use super::params::{Vector, words};
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::RegionSpecs;
use crate::error::{EditError, Result};
use crate::grid::MAX_COORD;
use crate::levelset::LevelSet;
use crate::mesh::{Rebuild, rebuild};
use crate::region::Region;
use crate::run::RunOptions;

words! {
    /// Whether a swept solid turns.
    Turning {
        /// It turns with the path.
        Path = "path",
        /// It keeps its orientation.
        None = "none",
    }
}

/// Sweep a solid along a curve: the union of all places that it takes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Sweep {
    /// A file of points that the path runs through: a text of `x y z` a line, or an OBJ with one `l` statement.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub path: Option<PathBuf>,
    /// A point that the path runs through, `x,y,z`, instead of a file. Several make a list; the solid is carried from the first on.
    #[schemars(extend("x-list" = true, "x-kind" = "'x,y,z'"))]
    pub through: Vec<String>,
    /// Whether the solid turns with the `path` or not (`none`).
    pub turning: Turning,
    /// Where material may be added; everywhere if not given.
    pub region: RegionSpecs,
}

impl Default for Sweep {
    fn default() -> Self {
        Self { path: None, through: Vec::new(), turning: Turning::Path, region: RegionSpecs::default() }
    }
}

/// Most places that a solid is united at.
const MOST_PLACES: usize = 200_000;

/// Most points of a path.
const MOST_POINTS: usize = 10_000;

/// How far a point of the solid moves from one place to the next at most, in voxels.
const OVERLAP: f64 = 0.5;

/// Pieces that a path is cut into between two points at least: from its ends alone a bend would not be seen.
const PIECES: usize = 4;

impl Sweep {
    fn points(&self) -> Result<Vec<DVec3>> {
        let refuse =
            |field: &str, value: String, accepted: String| EditError::parameter(Self::NAME, field, value, accepted);
        let points = match &self.path {
            Some(path) => {
                let mut lines = read_polylines(path)?;
                if lines.len() > 1 {
                    return Err(EditError::input(path, format!("it holds {} lines; a path is one", lines.len())));
                }
                lines.pop().unwrap_or_default()
            }
            None => {
                let point = |t: &String| t.parse::<Vector>().map(|v| v.0).map_err(|e| refuse("through", t.clone(), e));
                self.through.iter().map(point).collect::<Result<_>>()?
            }
        };
        let mut distinct = points;
        distinct.dedup();
        match distinct.len() {
            2..=MOST_POINTS => Ok(distinct),
            n => Err(refuse("through", format!("{n} points"), format!("2 to {MOST_POINTS} different points"))),
        }
    }
}

impl Operator for Sweep {
    const NAME: &'static str = "sweep";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        match (&self.path, self.through.is_empty()) {
            (None, true) => {
                let accepted = "a `path` (a file) or two points `through` or more";
                return Err(EditError::parameter(Self::NAME, "path", "nothing", accepted));
            }
            (Some(path), false) => {
                let accepted = "either `path` or `through`, not both";
                return Err(EditError::parameter(Self::NAME, "path", path.display(), accepted));
            }
            (None, false) => drop(self.points()?),
            (Some(_), true) => {}
        }
        self.region.validate()
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let level_set = inputs.remove(0);
        let spline = Spline::through(&self.points()?);
        let region = self.region.on(&level_set, run)?;
        let (level_set, places) = sweep(&level_set, &spline, self.turning, region.as_deref(), run)?;
        let mut summary = Summary::default();
        summary.details.insert("places".into(), places.into());
        Ok(Outcome { level_set, summary })
    }
}

/// Unites a solid with itself at all places along a path, where the region's weight is a half or more; voxels that were active with weight 0
/// keep their bits. Returns the number of places as well.
pub fn sweep(
    level_set: &LevelSet,
    path: &Spline,
    turning: Turning,
    region: Option<&dyn Region>,
    run: &RunOptions,
) -> Result<(LevelSet, usize)> {
    let Some((lo, hi)) = level_set.grid().active_bounds() else { return Ok((level_set.clone(), 0)) };
    let transform = *level_set.transform();
    let (lo, hi) = (lo.as_dvec3(), hi.as_dvec3());
    let corners: [DVec3; 8] = std::array::from_fn(|c| {
        DVec3::new(
            if c & 4 == 0 { lo.x } else { hi.x },
            if c & 2 == 0 { lo.y } else { hi.y },
            if c & 1 == 0 { lo.z } else { hi.z },
        )
    });
    // Motions of index space.
    let (to_world, to_index) = (transform.to_world(), transform.to_index());
    let places: Vec<DAffine3> = path.motions(turning, |motion| {
        let motion = to_index * motion * to_world;
        (motion, corners.map(|c| motion.transform_point3(c)))
    })?;
    let back: Vec<DAffine3> = places.iter().map(|p| p.inverse()).collect();
    let (centre, radius) = ((lo + hi) / 2.0, (hi - lo).length() / 2.0);
    let centres: Vec<DVec3> = places.iter().map(|p| p.transform_point3(centre)).collect();
    let bounds = centres.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(a, b), c| (a.min(*c), b.max(*c)));
    let bounds = (bounds.0 - radius - 1.0, bounds.1 + radius + 1.0);
    if bounds.0.abs().max(bounds.1.abs()).max_element() > f64::from(MAX_COORD) {
        let accepted = "a path within 2^30 voxels of the origin";
        return Err(EditError::parameter(Sweep::NAME, "through", format!("{}", bounds.1), accepted));
    }
    let voxel_size = level_set.voxel_size();
    // Of one copy, at a point of its own index space.
    let single = |sampler: &mut crate::levelset::Sampler, x: DVec3| {
        let outside = (lo - x).max(x - hi).max(DVec3::ZERO).length();
        if outside > 0.0 {
            outside + f64::from(level_set.background()) / voxel_size
        } else {
            f64::from(sampler.trilinear(x)) / voxel_size
        }
    };
    let distance = |ijk: DVec3| {
        let mut sampler = level_set.sampler();
        let squared = |k: usize| centres[k].distance_squared(ijk);
        let near = (0..places.len()).min_by(|&a, &b| squared(a).total_cmp(&squared(b))).unwrap_or(0);
        let mut least = single(&mut sampler, back[near].transform_point3(ijk));
        for k in 0..places.len() {
            let reach = least + radius;
            if reach > 0.0 && squared(k) < reach * reach {
                least = least.min(single(&mut sampler, back[k].transform_point3(ijk)));
            }
        }
        if let Some(region) = region
            && region.weight(transform.index_to_world(ijk)) < 0.5
        {
            // What was there stays.
            let own = single(&mut sampler, ijk);
            least = own.min(least.max(0.5));
        }
        least
    };
    let half_width = level_set.half_width();
    let task = run.task(Sweep::NAME, 0);
    let union = LevelSet::from_distance(
        transform,
        half_width,
        (bounds.0.floor().as_ivec3(), bounds.1.ceil().as_ivec3()),
        distance,
        run,
    )?;
    drop(task);
    let result = rebuild(&union, &Rebuild::band(half_width), run)?;
    let result = match region {
        Some(region) => kept(result, level_set, region, run)?,
        None => result,
    };
    Ok((result, places.len()))
}

/// A natural cubic spline through points, its parameter the length of the chords.
pub struct Spline {
    points: Vec<DVec3>,
    /// Length of the chord after each point but the last.
    chords: Vec<f64>,
    /// Second derivatives.
    bends: Vec<DVec3>,
}

impl Spline {
    /// Through points of which no two neighbours are equal.
    pub fn through(points: &[DVec3]) -> Self {
        let chords: Vec<f64> = points.windows(2).map(|w| w[0].distance(w[1])).collect();
        let n = points.len();
        let mut bends = vec![DVec3::ZERO; n];
        // h₋ m₋ + 2(h₋ + h₊) m + h₊ m₊ = 6 (d₊ − d₋), no bend at the ends: elimination and back substitution.
        let (mut factors, mut rights) = (vec![0.0; n], vec![DVec3::ZERO; n]);
        for i in 1..n.saturating_sub(1) {
            let (a, b) = (chords[i - 1], chords[i]);
            let slope = |k: usize| (points[k + 1] - points[k]) / chords[k];
            let pivot = 2.0 * (a + b) - a * factors[i - 1];
            factors[i] = b / pivot;
            rights[i] = ((slope(i) - slope(i - 1)) * 6.0 - rights[i - 1] * a) / pivot;
        }
        for i in (1..n.saturating_sub(1)).rev() {
            bends[i] = rights[i] - bends[i + 1] * factors[i];
        }
        Self { points: points.to_vec(), chords, bends }
    }

    /// Point and tangent (a unit vector) at part `t` (0..1) of piece `i`.
    fn at(&self, i: usize, t: f64) -> (DVec3, DVec3) {
        let (h, s) = (self.chords[i], 1.0 - t);
        let (p, q, m, n) = (self.points[i], self.points[i + 1], self.bends[i], self.bends[i + 1]);
        let square = h * h / 6.0;
        let point = p * s + q * t + (m * (s * s * s - s) + n * (t * t * t - t)) * square;
        let slope = (q - p) / h + (n * (3.0 * t * t - 1.0) - m * (3.0 * s * s - 1.0)) * (h / 6.0);
        (point, slope.try_normalize().unwrap_or((q - p) / h))
    }

    /// The motions of the world from the start along the path, so close that `traced` points of the solid move by half a voxel at most.
    fn motions<const N: usize>(
        &self,
        turning: Turning,
        traced: impl Fn(DAffine3) -> (DAffine3, [DVec3; N]),
    ) -> Result<Vec<DAffine3>> {
        let (start, tangent) = self.at(0, 0.0);
        let first = DMat3::from_cols(
            tangent.any_orthonormal_vector(),
            tangent.cross(tangent.any_orthonormal_vector()),
            tangent,
        );
        let motion = |point: DVec3, frame: &DMat3| {
            let turn = if turning == Turning::Path { *frame * first.transpose() } else { DMat3::IDENTITY };
            DAffine3::from_translation(point) * DAffine3::from_mat3(turn) * DAffine3::from_translation(-start)
        };
        let (mut before, mut frame) = ((start, tangent), first);
        let (mut placed, mut trace) = traced(motion(start, &frame));
        let mut motions = vec![placed];
        for i in 0..self.chords.len() {
            let mut t = 0.0;
            let mut step: f64 = 1.0 / PIECES as f64;
            while t < 1.0 {
                let next = (t + step).min(1.0);
                let after = self.at(i, next);
                let carried = double_reflection(&frame, before, after);
                let (there, moved) = traced(motion(after.0, &carried));
                let most = moved.iter().zip(&trace).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
                if most > OVERLAP {
                    // Shorter by what it was too long.
                    step = (next - t) * (0.9 * OVERLAP / most).min(0.9);
                    if motions.len() > MOST_PLACES || step < 1e-9 {
                        let accepted = format!("a path along which half voxels are at most {MOST_PLACES} steps");
                        return Err(EditError::parameter(Sweep::NAME, "through", self.points.len(), accepted));
                    }
                    continue;
                }
                (t, before, frame, placed, trace) = (next, after, carried, there, moved);
                motions.push(placed);
                step = (step * (0.9 * OVERLAP / most.max(1e-12)).min(2.0)).min(1.0 / PIECES as f64);
            }
        }
        Ok(motions)
    }
}

/// The frame (two normals, tangent) carried from a point and tangent to the next by two reflections, turning as little as can be.
fn double_reflection(frame: &DMat3, (x, _): (DVec3, DVec3), (y, tangent): (DVec3, DVec3)) -> DMat3 {
    let reflect = |v: DVec3, along: DVec3| {
        let squared = along.length_squared();
        if squared > 0.0 { v - along * (2.0 * v.dot(along) / squared) } else { v }
    };
    let chord = y - x;
    let (normal, turned) = (reflect(frame.x_axis, chord), reflect(frame.z_axis, chord));
    let normal = reflect(normal, tangent - turned);
    // Rounding would add up over many steps.
    let normal = (normal - tangent * normal.dot(tangent)).try_normalize().unwrap_or(frame.x_axis);
    DMat3::from_cols(normal, tangent.cross(normal), tangent)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{ball, box_distance, sampled};

    fn swept(level_set: &LevelSet, points: &[[f64; 3]], turning: Turning) -> LevelSet {
        let through = points.iter().map(|p| format!("{},{},{}", p[0], p[1], p[2])).collect();
        let params = Sweep { through, turning, ..Sweep::default() };
        params.validate().unwrap();
        let result = params.apply(vec![level_set.clone()], &RunOptions::default()).unwrap().level_set;
        assert_eq!(result.check(), []);
        result
    }

    fn difference(a: &LevelSet, exact: impl Fn(DVec3) -> f64) -> f64 {
        let mut worst = 0.0f64;
        for &id in a.grid().leaves() {
            for offset in a.grid().mask(id).iter() {
                let ijk = a.grid().origin(id) + crate::grid::offset_to_local(offset);
                worst = worst.max((f64::from(a.grid().values(id).0[offset]) - exact(ijk.as_dvec3())).abs());
            }
        }
        worst
    }

    #[test]
    fn a_ball_along_a_segment_is_the_capsule() {
        let (a, b) = (DVec3::new(0.2, 0.1, -0.3), DVec3::new(13.2, 20.1, 8.7));
        let capsule = swept(&ball(a, 8.0), &[a.to_array(), b.to_array()], Turning::Path);
        let exact = |p: DVec3| {
            let t = ((p - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
            (p - a - (b - a) * t).length() - 8.0
        };
        // Polygons lie 3/8·κ = 0.047 inside, the input's linear interpolation h²κ/4 and the scallops a little more.
        let worst = difference(&capsule, exact);
        assert!(worst < 0.1, "{worst}");
    }

    #[test]
    fn a_plate_turns_with_the_path_or_does_not() {
        // A plate across the path, around a quarter of a circle: at the end it stands across again.
        let plate = sampled(20, |p| box_distance(p, DVec3::new(6.0, 6.0, 2.0)));
        let path: Vec<[f64; 3]> = (0..=8)
            .map(|i| f64::from(i) * std::f64::consts::FRAC_PI_2 / 8.0)
            .map(|a| [30.0 - 30.0 * a.cos(), 0.0, 30.0 * a.sin()])
            .collect();
        let turned = swept(&plate, &path, Turning::Path);
        let fixed = swept(&plate, &path, Turning::None);
        // Behind the end of the path, to the outside of the bend.
        let beside = DVec3::new(30.0, 0.0, 35.0);
        assert!(turned.sampler().trilinear(beside) < 0.0 && fixed.sampler().trilinear(beside) > 0.0);
        let ahead = DVec3::new(35.0, 0.0, 30.0);
        assert!(turned.sampler().trilinear(ahead) > 0.0 && fixed.sampler().trilinear(ahead) < 0.0);
    }

    #[test]
    fn frames_of_a_helix_turn_by_its_torsion() {
        // A rotation minimising frame turns against the Frenet frame by ∫τ ds; the analytic frame of the helix (cos, sin, c·t) gives the angle.
        let c = 0.5f64;
        let speed = (1.0 + c * c).sqrt();
        let at = |t: f64| (DVec3::new(t.cos(), t.sin(), c * t), DVec3::new(-t.sin(), t.cos(), c) / speed);
        let normal = |t: f64| DVec3::new(-t.cos(), -t.sin(), 0.0);
        let error = |n: usize| {
            let (_, tangent) = at(0.0);
            let mut frame = DMat3::from_cols(normal(0.0), tangent.cross(normal(0.0)), tangent);
            for k in 0..n {
                let [a, b] = [k, k + 1].map(|k| std::f64::consts::TAU * k as f64 / n as f64);
                frame = double_reflection(&frame, at(a), at(b));
            }
            let binormal = at(std::f64::consts::TAU).1.cross(normal(0.0));
            let angle = frame.x_axis.dot(binormal).atan2(frame.x_axis.dot(normal(0.0)));
            let expected = -c / speed * std::f64::consts::TAU;
            let turn = (angle - expected) / std::f64::consts::TAU;
            ((turn - turn.round()) * std::f64::consts::TAU).abs()
        };
        let (coarse, fine) = (error(16), error(32));
        assert!(coarse < 1e-3 && fine < coarse / 12.0, "{coarse} {fine}");
    }

    #[test]
    fn a_spline_runs_through_its_points_without_a_kink() {
        let points = [DVec3::ZERO, DVec3::new(3.0, 1.0, 0.0), DVec3::new(5.0, -1.0, 2.0), DVec3::new(5.5, 0.0, 7.0)];
        let spline = Spline::through(&points);
        for i in 0..3 {
            assert!(
                (spline.at(i, 0.0).0 - points[i]).length() < 1e-12
                    && (spline.at(i, 1.0).0 - points[i + 1]).length() < 1e-12
            );
        }
        for i in 0..2 {
            assert!((spline.at(i, 1.0).1 - spline.at(i + 1, 0.0).1).length() < 1e-9);
        }
    }

    #[test]
    fn a_region_keeps_what_it_leaves_out() {
        let ball = ball(DVec3::ZERO, 8.0);
        let region = RegionSpecs(vec!["halfspace point=12,0,0 normal=1,0,0".into()]);
        let params = Sweep { through: vec!["0,0,0".into(), "30,0,0".into()], region, ..Sweep::default() };
        let cut = params.apply(vec![ball.clone()], &RunOptions::default()).unwrap().level_set;
        assert_eq!(cut.check(), []);
        assert!(cut.sampler().trilinear(DVec3::X * 9.0) < 0.0 && cut.sampler().trilinear(DVec3::X * 14.0) > 0.0);
    }

    #[test]
    fn refusals() {
        let code = |sweep: Sweep| {
            sweep
                .validate()
                .and_then(|()| sweep.apply(vec![ball(DVec3::ZERO, 5.0)], &RunOptions::default()))
                .err()
                .map(|e| e.exit_code())
        };
        assert_eq!(code(Sweep::default()), Some(2));
        assert_eq!(code(Sweep { through: vec!["0,0,0".into(), "0,0,0".into()], ..Sweep::default() }), Some(2));
        assert_eq!(code(Sweep { path: Some("absent.xyz".into()), ..Sweep::default() }), Some(3));
        assert_eq!(code(Sweep { through: vec!["0,0,0".into(), "1e9,0,0".into()], ..Sweep::default() }), Some(2));
    }
}
