//! Metamorphosis: a shape becomes another one, or several in turn (Whitaker & Breen 1998; Breen & Whitaker 2001).
//!
//! > φ_t = −F|∇φ|,  F = −f(b(y)),  y the surface point nearest to a voxel
//!
//! with b the signed distance to the target, wherever the surface goes, and f odd and rising: the surface moves outwards where it is inside the target,
//! inwards where it is outside of it, and rests on it. With f(b) = b the RMS distance falls as e^(−t); clamped, it falls at a constant rate far away.
//! An optional curvature prior −2βH keeps it smooth on the way, and a little off the target.
//!
//! Frame 1 is the first shape and the last frame the last one, unchanged; of a chain, each shape in between is a frame as well. The frames
//! between lie at equal steps of RMS distance, time (which takes the flow twice, once to learn when it arrives) or volume. The lattice is that of the first shape.
//!
//! What only one of two shapes has: `parts`. The coordinate transformation under the flow: `pose`.
//!
//! Measured (tests): concentric spheres of 8 and 15 voxels pass 9, 10, … 14 within 0.15; a cube comes to rest on a torus within 0.02 voxel RMS, with
//! normals that err by less than 0.8° in the mean; a shape that becomes itself stays within 0.05 voxel.

mod distance;
mod leg;
mod parts;
mod pose;
mod sequence;

use std::path::Path;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::transform::TransformOperator;
use super::{Arity, Operator, Outcome, Summary, VoxelLength, words};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::level_set_to_mesh;
use crate::run::RunOptions;
use distance::TargetDistance;
use leg::{Law, Leg};
use pose::{Moments, Pose};
pub use sequence::{FrameFacts, Place, Sequence, SequenceReport, TakeFrame, Ways};

const NAME: &str = "morph";

words! {
    /// What lies at equal steps between frames.
    FrameSpacing {
        /// The RMS distance to the target.
        Rms = "rms",
        /// The time of the flow.
        Time = "time",
        /// The volume.
        Volume = "volume",
    }
}

words! {
    /// How the source is laid over the target.
    Align {
        /// As they are.
        None = "none",
        /// By centre, principal axes and size.
        Moments = "moments",
    }
}

words! {
    /// The speed as a function of the distance b from the target.
    SpeedLaw {
        /// b: far parts arrive with the near ones.
        Linear = "linear",
        /// b, at most `max_speed`.
        Clamped = "clamped",
        /// `max_speed`, falling within the last voxel.
        Constant = "constant",
    }
}

/// Turn a shape into another one, or into several in turn.
///
/// The command writes a sequence of frames: the first is the first shape, the last the last one. In a recipe it is one of them, `at` a place in the sequence.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct Morph {
    /// Frames of the sequence, the first and the last shape included.
    pub frame_count: u32,
    /// Number of the first frame.
    pub frame_start: u32,
    /// What lies at equal steps between frames.
    pub frame_spacing: FrameSpacing,
    /// How each shape is laid over the next one while it becomes it: `moments` moves, turns and scales it by centre, axes and size.
    pub align: Align,
    /// The transformation that lays the first shape over the second one, such as `rotate z,90; scale 1.2; translate 1,0,0`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub transform: Option<String>,
    /// A text file of points of the first shape and where they are on the second: six numbers a line.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(extend("x-kind" = "FILE"))]
    pub landmarks: Option<String>,
    /// The speed as a function of the distance from the target.
    pub speed: SpeedLaw,
    /// Largest speed of `clamped` and `constant`, in voxels a unit of time.
    pub max_speed: VoxelLength,
    /// RMS distance from the target, in voxels, at which the flow ends.
    pub stop_rms: VoxelLength,
    /// Weight of the curvature prior, in voxels squared a unit of time; 0 for none.
    pub smoothness: f64,
    /// Let parts of either shape that the other one does not overlap grow out of the rest or move into it.
    pub bridge: bool,
    /// In a recipe: the place in the sequence, 0 the first shape, 1 the last one.
    pub at: f64,
}

impl Default for Morph {
    fn default() -> Self {
        Self {
            frame_count: 24,
            frame_start: 1,
            frame_spacing: FrameSpacing::Rms,
            align: Align::None,
            transform: None,
            landmarks: None,
            speed: SpeedLaw::Linear,
            max_speed: VoxelLength::new(1.0),
            stop_rms: VoxelLength::new(0.02),
            smoothness: 0.0,
            bridge: false,
            at: 1.0,
        }
    }
}

/// Most frames of a sequence.
const MOST_FRAMES: u32 = 1_000_000;

impl Operator for Morph {
    const NAME: &'static str = NAME;
    const ARITY: Arity = Arity::Many;

    fn validate(&self) -> Result<()> {
        let refuse =
            |field: &str, value: String, accepted: &str| Err(EditError::parameter(NAME, field, value, accepted));
        if !(2..=MOST_FRAMES).contains(&self.frame_count) {
            return refuse(
                "frame_count",
                self.frame_count.to_string(),
                "2 frames or more, the two shapes, at most 1000000",
            );
        }
        for (field, length) in [("max_speed", self.max_speed), ("stop_rms", self.stop_rms)] {
            let voxels = length.voxels(1.0);
            if !(voxels > 0.0 && voxels.is_finite()) {
                return refuse(field, length.to_string(), "a positive number of voxels");
            }
        }
        if !(0.0..=100.0).contains(&self.smoothness) {
            return refuse("smoothness", self.smoothness.to_string(), "a number of voxels squared from 0 to 100");
        }
        if !(0.0..=1.0).contains(&self.at) {
            return refuse("at", self.at.to_string(), "a place from 0 to 1");
        }
        let given = [self.align != Align::None, self.transform.is_some(), self.landmarks.is_some()];
        if given.iter().filter(|given| **given).count() > 1 {
            return refuse("align", "given".into(), "one of `align`, `transform` and `landmarks`");
        }
        if let Some(text) = &self.transform {
            similarity(text)?;
        }
        if let Some(file) = &self.landmarks {
            read_landmarks(Path::new(file))?;
        }
        Ok(())
    }

    fn apply(&self, inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        if let Some(first) = inputs.first().filter(|_| inputs.iter().all(LevelSet::is_empty)) {
            let warnings = vec!["all shapes are empty: so is the result".into()];
            return Ok(Outcome { level_set: first.clone(), summary: Summary { warnings, ..Summary::default() } });
        }
        let plan = Sequence::new(&inputs, self, run, &mut |_| ())?;
        let place = plan.locate(self.at);
        let mut made = None;
        let report = plan.frames(&[place], &mut |_, level_set, facts| {
            made = Some((level_set, facts));
            Ok(())
        })?;
        let mut summary = report.summary();
        let Some((level_set, facts)) = made else {
            return Err(EditError::parameter(NAME, "at", self.at, "a place from 0 to 1"));
        };
        summary.details.insert("frame".into(), facts.json());
        Ok(Outcome { level_set, summary })
    }
}

impl Morph {
    fn leg<'a>(&self, target: &'a TargetDistance) -> Leg<'a> {
        let voxel_size = target.level_set().voxel_size();
        Leg {
            target,
            law: Law { kind: self.speed, most: self.max_speed.world(voxel_size), voxel_size },
            bending: self.smoothness * voxel_size * voxel_size,
            spacing: self.frame_spacing,
            stop: self.stop_rms.world(voxel_size),
        }
    }

    /// The transformation between two shapes, if one is asked for.
    fn pose(&self, from: &LevelSet, to: &LevelSet, run: &RunOptions) -> Result<Option<Pose>> {
        if let Some(file) = &self.landmarks {
            return Pose::of_landmarks(&read_landmarks(Path::new(file))?).map(Some);
        }
        if self.align == Align::None && self.transform.is_none() {
            return Ok(None);
        }
        let source = level_set_to_mesh(from, 0.0, run)?;
        if let Some(text) = &self.transform {
            let pivot = Moments::of(&source).map_or(DVec3::ZERO, |m| m.centre);
            let refused =
                || EditError::parameter(NAME, "transform", text, "scale, rotate and translate, without a mirror");
            return Pose::of_similarity(similarity(text)?, pivot).map(Some).ok_or_else(refused);
        }
        let target = level_set_to_mesh(to, 0.0, run)?;
        let refused = || EditError::parameter(NAME, "align", "moments", "shapes with a volume");
        Pose::of_moments(&source, &target).map(Some).ok_or_else(refused)
    }
}

/// `scale s; rotate axis,degrees; translate x,y,z`, in this order.
fn similarity(text: &str) -> Result<glam::DAffine3> {
    let steps = text.split(';').map(|step| step.trim().to_owned()).filter(|step| !step.is_empty()).collect();
    let named = |error| match error {
        EditError::Parameter { value, accepted, .. } => EditError::parameter(NAME, "transform", value, accepted),
        error => error,
    };
    TransformOperator { steps, ..TransformOperator::default() }.motion().map_err(named)
}

/// Pairs of points: six numbers a line, blanks or commas between; `#` begins a comment.
fn read_landmarks(path: &Path) -> Result<Vec<(DVec3, DVec3)>> {
    let text = std::fs::read_to_string(path).map_err(|e| EditError::input(path, format!("cannot be read: {e}")))?;
    let mut pairs = Vec::new();
    for (n, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or_default().trim();
        if line.is_empty() {
            continue;
        }
        let numbers: Vec<f64> = line
            .split([',', ' ', '\t', ':'])
            .filter(|word| !word.is_empty())
            .map_while(|word| word.parse().ok().filter(|v: &f64| v.is_finite()))
            .collect();
        let &[a, b, c, d, e, f] = &numbers[..] else {
            return Err(EditError::input(
                path,
                format!("line {}: six numbers are wanted, a point and where it goes", n + 1),
            ));
        };
        pairs.push((DVec3::new(a, b, c), DVec3::new(d, e, f)));
    }
    match pairs.len() {
        2..=1000 => Ok(pairs),
        n => Err(EditError::input(path, format!("{n} pairs of points: 2 to 1000 are wanted"))),
    }
}

#[cfg(test)]
mod tests;
