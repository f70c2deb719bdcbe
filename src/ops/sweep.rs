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

use super::confine::kept;
use super::emboss::read_polylines;
use super::params::{Vector, words};
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::RegionSpecs;
use crate::error::{EditError, Result};
use crate::grid::MAX_COORD;
use crate::levelset::LevelSet;
use crate::mesh::{Rebuild, Spline, double_reflection, rebuild};
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
    #[schemars(extend("x-list" = true, "x-kind" = "x,y,z"))]
    pub through: Vec<Vector>,
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
            None => self.through.iter().map(|p| p.0).collect(),
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
    let places: Vec<DAffine3> = motions(path, turning, |motion| {
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
        for (k, back) in back.iter().enumerate() {
            let reach = least + radius;
            if reach > 0.0 && squared(k) < reach * reach {
                least = least.min(single(&mut sampler, back.transform_point3(ijk)));
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
        Some(region) => kept(level_set, result, region),
        None => result,
    };
    Ok((result, places.len()))
}

/// The motions of the world from the start along a path, so close that `traced` points of the solid move by half a voxel at most.
fn motions<const N: usize>(
    path: &Spline,
    turning: Turning,
    traced: impl Fn(DAffine3) -> (DAffine3, [DVec3; N]),
) -> Result<Vec<DAffine3>> {
    let (start, tangent) = path.at(0, 0.0);
    let first =
        DMat3::from_cols(tangent.any_orthonormal_vector(), tangent.cross(tangent.any_orthonormal_vector()), tangent);
    let motion = |point: DVec3, frame: &DMat3| {
        let turn = if turning == Turning::Path { *frame * first.transpose() } else { DMat3::IDENTITY };
        DAffine3::from_translation(point) * DAffine3::from_mat3(turn) * DAffine3::from_translation(-start)
    };
    let (mut before, mut frame) = ((start, tangent), first);
    let (mut placed, mut trace) = traced(motion(start, &frame));
    let mut motions = vec![placed];
    for i in 0..path.pieces() {
        let mut t = 0.0;
        let mut step: f64 = 1.0 / PIECES as f64;
        while t < 1.0 {
            let next = (t + step).min(1.0);
            let after = path.at(i, next);
            let carried = double_reflection(&frame, before, after);
            let (there, moved) = traced(motion(after.0, &carried));
            let most = moved.iter().zip(&trace).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
            if most > OVERLAP {
                // Shorter by what it was too long.
                step = (next - t) * (0.9 * OVERLAP / most).min(0.9);
                if motions.len() > MOST_PLACES || step < 1e-9 {
                    let accepted = format!("a path along which half voxels are at most {MOST_PLACES} steps");
                    return Err(EditError::parameter(Sweep::NAME, "through", path.pieces() + 1, accepted));
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{ball, box_distance, sampled};

    fn swept(level_set: &LevelSet, points: &[[f64; 3]], turning: Turning) -> LevelSet {
        let through = points.iter().map(|p| Vector(DVec3::from(*p))).collect();
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
    fn a_region_keeps_what_it_leaves_out() {
        let ball = ball(DVec3::ZERO, 8.0);
        let region = RegionSpecs(vec!["halfspace point=12,0,0 normal=1,0,0".into()]);
        let params = Sweep { through: vec![Vector(DVec3::ZERO), Vector(DVec3::X * 30.0)], region, ..Sweep::default() };
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
        assert_eq!(code(Sweep { through: vec![Vector(DVec3::ZERO); 2], ..Sweep::default() }), Some(2));
        assert_eq!(code(Sweep { path: Some("absent.xyz".into()), ..Sweep::default() }), Some(3));
        assert_eq!(
            code(Sweep { through: vec![Vector(DVec3::ZERO), Vector(DVec3::X * 1e9)], ..Sweep::default() }),
            Some(2)
        );
    }
}
