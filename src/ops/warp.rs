//! Dragging: handles of a solid are moved, and the rest follows smoothly.
//!
//! The displacement is interpolated by radial basis functions with φ(r) = r and a linear polynomial ([`rbf`](crate::rbf)):
//!
//! > u(x) = Σ ωᵢ |x − pᵢ| + R x + t,  u(pᵢ) = qᵢ − pᵢ,  Σ ωᵢ = 0,  Σ ωᵢ pᵢᵀ = 0
//!
//! so that affine displacements are reproduced; where the handles do not span space, t alone stands beside the sum, which is enough for a unique
//! solution (r is conditionally negative definite of order 1). A region fades u by its weight: x goes to x + α(x)u(x).
//!
//! The map is applied to the polygonised surface, which is its zero set φ(x − u*) = 0 without an inverse to be searched for, and distances to the
//! moved polygons are exact. Where det(I + ∇(αu)) ≤ 0 the map folds and is refused.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::confine::kept;
use super::params::Vector;
use super::registry::{Arity, Operator, Outcome, Summary};
use super::solver::RegionSpecs;
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{level_set_of_mesh, level_set_to_mesh};
use crate::rbf::{Basis, Interpolant};
use crate::region::Region;
use crate::run::RunOptions;

/// Drag points of a surface to other places; the rest follows smoothly.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Warp {
    /// A point and where it goes, `x,y,z:x,y,z`. Several make a list.
    #[schemars(extend("x-list" = true, "x-kind" = "'x,y,z:x,y,z'"))]
    pub handle: Vec<String>,
    /// A point that stays. Several make a list.
    #[schemars(extend("x-list" = true, "x-kind" = "x,y,z"))]
    pub fixed: Vec<Vector>,
    /// Where to act, and how strongly: the displacement is multiplied by the weight, so that a wide soft edge (`soft=0.2,1`) makes a gentle falloff. Everywhere if not given.
    pub region: RegionSpecs,
}

/// Most handles and fixed points: the equations are dense.
const MOST_POINTS: usize = 1000;

/// Handles nearer to each other than this part of their extent count as one.
const SAME_PLACE: f64 = 1e-9;

impl Warp {
    /// Places and displacements.
    fn pairs(&self) -> Result<Vec<(DVec3, DVec3)>> {
        let refuse =
            |field: &str, value: &str, accepted: String| EditError::parameter(Self::NAME, field, value, accepted);
        let mut pairs = Vec::new();
        for text in &self.handle {
            let accepted = || refuse("handle", text, "two points `x,y,z:x,y,z`, where it is and where it goes".into());
            let (from, to) = text.split_once(':').ok_or_else(accepted)?;
            let point = |text: &str| text.parse::<Vector>().map(|v| v.0).map_err(|_| accepted());
            let (from, to) = (point(from)?, point(to)?);
            pairs.push((from, to - from));
        }
        pairs.extend(self.fixed.iter().map(|p| (p.0, DVec3::ZERO)));
        Ok(pairs)
    }
}

impl Operator for Warp {
    const NAME: &'static str = "warp";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        let pairs = self.pairs()?;
        if self.handle.is_empty() {
            return Err(EditError::parameter(Self::NAME, "handle", "nothing", "one handle `x,y,z:x,y,z` or more"));
        }
        if pairs.len() > MOST_POINTS {
            let accepted = format!("at most {MOST_POINTS} handles and fixed points");
            return Err(EditError::parameter(Self::NAME, "handle", pairs.len(), accepted));
        }
        Displacement::new(&pairs)?;
        self.region.validate()
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let level_set = inputs.remove(0);
        let displacement = Displacement::new(&self.pairs()?)?;
        let region = self.region.on(&level_set, run)?;
        let (level_set, least) = warp(&level_set, |x| displacement.at(x), region.as_deref(), run)?;
        let mut summary = Summary::default();
        match least {
            Some(least) => drop(summary.details.insert("least_volume_ratio".into(), least.into())),
            None => summary.warnings.push("nothing is moved: the region touches no part of the surface".into()),
        }
        Ok(Outcome { level_set, summary })
    }
}

/// Moves each point x of a solid to x + α(x)·u(x), u in world units; voxels that were active with α = 0 keep their bits. Returns the least
/// det(I + ∇(αu)) on the surface as well, `None` where nothing moves.
pub fn warp(
    level_set: &LevelSet,
    displacement: impl Fn(DVec3) -> DVec3 + Sync,
    region: Option<&dyn Region>,
    run: &RunOptions,
) -> Result<(LevelSet, Option<f64>)> {
    let mut mesh = level_set_to_mesh(level_set, 0.0, run)?;
    let by = |x: DVec3| match region {
        None => displacement(x),
        Some(region) => match f64::from(region.weight(x)) {
            0.0 => DVec3::ZERO,
            alpha => displacement(x) * alpha,
        },
    };
    let step = level_set.voxel_size() / 2.0;
    let task = run.task("warping", mesh.positions.len() as u64);
    let moved: Vec<(DVec3, f64, bool)> = mesh
        .positions
        .par_iter()
        .with_min_len(256)
        .map(|&x| {
            if run.is_cancelled() {
                return (x, 1.0, false);
            }
            let along = |axis: DVec3| axis + (by(x + axis * step) - by(x - axis * step)) / (2.0 * step);
            let gradient = DMat3::from_cols(along(DVec3::X), along(DVec3::Y), along(DVec3::Z));
            let u = by(x);
            task.advance(1);
            (x + u, gradient.determinant(), u != DVec3::ZERO)
        })
        .collect();
    run.check(Warp::NAME)?;
    if !moved.iter().any(|m| m.2) {
        return Ok((level_set.clone(), None));
    }
    let folded = moved.iter().zip(&mesh.positions).filter(|((_, det, _), _)| det.is_nan() || *det <= 0.0);
    if let Some(((_, det, _), x)) = folded.min_by(|a, b| a.0.1.total_cmp(&b.0.1)) {
        let accepted =
            "smaller displacements, handles farther from each other, or a region with a wider soft edge (`soft=0.2,1`)";
        return Err(EditError::parameter(
            Warp::NAME,
            "handle",
            format!("a map that folds at {x} (determinant {det:.3})"),
            accepted,
        ));
    }
    let least = moved.iter().map(|m| m.1).fold(f64::INFINITY, f64::min);
    mesh.positions = moved.into_iter().map(|m| m.0).collect();
    let warped = level_set_of_mesh(mesh, level_set.transform(), level_set.half_width(), run)?;
    let warped = match region {
        Some(region) => kept(level_set, warped, region),
        None => warped,
    };
    Ok((warped, Some(least)))
}

/// A smooth displacement through those of handles.
pub struct Displacement(Interpolant);

impl Displacement {
    /// Interpolates displacements at points, which must be distinct.
    pub fn new(pairs: &[(DVec3, DVec3)]) -> Result<Self> {
        let (points, values): (Vec<DVec3>, Vec<DVec3>) = pairs.iter().copied().unzip();
        let centre = points.iter().sum::<DVec3>() / points.len().max(1) as f64;
        let extent = points.iter().map(|p| p.distance(centre)).fold(0.0, f64::max);
        // Coordinates of the order of 1: lengths do not change the solution, but its digits.
        let unit = if extent > 0.0 { extent } else { 1.0 };
        for (i, p) in points.iter().enumerate() {
            if points[..i].iter().any(|q| q.distance(*p) < SAME_PLACE * unit) {
                let accepted = "handles and fixed points at different places";
                return Err(EditError::parameter(Warp::NAME, "handle", p, accepted));
            }
        }
        let interpolant = Interpolant::new(&points, &values, |_| 0.0, Basis::Linear, unit);
        let accepted = "handles and fixed points that are not so close to each other";
        interpolant.map(Self).ok_or_else(|| EditError::parameter(Warp::NAME, "handle", pairs.len(), accepted))
    }

    /// u at a point.
    pub fn at(&self, x: DVec3) -> DVec3 {
        self.0.at(x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::levelset::testing::{ball, sampled, torus};
    use crate::ops::compare::compare;

    fn run(level_set: &LevelSet, warp: &Warp) -> Result<Outcome> {
        warp.validate()?;
        warp.apply(vec![level_set.clone()], &RunOptions::default())
    }

    fn handles(list: &[([f64; 3], [f64; 3])], fixed: &[[f64; 3]]) -> Warp {
        let text = |p: &[f64; 3]| format!("{},{},{}", p[0], p[1], p[2]);
        Warp {
            handle: list.iter().map(|(a, b)| format!("{}:{}", text(a), text(b))).collect(),
            fixed: fixed.iter().map(|p| Vector(DVec3::from(*p))).collect(),
            ..Warp::default()
        }
    }

    /// Largest difference of two fields on the active voxels of the second.
    fn difference(a: &LevelSet, b: &LevelSet) -> f64 {
        let mut worst = 0.0f64;
        for &id in b.grid().leaves() {
            for offset in b.grid().mask(id).iter() {
                let ijk = b.grid().origin(id) + crate::grid::offset_to_local(offset);
                worst = worst.max(f64::from((a.grid().voxel(ijk).0 - b.grid().voxel(ijk).0).abs()));
            }
        }
        worst
    }

    #[test]
    fn handles_are_met_and_affine_maps_reproduced() {
        let affine = |p: DVec3| DVec3::new(0.1 * p.y + 3.0, -0.2 * p.x, 0.3 * p.z + 0.05 * p.x);
        let places: Vec<DVec3> =
            (0..9).map(|i| DVec3::new(f64::from(i % 3), f64::from(i / 3), f64::from(i * i % 5)) * 7.0).collect();
        let u = Displacement::new(&places.iter().map(|p| (*p, affine(*p))).collect::<Vec<_>>()).unwrap();
        for p in [DVec3::ZERO, DVec3::new(100.0, -3.0, 5.0)] {
            assert!((u.at(p) - affine(p)).length() < 1e-9);
        }
        for n in 1..9 {
            let pairs: Vec<_> = places[..n].iter().map(|p| (*p, DVec3::new(p.y.sin(), p.z, 1.0))).collect();
            let u = Displacement::new(&pairs).unwrap();
            assert!(pairs.iter().all(|(p, d)| (u.at(*p) - *d).length() < 1e-9), "{n}");
        }
    }

    #[test]
    fn one_handle_moves_the_solid() {
        let moved = run(&torus(14.0, 5.0), &handles(&[([0.0; 3], [2.25, -1.5, 0.75])], &[])).unwrap().level_set;
        let shift = DVec3::new(2.25, -1.5, 0.75);
        let expected = sampled(30, |p| ((p - shift).x.hypot((p - shift).y) - 14.0).hypot((p - shift).z) - 5.0);
        assert_eq!(moved.check(), []);
        // The polygons lie 3/8·κ = 0.075 voxel inside at most.
        assert!(difference(&moved, &expected) < 0.08, "{}", difference(&moved, &expected));
    }

    #[test]
    fn there_and_back_is_where_it_was() {
        let ball = ball(DVec3::ZERO, 20.0);
        let fixed = [[0.0, 0.0, -20.0], [15.0, 0.0, 0.0], [-15.0, 0.0, 0.0], [0.0, 15.0, 0.0], [0.0, -15.0, 0.0]];
        let there = run(&ball, &handles(&[([0.0, 0.0, 20.0], [0.0, 0.0, 26.0])], &fixed)).unwrap();
        assert_eq!(there.level_set.check(), []);
        let mut sampler = there.level_set.sampler();
        assert!(
            sampler.trilinear(DVec3::new(0.0, 0.0, 25.5)) < 0.0 && sampler.trilinear(DVec3::new(0.0, 0.0, 26.5)) > 0.0
        );
        // Back by the exact inverse: by fixed point iteration on u.
        let pairs: Vec<_> = std::iter::once((DVec3::Z * 20.0, DVec3::Z * 6.0))
            .chain(fixed.map(|p| (DVec3::from(p), DVec3::ZERO)))
            .collect();
        let u = Displacement::new(&pairs).unwrap();
        let inverse = |y: DVec3| {
            let mut x = y;
            for _ in 0..60 {
                x = y - u.at(x);
            }
            x - y
        };
        let (back, _) = warp(&there.level_set, inverse, None, &RunOptions::default()).unwrap();
        let distance = compare(&back, &ball, &RunOptions::default()).unwrap();
        assert!(distance.surface_distance.unwrap().max < 0.1);
    }

    #[test]
    fn a_region_fades_it_and_keeps_the_rest() {
        let ball = ball(DVec3::ZERO, 20.0);
        let region = super::super::RegionSpecs(vec!["sphere center=0,0,20 radius=14 soft=0.1,1".into()]);
        let params = Warp { region, ..handles(&[([0.0, 0.0, 20.0], [0.0, 0.0, 24.0])], &[]) };
        let pulled = run(&ball, &params).unwrap().level_set;
        assert_eq!(pulled.check(), []);
        let mut sampler = pulled.sampler();
        assert!(sampler.trilinear(DVec3::new(0.0, 0.0, 23.5)) < 0.0);
        for &id in ball.grid().leaves() {
            for offset in ball.grid().mask(id).iter() {
                let ijk = ball.grid().origin(id) + crate::grid::offset_to_local(offset);
                if (ijk.as_dvec3() - DVec3::Z * 20.0).length() > 14.0 {
                    assert_eq!(pulled.grid().voxel(ijk), ball.grid().voxel(ijk));
                }
            }
        }
        let away = super::super::RegionSpecs(vec!["sphere center=90,0,20 radius=4".into()]);
        let nothing = run(&ball, &Warp { region: away, ..params }).unwrap();
        assert!(nothing.summary.warnings[0].contains("nothing is moved"));
    }

    #[test]
    fn refusals() {
        let ball = ball(DVec3::ZERO, 12.0);
        let code = |warp: &Warp| run(&ball, warp).err().map(|e| e.exit_code());
        assert_eq!(code(&Warp::default()), Some(2));
        assert_eq!(code(&Warp { handle: vec!["1,2,3".into()], ..Warp::default() }), Some(2));
        assert_eq!(code(&handles(&[([0.0; 3], [1.0; 3]), ([0.0; 3], [2.0; 3])], &[])), Some(2));
        // Turned inside out between two handles.
        let folds = handles(
            &[([0.0, 0.0, 12.0], [0.0, 0.0, -12.0])],
            &[[0.0, 0.0, 8.0], [9.0, 0.0, 9.0], [-9.0, 0.0, 9.0], [0.0, 9.0, 9.0]],
        );
        let error = run(&ball, &folds).err().unwrap();
        assert!(error.to_string().contains("folds"), "{error}");
    }
}
