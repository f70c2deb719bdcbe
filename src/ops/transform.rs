//! Placing a level set: scale, rotation, translation, mirror, in the order given.
//!
//! The result lies on the plain lattice of its voxel size (that of the input times the scale, or one asked for), so that
//! placed parts can be combined voxel by voxel. Where the lattices coincide (right angles, mirrors, whole voxels) the
//! voxels are renamed; otherwise exact distances to the moved polygonised surface are computed (error 3/8·h²κ
//! at most where it is smooth). `keep_grid` changes the grid's transform alone and no voxel.

use glam::{DAffine3, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::params::{Vector, WorldLength, parse_numbers, voxel_size};
use super::registry::{Arity, Operator, Outcome};
use crate::error::{EditError, Result};
use crate::grid::Transform;
use crate::levelset::LevelSet;
use crate::mesh::onto_lattice;
use crate::run::RunOptions;
use crate::spec::parse_rotation;

/// Scale, rotate, mirror and move a level set.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct TransformOperator {
    /// What to do, in this order: `scale s`, `rotate axis,degrees` or `rotate x,y,z,w`, `translate x,y,z`, `mirror x|y|z`.
    #[schemars(extend("x-list" = true, "x-kind" = "'rotate y,90'"))]
    pub steps: Vec<String>,
    /// The point that scale, rotation and mirror leave where it is.
    pub about: Vector,
    /// Change only the grid's transform; no voxel is resampled.
    pub keep_grid: bool,
    /// Voxel size of the result; that of the input times the scale if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub voxel_size: Option<WorldLength>,
}

impl TransformOperator {
    /// The map of the world.
    pub fn motion(&self) -> Result<DAffine3> {
        let centre = DAffine3::from_translation(self.about.0);
        let mut motion = DAffine3::IDENTITY;
        for step in &self.steps {
            let (map, centred) =
                parse_step(step).map_err(|accepted| EditError::parameter(Self::NAME, "steps", step, accepted))?;
            let map = if centred { centre * map * centre.inverse() } else { map };
            motion = map * motion;
        }
        Ok(motion)
    }
}

/// The map of one step, and whether it is about a point; otherwise what would be accepted.
fn parse_step(step: &str) -> Result<(DAffine3, bool), String> {
    let (verb, value) = step.trim().split_once(char::is_whitespace).unwrap_or((step.trim(), ""));
    let value = value.trim();
    match verb {
        "scale" => match parse_numbers(value)?[..] {
            [s] if s > 0.0 && s.is_finite() => Ok((DAffine3::from_scale(DVec3::splat(s)), true)),
            [_, ..] if parse_numbers(value)?.len() > 1 => {
                Err("one number: a level set keeps its distances under uniform scales only".into())
            }
            _ => Err("a positive number".into()),
        },
        "rotate" => Ok((DAffine3::from_quat(parse_rotation(value)?), true)),
        "translate" => Ok((DAffine3::from_translation(value.parse::<Vector>()?.0), false)),
        "mirror" => {
            let axis = match value {
                "x" => DVec3::X,
                "y" => DVec3::Y,
                "z" => DVec3::Z,
                _ => return Err(format!("x, y or z, not `{value}`")),
            };
            Ok((DAffine3::from_scale(DVec3::ONE - 2.0 * axis), true))
        }
        _ => Err(crate::spec::suggest(verb, ["scale", "rotate", "translate", "mirror"].into_iter())),
    }
}

impl Operator for TransformOperator {
    const NAME: &'static str = "transform";
    const ARITY: Arity = Arity::One;

    fn validate(&self) -> Result<()> {
        let motion = self.motion()?;
        if !motion.is_finite() {
            return Err(EditError::parameter(
                Self::NAME,
                "steps",
                format!("{:?}", self.steps),
                "steps whose product is finite",
            ));
        }
        if let Some(size) = self.voxel_size {
            if self.keep_grid {
                return Err(EditError::parameter(
                    Self::NAME,
                    "voxel_size",
                    size,
                    "without `keep_grid`, which resamples nothing",
                ));
            }
            voxel_size(Self::NAME, size)?;
        }
        Ok(())
    }

    fn apply(&self, mut inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let input = inputs.remove(0);
        let moved = input.moved(self.motion()?).map_err(|reason| {
            EditError::parameter(Self::NAME, "steps", self.steps.join(", "), format!("a similarity; {reason}"))
        })?;
        if self.keep_grid {
            return Ok(moved.into());
        }
        let size = match self.voxel_size {
            Some(size) => voxel_size(Self::NAME, size)?,
            None => rounded(moved.voxel_size(), input.voxel_size()),
        };
        Ok(onto_lattice(&moved, &Transform::uniform(size), input.half_width(), run)?.into())
    }
}

/// A rotation's rounding must not change the voxel size in its last digit: then nothing would lie on one lattice any more.
fn rounded(moved: f64, original: f64) -> f64 {
    if (moved / original - 1.0).abs() < 1e-12 { original } else { moved }
}

#[cfg(test)]
mod tests {
    use glam::IVec3;

    use super::*;

    fn motion(steps: &[&str], about: [f64; 3]) -> DAffine3 {
        let steps = steps.iter().map(|s| s.to_string()).collect();
        TransformOperator { steps, about: Vector(about.into()), ..Default::default() }.motion().unwrap()
    }

    #[test]
    fn steps_act_in_their_order() {
        let p = DVec3::new(1.0, 2.0, 3.0);
        let a = motion(&["translate 1,0,0", "scale 2"], [0.0; 3]).transform_point3(p);
        let b = motion(&["scale 2", "translate 1,0,0"], [0.0; 3]).transform_point3(p);
        assert_eq!((a, b), (DVec3::new(4.0, 4.0, 6.0), DVec3::new(3.0, 4.0, 6.0)));
        let about = motion(&["rotate z,90", "mirror x"], [1.0, 2.0, 3.0]).transform_point3(p);
        assert!((about - p).length() < 1e-12);
    }

    #[test]
    fn a_turned_ball_is_the_ball_there() {
        let run = RunOptions::default();
        let centre = DVec3::new(12.3, -4.5, 7.8);
        let bounds = (IVec3::splat(-30), IVec3::splat(40));
        let ball =
            LevelSet::from_distance(Transform::uniform(1.0), 3.0, bounds, |p| (p - centre).length() - 15.2, &run)
                .unwrap();
        let steps = ["rotate y,33", "scale 0.5", "translate 3.3,2.2,-1.1"].map(String::from).to_vec();
        let operator = TransformOperator { steps, ..Default::default() };
        let there = operator.motion().unwrap().transform_point3(centre);
        let moved = operator.apply(vec![ball.clone()], &run).unwrap().level_set;
        assert_eq!((moved.voxel_size(), moved.half_width()), (0.5, 3.0));
        let mut worst = 0f64;
        for &id in moved.grid().leaves() {
            for at in moved.grid().mask(id).iter() {
                let p = moved.transform().voxel_to_world(moved.grid().origin(id) + crate::grid::offset_to_local(at));
                worst = worst.max((f64::from(moved.grid().values(id).0[at]) - ((p - there).length() - 7.6)).abs());
            }
        }
        // 3/8·h²κ of the source's polygons, in its voxels; half of that in the world.
        assert!(worst < 0.375 / 15.2 * 0.5, "{worst}");
        let kept = TransformOperator { keep_grid: true, ..operator }.apply(vec![ball.clone()], &run).unwrap().level_set;
        assert_eq!(kept.grid().active_voxels(), ball.grid().active_voxels());
    }

    #[test]
    fn impossible_steps_say_what_would_work() {
        for (step, part) in [
            ("scale 1,2,1", "uniform"),
            ("scale 0", "positive"),
            ("rotate 90", "axis,degrees"),
            ("mirror w", "x, y or z"),
            ("rotat x,90", "did you mean `rotate`"),
            ("translate 1,2", "three finite numbers"),
        ] {
            let operator = TransformOperator { steps: vec![step.into()], ..Default::default() };
            let error = operator.validate().unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
