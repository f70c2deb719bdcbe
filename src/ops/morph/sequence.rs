//! A sequence of frames through two shapes or more: planned, placed, run.

use glam::DVec3;
use rayon::prelude::*;
use serde_json::json;

use super::distance::TargetDistance;
use super::leg::{self, State};
use super::parts::{Bud, Buds, Overlap};
use super::pose::{Moments, Pose};
use super::{FrameSpacing, Morph, NAME};
use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::{level_set_to_mesh, onto_lattice};
use crate::ops::{Operator, Summary};
use crate::run::RunOptions;

/// Ratio of sizes from which on different units are suspected.
const OTHER_UNITS: f64 = 20.0;

/// Distance in voxels below which two shapes are the same.
const SAME: f64 = 0.05;

/// A place in a sequence: a leg, and how far along it, 0 to 1.
pub type Place = (usize, f64);

/// What is told of a frame.
#[derive(Clone, Copy, Debug)]
pub struct FrameFacts {
    /// Where it is.
    pub place: Place,
    /// RMS distance from the shape that is being approached, in voxels.
    pub rms_voxels: f64,
    /// −∫ b over the inside, as a part of that of the target: 1 there, and it does not fall on the way.
    pub shared_volume: f64,
    /// Volume, world units cubed.
    pub volume: f64,
    /// Time of the flow.
    pub time: f64,
}

impl FrameFacts {
    /// As a JSON object.
    pub fn json(&self) -> serde_json::Value {
        json!({
            "leg": self.place.0 + 1, "place": self.place.1, "rms_voxels": self.rms_voxels,
            "shared_volume": self.shared_volume, "volume": self.volume, "time": self.time,
        })
    }
}

/// Where points of a frame come from and where they go.
pub struct Ways {
    poses: Vec<Option<Pose>>,
    voxel_size: f64,
}

impl Ways {
    /// The places on the shapes around a frame of points of that frame, undoing the transformation as far as it has gone and doing it to its end: the colours of
    /// either shape are looked for there.
    pub fn of(&self, place: Place, points: &[DVec3]) -> [Vec<DVec3>; 2] {
        let Some(pose) = self.poses.get(place.0).and_then(Option::as_ref) else {
            return [points.to_vec(), points.to_vec()];
        };
        let back = |y: &DVec3| pose.inverse(*y, place.1, self.voxel_size).unwrap_or(*y);
        let source: Vec<DVec3> = points.par_iter().map(back).collect();
        let target = source.par_iter().map(|x| pose.at(*x, 1.0)).collect();
        [source, target]
    }
}

/// What is told of a sequence.
#[derive(Clone, Debug, Default)]
pub struct SequenceReport {
    /// Steps of all flows.
    pub steps: u32,
    /// Of each leg: RMS distance at its end in voxels, and whether it came as near as was asked.
    pub ends: Vec<(f64, bool)>,
    /// What the user should know.
    pub warnings: Vec<String>,
    /// The transformation of each leg that has one.
    pub poses: Vec<String>,
}

impl SequenceReport {
    /// For the report of the command.
    pub fn summary(&self) -> Summary {
        let arrived = self.ends.iter().all(|end| end.1);
        let reason = if arrived { "the target was reached" } else { "nothing came nearer any more" };
        let mut summary = Summary {
            steps: Some(self.steps),
            stopped_because: (!self.ends.is_empty()).then(|| reason.into()),
            warnings: self.warnings.clone(),
            ..Summary::default()
        };
        if !self.ends.is_empty() {
            let ends: Vec<f64> = self.ends.iter().map(|end| end.0).collect();
            summary.details.insert("end_rms_voxels".into(), json!(ends));
        }
        if !self.poses.is_empty() {
            summary.details.insert("transformations".into(), json!(self.poses));
        }
        summary
    }
}

/// What takes frames: the number of the place in the list, the surface, and what is told of it.
pub type TakeFrame<'a> = dyn FnMut(usize, LevelSet, FrameFacts) -> Result<()> + 'a;

/// A sequence that is planned: parts are matched, distances are known, nothing has moved yet.
pub struct Sequence<'a> {
    params: &'a Morph,
    run: &'a RunOptions,
    shapes: Vec<LevelSet>,
    legs: Vec<Prepared>,
    warnings: Vec<String>,
}

/// A leg before it is run.
struct Prepared {
    source: LevelSet,
    distance: TargetDistance,
    pose: Option<Pose>,
    buds: Vec<Bud>,
    /// RMS distance at its start, world units.
    rms: f64,
    volumes: [f64; 2],
}

impl<'a> Sequence<'a> {
    /// Plans a sequence through two or more shapes. What will not take part is among the [`warnings`](Self::warnings); `tell` gets each of these as soon as it is
    /// known: what shapes in other units ask for may take long.
    pub fn new(
        inputs: &[LevelSet],
        params: &'a Morph,
        run: &'a RunOptions,
        tell: &mut dyn FnMut(&str),
    ) -> Result<Self> {
        params.validate()?;
        let mut warnings = Vec::new();
        if let Some(n) = inputs.iter().position(LevelSet::is_empty) {
            return Err(EditError::parameter(NAME, "inputs", format!("shape {}", n + 1), "shapes that are not empty"));
        }
        let legs = inputs.len().saturating_sub(1);
        if legs == 0 {
            return Err(EditError::parameter(NAME, "inputs", inputs.len(), "two shapes or more"));
        }
        if legs > 1 && (params.transform.is_some() || params.landmarks.is_some()) {
            let accepted = "two shapes: a chain has several transformations; `align` finds one for each";
            return Err(EditError::parameter(NAME, "inputs", inputs.len(), accepted));
        }
        if params.frame_count as usize <= legs {
            let accepted = format!("{} or more, one for each shape", inputs.len());
            return Err(EditError::parameter(NAME, "frame_count", params.frame_count, accepted));
        }
        warnings.extend(other_units(inputs, run)?);
        warnings.iter().for_each(|warning| tell(warning));
        let told = warnings.len();
        let shapes = on_one_lattice(inputs, &mut warnings, run)?;
        let mut prepared = Vec::new();
        for n in 0..legs {
            prepared.push(prepare(&shapes[n], &shapes[n + 1], n, params, &mut warnings, run)?);
        }
        warnings.iter().skip(told).for_each(|warning| tell(warning));
        Ok(Self { params, run, shapes, legs: prepared, warnings })
    }

    /// What the user should know before it runs.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// The shapes, on the lattice of the first one.
    pub fn shapes(&self) -> &[LevelSet] {
        &self.shapes
    }

    /// Where points of its frames come from and where they go.
    pub fn ways(&self) -> Ways {
        let voxel_size = self.shapes.first().map_or(1.0, LevelSet::voxel_size);
        Ways { poses: self.legs.iter().map(|leg| leg.pose.clone()).collect(), voxel_size }
    }

    /// How long each leg is, in the quantity that frames are spaced by.
    fn lengths(&self) -> Vec<f64> {
        let length = |leg: &Prepared| match self.params.frame_spacing {
            FrameSpacing::Rms => leg.rms,
            FrameSpacing::Time => 1.0,
            FrameSpacing::Volume => (leg.volumes[1] - leg.volumes[0]).abs(),
        };
        let lengths: Vec<f64> = self.legs.iter().map(length).collect();
        // A leg without any length still has a frame.
        let least = 1e-9 + 1e-6 * lengths.iter().sum::<f64>();
        lengths.into_iter().map(|l| l.max(least)).collect()
    }

    /// The place of a part of the whole way.
    pub fn locate(&self, at: f64) -> Place {
        let lengths = self.lengths();
        let mut left = at.clamp(0.0, 1.0) * lengths.iter().sum::<f64>();
        for (leg, length) in lengths.iter().enumerate() {
            if left <= *length || leg + 1 == lengths.len() {
                return (leg, (left / length).clamp(0.0, 1.0));
            }
            left -= length;
        }
        (0, 0.0)
    }

    /// The places of the frames: each shape falls on one.
    pub fn places(&self) -> Vec<Place> {
        let (lengths, last) = (self.lengths(), self.params.frame_count as usize - 1);
        let total: f64 = lengths.iter().sum();
        let mut borders = vec![0];
        let mut gone = 0.0;
        for (n, length) in lengths.iter().enumerate() {
            gone += length;
            let later = lengths.len() - 1 - n;
            let border = (gone / total * last as f64).round() as usize;
            borders.push(border.clamp(borders[n] + 1, last - later));
        }
        let mut places = vec![(0, 0.0)];
        for (leg, pair) in borders.windows(2).enumerate() {
            let count = pair[1] - pair[0];
            places.extend((1..=count).map(|k| (leg, k as f64 / count as f64)));
        }
        places
    }

    /// Runs it, and hands over the frames at the places, which are in ascending order. Legs without one are left out.
    pub fn frames(mut self, places: &[Place], take: &mut TakeFrame) -> Result<SequenceReport> {
        let run = self.run;
        let mut report = SequenceReport { warnings: std::mem::take(&mut self.warnings), ..SequenceReport::default() };
        for (n, leg) in self.legs.into_iter().enumerate() {
            let here: Vec<(usize, f64)> =
                places.iter().enumerate().filter(|(_, place)| place.0 == n).map(|(at, place)| (at, place.1)).collect();
            let Some(&(first, _)) = here.first() else { continue };
            let voxel_size = leg.source.voxel_size();
            let whole = leg.distance.shared_volume(leg.distance.level_set());
            let measured = |level_set: LevelSet, place: f64, state: State, shared: f64| -> Result<_> {
                let facts = FrameFacts {
                    place: (n, place),
                    rms_voxels: state.rms / voxel_size,
                    shared_volume: shared / whole,
                    volume: level_set.measure(run)?.volume,
                    time: state.time,
                };
                Ok((level_set, facts))
            };
            if let Some(pose) = &leg.pose {
                report.poses.push(pose.describe());
            }
            let mut next = first;
            if here[0].1 == 0.0 {
                let state = State { rms: leg.rms, time: 0.0, steps: 0 };
                let shared = leg.distance.shared_volume(&leg.source);
                let (level_set, facts) = measured(self.shapes[n].clone(), 0.0, state, shared)?;
                take(next, level_set, facts)?;
                next += 1;
            }
            let between: Vec<f64> = here.iter().map(|place| place.1).filter(|p| *p > 0.0 && *p < 1.0).collect();
            let ends = here.iter().any(|place| place.1 >= 1.0);
            if between.is_empty() && !ends {
                continue;
            }
            let mut buds = Buds { list: leg.buds, volumes: leg.volumes, beta: 0.0 };
            let flow = self.params.leg(&leg.distance);
            let mut take_flow = |place: f64, level_set: LevelSet, state: State| {
                let shared = leg.distance.shared_volume(&level_set);
                let mut frame = buds.joined(&level_set, place, run)?;
                if let Some(pose) = &leg.pose {
                    frame = pose.posed(&frame, place, run)?;
                }
                let (frame, facts) = measured(frame, place, state, shared)?;
                take(next, frame, facts)?;
                next += 1;
                Ok(())
            };
            // A single place in a recipe needs the flow no further than there.
            let arrival = flow.flow(&leg.source, &between, ends, &mut take_flow, run)?;
            report.steps += arrival.state.steps;
            if ends {
                report.ends.push((arrival.state.rms / voxel_size, arrival.arrived));
                if !arrival.arrived {
                    report.warnings.push(format!(
                        "shape {} was approached to {:.3} voxels RMS, where the flow came to rest: the frame of the shape itself is a jump",
                        n + 2,
                        arrival.state.rms / voxel_size
                    ));
                }
                let state = State { rms: 0.0, ..arrival.state };
                let (level_set, facts) = measured(self.shapes[n + 1].clone(), 1.0, state, whole)?;
                take(next, level_set, facts)?;
            }
        }
        Ok(report)
    }
}

/// What is to be said of shapes whose sizes differ so much that one of them may be in other units.
fn other_units(inputs: &[LevelSet], run: &RunOptions) -> Result<Vec<String>> {
    let sizes: Vec<f64> = inputs.iter().map(|shape| Ok(shape.measure(run)?.volume.cbrt())).collect::<Result<_>>()?;
    let differ = |(n, pair): (usize, &[f64])| {
        let ratio = (pair[0] / pair[1]).max(pair[1] / pair[0]);
        (ratio > OTHER_UNITS).then(|| {
            format!(
                "shape {} and shape {} differ by a factor of {ratio:.0} in size: are they in the same units? `transform` scales them",
                n + 1,
                n + 2
            )
        })
    };
    Ok(sizes.windows(2).enumerate().filter_map(differ).collect())
}

/// All shapes on the lattice of the first.
fn on_one_lattice(inputs: &[LevelSet], warnings: &mut Vec<String>, run: &RunOptions) -> Result<Vec<LevelSet>> {
    let Some(first) = inputs.first() else { return Ok(Vec::new()) };
    let mut shapes = Vec::new();
    for (n, shape) in inputs.iter().enumerate() {
        let same = shape.transform() == first.transform() && shape.half_width() == first.half_width();
        shapes.push(match same {
            true => shape.clone(),
            false => {
                warnings.push(format!("shape {} was put on the lattice of the first one", n + 1));
                onto_lattice(shape, first.transform(), first.half_width(), run)?
            }
        });
        if shapes[n].is_empty() {
            let accepted = "shapes that are more than a voxel thick on the first one's lattice";
            return Err(EditError::parameter(NAME, "inputs", format!("shape {}", n + 1), accepted));
        }
    }
    Ok(shapes)
}

fn prepare(
    from: &LevelSet,
    to: &LevelSet,
    n: usize,
    params: &Morph,
    warnings: &mut Vec<String>,
    run: &RunOptions,
) -> Result<Prepared> {
    let names = [format!("shape {}", n + 1), format!("shape {}", n + 2)];
    let volumes = [from.measure(run)?.volume, to.measure(run)?.volume];
    if params.frame_spacing == FrameSpacing::Volume {
        leg::check_volumes(volumes[0], volumes[1])?;
    }
    let mut pose = params.pose(from, to, run)?;
    let posed = |pose: &Option<Pose>| match pose {
        Some(pose) => pose.unposed(to, from, run),
        None => Ok(to.clone()),
    };
    let mut target = posed(&pose)?;
    let mut overlap = Overlap::new(from, &target, run)?;
    if overlap.is_none() && params.bridge && pose.is_none() {
        // Nothing to grow out of: the whole shape moves.
        let meshes = (level_set_to_mesh(from, 0.0, run)?, level_set_to_mesh(to, 0.0, run)?);
        if let (Some(a), Some(b)) = (Moments::of(&meshes.0), Moments::of(&meshes.1)) {
            pose = Some(Pose::of_centres(&a, &b));
            target = posed(&pose)?;
            overlap = Overlap::new(from, &target, run)?;
            warnings.push(format!(
                "{} and {} do not overlap: the shape moves from one centre to the other",
                names[0], names[1]
            ));
        }
    }
    if overlap.is_none() {
        let accepted = match params.bridge {
            true => "shapes that overlap once their centres do; `transform` places them by hand",
            false => "shapes that overlap; `bridge`, `align moments` or `transform` bring them together",
        };
        return Err(EditError::parameter(
            NAME,
            "inputs",
            format!("{} and {}, which do not overlap", names[0], names[1]),
            accepted,
        ));
    }
    let (source, target, buds) = match params.bridge {
        true => overlap.bridged(from, &target, run)?,
        false => {
            warnings.extend(overlap.warnings([&names[0], &names[1]]));
            (from.clone(), target, Vec::new())
        }
    };
    let bounds = [&source, &target].into_iter().filter_map(|s| s.grid().active_bounds());
    let Some(bounds) = bounds.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))) else {
        return Err(EditError::parameter(NAME, "inputs", &names[1], "shapes that are not empty"));
    };
    let distance = TargetDistance::new(&target, bounds, run)?;
    let rms = params.leg(&distance).rms(&source, run)?;
    if rms < SAME * source.voxel_size() {
        warnings.push(format!("{} and {} are the same: so are all frames between them", names[0], names[1]));
    }
    Ok(Prepared { source, distance, pose, buds, rms, volumes })
}
