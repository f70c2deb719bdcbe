//! Running a plan: results in memory until their last use, files at the end.

use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Instant;

use serde::Serialize;
use serde_json::{Value, json};

use super::plan::{Action, Given, Plan, Planned};
use super::step::Conversion;
use crate::atomic::{Staging, write_atomically};
use crate::error::{EditError, Result};
use crate::files::input::{self, InputOptions};
use crate::files::output::{self, Output};
use crate::files::volume::Volume;
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet};
use crate::mesh::{Rebuild, rebuild};
use crate::ops::{Outcome, Summary, VoxelLength, WorldLength};
use crate::run::RunOptions;
use crate::scan::Inside;

/// What a step did.
#[derive(Clone, Debug, Serialize)]
pub struct StepReport {
    /// Its operator.
    pub op: &'static str,
    /// Its name.
    pub name: Option<String>,
    /// Where it is in the recipe.
    pub line: usize,
    /// How long it took.
    pub seconds: f64,
    /// Active voxels of its result.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub active_voxels: Option<u64>,
    /// The file that it writes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub output: Option<PathBuf>,
    /// What it has to say.
    #[serde(flatten)]
    pub summary: Summary,
}

/// What a frame did.
#[derive(Clone, Debug, Serialize)]
pub struct FrameReport {
    /// Its number.
    pub frame: i64,
    /// How long it took.
    pub seconds: f64,
    /// Its steps.
    pub steps: Vec<StepReport>,
    /// The files that were written.
    pub outputs: Vec<PathBuf>,
}

/// A result that is still needed.
#[derive(Clone)]
struct Slot {
    level_set: LevelSet,
    /// The file that a `.vdb` made of it carries over, and the grid whose place it takes.
    source: Option<Rc<(Volume, Option<usize>)>>,
    /// What meshes that went into it carried, which a level set does not.
    attributes: Vec<(PathBuf, &'static str)>,
    /// Whether it was a mesh file a moment ago.
    is_mesh: bool,
}

/// The state of a run.
struct Running<'a> {
    slots: Vec<Option<Slot>>,
    /// How often each will still be taken.
    uses: Vec<usize>,
    staging: Staging,
    /// Whether what is written is verified first.
    check: bool,
    run: &'a RunOptions,
}

impl Plan<'_> {
    /// Computes all steps, then lets the files appear. `warn` is told what the user should know as soon as it is known.
    pub fn run(&self, run: &RunOptions, warn: &mut dyn FnMut(&str)) -> Result<FrameReport> {
        let began = Instant::now();
        let uses = self.recipe.steps.iter().map(|step| step.uses).collect();
        let check = self.recipe.check;
        let mut running = Running { slots: Vec::new(), uses, staging: Staging::default(), check, run };
        let mut reports = Vec::new();
        for (step, planned) in self.recipe.steps.iter().zip(&self.steps) {
            run.check("run")?;
            let began = Instant::now();
            let (slot, summary) = running.step(planned).map_err(|error| error.at(&planned.place))?;
            summary.warnings.iter().for_each(|warning| warn(&format!("{}: {warning}", planned.place)));
            let output = match &planned.action {
                Action::Write(target) => Some(target.path.clone().into()),
                Action::Render(picture) => Some(picture.path.clone().into()),
                _ => None,
            };
            reports.push(StepReport {
                op: step.op.name(),
                name: step.name.clone(),
                line: step.line,
                seconds: began.elapsed().as_secs_f64(),
                active_voxels: slot.as_ref().map(|slot| slot.level_set.grid().active_voxels()),
                output,
                summary,
            });
            running.slots.push(slot);
        }
        run.check("run")?;
        running.staging.commit()?;
        let seconds = began.elapsed().as_secs_f64();
        Ok(FrameReport { frame: self.frame(), seconds, steps: reports, outputs: self.outputs().to_vec() })
    }
}

impl Running<'_> {
    fn step(&mut self, planned: &Planned) -> Result<(Option<Slot>, Summary)> {
        let mut warnings = Vec::new();
        let (result, mut summary) = match &planned.action {
            Action::Convert(conversion) => {
                (self.convert(planned, conversion, &mut warnings)?.into(), Summary::default())
            }
            Action::Operator(entry, values) => {
                let inputs = self.take(planned, true, &mut warnings)?;
                // As a command would: the first `.vdb` is the one to be carried over, and what a step made would have been one.
                let source = inputs.iter().find(|slot| !slot.is_mesh).and_then(|slot| slot.source.clone());
                let mut attributes: Vec<_> = inputs.iter().flat_map(|slot| slot.attributes.clone()).collect();
                attributes.sort();
                attributes.dedup();
                let level_sets = inputs.into_iter().map(|slot| slot.level_set).collect();
                let Outcome { level_set, summary } = entry.run(values.clone(), level_sets, self.run)?;
                (Some(Slot { level_set, source, attributes, is_mesh: false }), summary)
            }
            Action::Assert(assertions) => {
                let inputs = self.take(planned, false, &mut warnings)?;
                let mut summary = Summary::default();
                for slot in &inputs {
                    summary.details = assertions.verify(&slot.level_set, self.run)?;
                }
                (None, summary)
            }
            Action::Write(target) => {
                let inputs = self.take(planned, false, &mut warnings)?;
                let path = Path::new(&target.path);
                let place = self.staging.place(path)?;
                let output = Output::plan(place.clone(), target.volume(), &target.mesh())?;
                let mut summary = Summary::default();
                for slot in &inputs {
                    if self.check {
                        output::verify("write", &slot.level_set)?;
                    }
                    let from = slot.source.as_ref().map(|source| (&source.0, source.1));
                    let written = output.write(&slot.level_set, 0.0, from, self.run).map_err(|error| match error {
                        EditError::Output { problem, .. } => EditError::output(path, problem),
                        error => error,
                    })?;
                    let lost = slot.attributes.iter().filter_map(|(mesh, what)| output.mesh().loss(mesh, what, path));
                    summary.warnings.extend(lost);
                    summary.warnings.extend(written.warnings);
                    summary.details = written.details;
                    summary.details.insert("bytes".into(), json!(written.bytes));
                }
                (None, summary)
            }
            Action::Render(picture) => {
                let inputs = self.take(planned, false, &mut warnings)?;
                let level_sets: Vec<LevelSet> = inputs.into_iter().map(|slot| slot.level_set).collect();
                let image = picture.draw(&level_sets, self.run)?;
                let place = self.staging.place(Path::new(&picture.path))?;
                write_atomically(&place, |out| image.write_png(out))?;
                let mut summary = Summary::default();
                summary.details.insert("width".into(), Value::from(image.width));
                summary.details.insert("height".into(), Value::from(image.height));
                (None, summary)
            }
        };
        warnings.append(&mut summary.warnings);
        summary.warnings = warnings;
        Ok((result, summary))
    }

    /// The inputs of a step; a result that nobody needs afterwards is given away, others are shared.
    fn take(&mut self, planned: &Planned, to_edit: bool, warnings: &mut Vec<String>) -> Result<Vec<Slot>> {
        let mut taken: Vec<Option<Slot>> = Vec::new();
        let mut files = Vec::new();
        for given in &planned.inputs {
            taken.push(match given {
                Given::File(path) => {
                    files.push(path.clone());
                    None
                }
                Given::Step(index) => {
                    self.uses[*index] -= 1;
                    let last = self.uses[*index] == 0;
                    let slot = if last { self.slots[*index].take() } else { self.slots[*index].clone() };
                    // A slot is there as long as it has uses left.
                    let mut slot = slot.ok_or_else(|| EditError::parameter("run", "input", index, "a result"))?;
                    if to_edit {
                        slot.level_set = input::wide_enough("input", slot.level_set, warnings, self.run)?;
                    }
                    Some(slot)
                }
            });
        }
        if files.is_empty() {
            return Ok(taken.into_iter().flatten().collect());
        }
        let loaded = if planned.takes_solids_apart() {
            input::load_apart(&files, &InputOptions::default(), warnings, self.run)?
        } else {
            input::load(&files, &beside(planned, &taken), warnings, self.run)?
        };
        let mut loaded = loaded.into_iter().map(Slot::from);
        Ok(taken.into_iter().filter_map(|slot| slot.or_else(|| loaded.next())).collect())
    }

    fn convert(&self, planned: &Planned, conversion: &Conversion, warnings: &mut Vec<String>) -> Result<Slot> {
        let [Given::File(path)] = &planned.inputs[..] else {
            return Err(EditError::parameter("convert", "input", "", "one file"));
        };
        let options = conversion.options();
        let inside = if conversion.invert { Inside::Below } else { Inside::Above };
        let bare = |iso: WorldLength| iso.to_string().parse::<f32>().ok();
        if let Some(iso) = conversion.iso.and_then(bare)
            && let Some(input) = input::load_iso(path, &options, iso, inside, warnings, self.run)?
        {
            return Ok(input.into());
        }
        if conversion.invert {
            let accepted = "a volume or scan and `iso`: of other inputs nothing is turned inside out";
            return Err(EditError::parameter("convert", "invert", true, accepted));
        }
        let inputs = input::load(std::slice::from_ref(path), &options, warnings, self.run)?;
        let mut slot = inputs.into_iter().map(Slot::from).next();
        if let (Some(iso), Some(slot)) = (conversion.iso, &mut slot) {
            let iso = iso.world(slot.level_set.voxel_size()) as f32;
            let what = Rebuild { iso, ..Rebuild::band(slot.level_set.half_width()) };
            slot.level_set = rebuild(&slot.level_set, &what, self.run)?;
        }
        let mut slot = slot.ok_or_else(|| EditError::input(path, "holds nothing"))?;
        // A converted mesh counts as a file of its own from here on.
        slot.is_mesh = false;
        Ok(slot)
    }
}

impl From<input::Input> for Slot {
    fn from(input: input::Input) -> Self {
        let is_mesh = input.source.is_none();
        let attributes = input.attributes.map(|what| (input.path, what)).into_iter().collect();
        Self { level_set: input.level_set, source: input.source.map(Rc::new), attributes, is_mesh }
    }
}

/// How the files of a step are read: meshes get the voxels of the first input that is none, as they would if the results of steps
/// were files.
fn beside(planned: &Planned, taken: &[Option<Slot>]) -> InputOptions {
    let is_volume = |(given, slot): &(&Given, &Option<Slot>)| match given {
        Given::File(path) => input::is_volume(path),
        Given::Step(_) => slot.is_some(),
    };
    let first = planned.inputs.iter().zip(taken).find(is_volume);
    let Some((_, Some(Slot { level_set, .. }))) = first else { return InputOptions::default() };
    InputOptions {
        voxel_size: Some(WorldLength::new(level_set.voxel_size())),
        half_width: Some(VoxelLength::new(level_set.half_width().max(DEFAULT_HALF_WIDTH).into())),
        ..InputOptions::default()
    }
}
