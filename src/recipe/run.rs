//! Running a plan: results in memory until their last use, files at the end.

use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Instant;

use serde::Serialize;
use serde_json::{Value, json};

use super::plan::{Action, Given, Plan, Planned};
use super::results::{Identity, Key, LastOutput, Results, Stamp};
use super::step::Conversion;
use crate::atomic::{Staging, write_atomically};
use crate::error::{EditError, Result};
use crate::files::input::{self, InputOptions};
use crate::files::output::{self, Output};
use crate::files::volume::Volume;
use crate::levelset::{DEFAULT_HALF_WIDTH, LevelSet};
use crate::mesh::{Rebuild, rebuild};
use crate::ops::{Outcome, Summary, VoxelLength, WorldLength};
use crate::render::{Image, Redraw};
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
    /// Whether it did not run, since its result was there.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub kept: bool,
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
pub(super) struct Slot {
    pub level_set: LevelSet,
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
    /// What earlier runs have made.
    results: Option<&'a mut Results>,
    run: &'a RunOptions,
}

impl Plan<'_> {
    /// Computes all steps, then lets the files appear. `warn` is told what the user should know as soon as it is known.
    pub fn run(&self, run: &RunOptions, warn: &mut dyn FnMut(&str)) -> Result<FrameReport> {
        self.run_steps(None, run, warn)
    }

    /// As [`run`](Self::run), but only of steps whose results are not in `results`, to which they are added. Pictures are drawn first
    /// and appear at once, coarse ones before them; other files appear when all steps have succeeded.
    pub fn rerun(&self, results: &mut Results, run: &RunOptions, warn: &mut dyn FnMut(&str)) -> Result<FrameReport> {
        self.run_steps(Some(results), run, warn)
    }

    fn run_steps(
        &self,
        mut results: Option<&mut Results>,
        run: &RunOptions,
        warn: &mut dyn FnMut(&str),
    ) -> Result<FrameReport> {
        let began = Instant::now();
        let steps = &self.recipe.steps;
        let (mut reports, mut slots) = (vec![None; steps.len()], vec![None; steps.len()]);
        let mut order: Vec<usize> = (0..steps.len()).collect();
        let mut known = Vec::new();
        if let Some(results) = results.as_deref_mut() {
            order.sort_by_key(|&n| matches!(self.steps[n].action, Action::Write(_)));
            known = self.identities(results);
            self.take_kept(results, &known, &mut slots, &mut reports);
        }
        let uses = steps.iter().map(|step| step.uses).collect();
        let check = self.recipe.check;
        let mut running = Running { slots, uses, staging: Staging::default(), check, results, run };
        let mut written = Vec::new();
        for n in order {
            let (step, planned) = (&steps[n], &self.steps[n]);
            run.check("run")?;
            if reports[n].is_some() {
                continue;
            }
            let began = Instant::now();
            let (slot, summary) = running.step(planned).map_err(|error| error.at(&planned.place))?;
            summary.warnings.iter().for_each(|warning| warn(&format!("{}: {warning}", planned.place)));
            let report = StepReport {
                op: step.op.name(),
                name: step.name.clone(),
                line: step.line,
                seconds: began.elapsed().as_secs_f64(),
                kept: false,
                active_voxels: slot.as_ref().map(|slot| slot.level_set.grid().active_voxels()),
                output: planned.output(),
                summary,
            };
            match &planned.action {
                Action::Write(_) => written.push(n),
                _ => running.keep(planned, known.get(n), slot.as_ref(), &report),
            }
            running.slots[n] = slot;
            reports[n] = Some(report);
        }
        run.check("run")?;
        std::mem::take(&mut running.staging).commit()?;
        for n in written {
            // What it wrote is there only now.
            if let Some(report) = &reports[n] {
                running.keep(&self.steps[n], known.get(n), None, report);
            }
        }
        let seconds = began.elapsed().as_secs_f64();
        let steps = reports.into_iter().flatten().collect();
        Ok(FrameReport { frame: self.frame(), seconds, steps, outputs: self.outputs().to_vec() })
    }

    /// What stands for each step.
    fn identities(&self, results: &mut Results) -> Vec<Identity> {
        let mut known: Vec<Identity> = Vec::new();
        for (step, planned) in self.recipe.steps.iter().zip(&self.steps) {
            let (mut steps, mut files) = (Vec::new(), Vec::new());
            let mut file = |path: &PathBuf| files.push((path.clone(), Stamp::of(path)));
            for given in &planned.inputs {
                match given {
                    Given::Step(index) => steps.push(known[*index]),
                    // Its place among the inputs is part of what is asked.
                    Given::File(path) => {
                        steps.push(0);
                        file(path);
                    }
                }
            }
            steps.extend(planned.after.iter().map(|index| known[*index]));
            planned.reads.iter().for_each(file);
            let what = format!("{} {} {}", step.op.name(), Value::from(planned.values.clone()), self.recipe.check);
            known.push(results.identity(Key { what, steps, files }));
        }
        known
    }

    /// Takes what need not run.
    fn take_kept(
        &self,
        results: &mut Results,
        known: &[Identity],
        slots: &mut [Option<Slot>],
        reports: &mut [Option<StepReport>],
    ) {
        for (n, planned) in self.steps.iter().enumerate() {
            if let Some(made) = results.get(known[n]) {
                slots[n] = made.slot.clone();
                reports[n] = Some(StepReport { kept: true, seconds: 0.0, ..made.report.clone() });
            }
            match &planned.action {
                Action::Render(picture) => results.keep_last(Path::new(&picture.path)),
                Action::Write(target) => results.keep_last(Path::new(&target.path)),
                _ => {}
            }
        }
    }
}

impl Running<'_> {
    /// Adds what a step has made to the results.
    fn keep(&mut self, planned: &Planned, known: Option<&Identity>, slot: Option<&Slot>, report: &StepReport) {
        if let (Some(results), Some(known)) = (self.results.as_deref_mut(), known) {
            let files: Vec<PathBuf> = planned.writes.iter().cloned().chain(planned.output()).collect();
            results.keep(*known, slot, report, &files);
        }
    }

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
                    let written = match &mut self.results {
                        Some(results) if output.is_mesh() => results.with_last(path, |last| {
                            let last = &mut last.mesh;
                            let written = output.write_again(&slot.level_set, 0.0, from, Some(&mut *last), self.run);
                            // Quads are made as a whole.
                            if !last.is_empty() {
                                summary.details.insert("leaves_polygonised".into(), json!(last.made()));
                            }
                            written
                        }),
                        _ => output.write(&slot.level_set, 0.0, from, self.run),
                    };
                    let written = written.map_err(|error| match error {
                        EditError::Output { problem, .. } => EditError::output(path, problem),
                        error => error,
                    })?;
                    let lost = slot.attributes.iter().filter_map(|(mesh, what)| output.mesh().loss(mesh, what, path));
                    summary.warnings.extend(lost);
                    summary.warnings.extend(written.warnings);
                    summary.details.extend(written.details);
                    summary.details.insert("bytes".into(), json!(written.bytes));
                }
                (None, summary)
            }
            Action::Render(picture) => {
                let inputs = self.take(planned, false, &mut warnings)?;
                let level_sets: Vec<LevelSet> = inputs.into_iter().map(|slot| slot.level_set).collect();
                let path = Path::new(&picture.path);
                let write = |path: &Path, image: &Image| write_atomically(path, |out| image.write_png(out));
                let mut drawn = None;
                let image = match &mut self.results {
                    None => {
                        let image = picture.draw(&level_sets, self.run)?;
                        write(&self.staging.place(path)?, &image)?;
                        image
                    }
                    Some(results) => {
                        let draw = |last: &mut LastOutput| {
                            let last = &mut last.pictures;
                            let coarse = &mut |image: &Image| write(path, image);
                            let image = picture.draw_again(&level_sets, last, coarse, self.run)?;
                            drawn = Some(last.iter().map(Redraw::drawn).sum::<usize>());
                            Ok::<_, EditError>(image)
                        };
                        let image = results.with_last(path, draw)?;
                        write(path, &image)?;
                        image
                    }
                };
                let mut summary = Summary::default();
                summary.details.insert("width".into(), Value::from(image.width));
                summary.details.insert("height".into(), Value::from(image.height));
                if let Some(drawn) = drawn {
                    summary.details.insert("pixels_drawn".into(), json!(drawn));
                }
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
