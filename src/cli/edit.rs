//! Running an operator: read, apply, verify, write, tell what changed.

use std::time::Instant;

use clap::ArgMatches;
use glam::DVec3;
use serde_json::{Map, Value, json};

use super::context::Context;
use super::preview::Preview;
use super::{args, files, options, table};
use crate::error::Result;
use crate::files::input::{self, Input};
use crate::files::output::{self, Output, Written};
use crate::files::volume;
use crate::levelset::{LevelSet, Measures};
use crate::mesh::transfer_attributes;
use crate::ops::compare::changed_voxels;
use crate::ops::{Arity, Entry, Outcome, Summary};

/// Runs an operator as its command asks.
pub fn run(entry: &Entry, matches: &ArgMatches, context: &Context) -> Result<()> {
    let began = Instant::now();
    let values = options::collect(entry, matches);
    entry.check(values.clone())?;
    let paths = args::paths(matches, "input");
    let input_options = files::input_options(matches)?;
    let output = files::output(matches, context)?;
    let preview = Preview::plan(matches)?;
    if args::flag(matches, "dry-run") {
        return dry_run(entry.name, values, &input::probe(&paths, &input_options)?, &output, context);
    }
    let mut warnings = Vec::new();
    let mut inputs = match entry.arity {
        Arity::Source => Vec::new(),
        Arity::One | Arity::Many => input::load(&paths, &input_options, &mut warnings, &context.run)?,
        Arity::BaseAndSolid => input::load_apart(&paths, &input_options, &mut warnings, &context.run)?,
    };
    let released = match (&mut inputs[..], entry.arity) {
        ([input], Arity::One) if !preview.is_wanted() && input.level_set.grid().bytes() > MOST_KEPT => {
            let measures = input.level_set.measure(&context.run)?;
            volume::trim_heap();
            Some((measures, input.release()))
        }
        _ => None,
    };
    let (measured_before, level_sets) = match released {
        Some((measures, level_set)) => (Some(measures), vec![level_set]),
        None => (None, inputs.iter().map(|input| input.level_set.clone()).collect()),
    };
    let Outcome { level_set, mut summary } = entry.run(values, level_sets, &context.run)?;
    warnings.append(&mut summary.warnings);
    summary.warnings = warnings;
    let edit = Edit { operation: entry.name, inputs, measured_before, level_set, summary, iso: 0.0, began };
    edit.finish(&output, &preview, args::flag(matches, "check"), context)
}

/// Bytes of an input that is kept beside its result to count the voxels that changed. Of larger ones the operator has the only copy: that
/// takes a third off what an edit of the whole surface holds. With grids of that size, memory that was freed is given back to the system in between.
const MOST_KEPT: u64 = 1 << 30;

/// Says what would be done.
pub fn dry_run(
    operation: &str,
    values: Map<String, Value>,
    inputs: &[String],
    output: &Output,
    context: &Context,
) -> Result<()> {
    let path = output.path.display().to_string();
    let value = json!({
        "dry_run": true, "operation": operation, "parameters": values, "inputs": inputs, "output": path,
    });
    context.reporter.result(&value, || {
        let inputs: String = inputs.iter().map(|line| format!("  reads {line}\n")).collect();
        let values: String = values.iter().map(|(name, value)| format!("  {name} = {value}\n")).collect();
        let verb = if output.path.exists() { "would replace" } else { "would write" };
        format!("{operation} would run; nothing is written\n{values}{inputs}  {verb} {path}\n")
    })
}

/// An edit that was computed and is not yet written.
pub struct Edit {
    /// What was done.
    pub operation: &'static str,
    /// To what; the first one counts as "before".
    pub inputs: Vec<Input>,
    /// The measures of "before" if it was too large to be kept.
    pub measured_before: Option<Measures>,
    /// The result.
    pub level_set: LevelSet,
    /// What the operator has to say.
    pub summary: Summary,
    /// The surface that a mesh is made of.
    pub iso: f32,
    /// When the command began.
    pub began: Instant,
}

impl Edit {
    /// What the result is compared with: the first input, but for a conversion only if it was a level set already.
    fn before(&self) -> Option<&LevelSet> {
        let input = self.inputs.first().filter(|_| self.measured_before.is_none())?;
        (self.converts_nothing() || input.from().is_some_and(|(_, index)| index.is_some())).then_some(&input.level_set)
    }

    /// Frees the voxels of the inputs. Of large grids they would take half as much as writing the result and verifying it does.
    fn release_inputs(&mut self) {
        self.inputs.iter_mut().for_each(|input| drop(input.release()));
    }

    /// Gives back to the system what the operator or the inputs held, if the grids are so large that it matters.
    fn trim_heap(&self) {
        if self.level_set.grid().bytes() > MOST_KEPT {
            volume::trim_heap();
        }
    }

    fn converts_nothing(&self) -> bool {
        self.operation != super::convert::VERB.name
    }

    /// Verifies, draws and writes the result, then tells what changed.
    pub fn finish(mut self, output: &Output, preview: &Preview, check: bool, context: &Context) -> Result<()> {
        self.trim_heap();
        let before = self.before();
        let facts = Facts {
            before: before.map(|level_set| level_set.measure(&context.run)).transpose()?.or(self.measured_before),
            after: self.level_set.measure(&context.run)?,
            voxels_changed: self.measured_before.is_none().then(|| changed_voxels(before, &self.level_set)),
        };
        if check {
            output::verify(self.operation, &self.level_set)?;
        }
        preview.write(before, &self.level_set, context)?;
        self.release_inputs();
        self.trim_heap();
        let from = self.inputs.iter().find_map(Input::from);
        let Written { bytes, warnings, details } = match &self.summary.colored {
            Some(mesh) => {
                let colors =
                    |xyz: &[DVec3]| Ok(transfer_attributes(mesh, xyz, &context.run)?.colors.unwrap_or_default());
                output.write_colored(&self.level_set, from, &colors, &context.run)?
            }
            None => output.write(&self.level_set, self.iso, from, &context.run)?,
        };
        let mut summary = self.summary.clone();
        let lost = |input: &Input| output.mesh().loss(&input.path, input.attributes?, &output.path);
        summary.warnings.extend(self.inputs.iter().filter_map(lost));
        summary.warnings.extend(warnings);
        summary.details.extend(details);
        for warning in &summary.warnings {
            context.reporter.warn(warning);
        }
        let report = Report { edit: &self, facts: &facts, summary: &summary, bytes, output };
        if output.is_pipe() {
            context.reporter.result_beside_output(|| report.text());
            return Ok(());
        }
        context.reporter.result(&report.json(), || report.text())
    }
}

struct Facts {
    before: Option<Measures>,
    after: Measures,
    /// `None` if the input was not kept.
    voxels_changed: Option<u64>,
}

/// What is told of an edit.
struct Report<'a> {
    edit: &'a Edit,
    facts: &'a Facts,
    summary: &'a Summary,
    bytes: Option<u64>,
    output: &'a Output,
}

impl Report<'_> {
    fn json(&self) -> Value {
        let Self { edit, facts, summary, bytes, output } = self;
        let Facts { before, after, voxels_changed } = facts;
        let inputs: Vec<String> = edit.inputs.iter().map(|input| input.path.display().to_string()).collect();
        let bounds = edit.level_set.world_bounds().map(|(lo, hi)| [lo.to_array(), hi.to_array()]);
        let mut object = json!({
            "operation": edit.operation,
            "inputs": inputs,
            "output": output.path.display().to_string(),
            "bytes": bytes,
            "seconds": edit.began.elapsed().as_secs_f64(),
            "steps": summary.steps,
            "stopped_because": summary.stopped_because,
            "voxels_changed": voxels_changed,
            "active_voxels": edit.level_set.grid().active_voxels(),
            "voxel_size": edit.level_set.voxel_size(),
            "half_width": edit.level_set.half_width(),
            "bbox_world": bounds,
            "volume_before": before.map(|m| m.volume),
            "volume_after": after.volume,
            "area_before": before.map(|m| m.area),
            "area_after": after.area,
            "components_before": before.map(|m| m.components),
            "components_after": after.components,
            "warnings": summary.warnings,
        });
        if let Some(object) = object.as_object_mut() {
            for (name, value) in &summary.details {
                object.entry(name.clone()).or_insert_with(|| value.clone());
            }
        }
        object
    }

    fn text(&self) -> String {
        let Self { edit, facts, summary, bytes, output } = self;
        let Facts { before, after, voxels_changed } = facts;
        let size = bytes.map(|bytes| format!(", {}", super::size::shown(bytes))).unwrap_or_default();
        let mut text = format!(
            "{}: {} in {:.2} s{size}\n",
            output.path.display(),
            edit.operation,
            edit.began.elapsed().as_secs_f64()
        );
        // A conversion that changed nothing needs no second column.
        let before = before.as_ref().filter(|before| *voxels_changed != Some(0) || *before != after);
        let row = |name: &str, of: fn(&Measures) -> f64| {
            let mut row = vec![name.to_owned()];
            row.extend(before.map(|before| table::number(of(before))));
            row.push(table::number(of(after)));
            row.extend(before.map(|before| table::change(of(before), of(after))));
            row
        };
        let whole = |name: &str, of: fn(&Measures) -> i64| {
            let mut row = vec![name.to_owned()];
            row.extend(before.map(|before| of(before).to_string()));
            row.push(of(after).to_string());
            row
        };
        let heading = before.map(|_| ["", "before", "after", "change"].map(str::to_owned).to_vec());
        let rows = [
            row("volume (world units³)", |m| m.volume),
            row("area (world units²)", |m| m.area),
            whole("components", |m| m.components as i64),
            whole("Euler number", |m| m.euler),
        ];
        text += &table::columns(heading.into_iter().chain(rows));
        let changed = match (facts.before, voxels_changed) {
            // Made of a mesh, or of nothing: all of it is new.
            (None, _) => String::new(),
            (Some(_), None) => "changed voxels not counted, as the input was too large to be kept; ".into(),
            (Some(_), Some(0)) => "no voxel changed; ".into(),
            (Some(_), Some(n)) => format!("{} voxels changed; ", table::count(*n)),
        };
        text += &format!(
            "  {changed}{} active voxels of {} world units\n",
            table::count(edit.level_set.grid().active_voxels()),
            table::number(edit.level_set.voxel_size())
        );
        if let Some(steps) = summary.steps {
            let reason = summary.stopped_because.as_ref().map(|reason| format!(": {reason}")).unwrap_or_default();
            let plural = if steps == 1 { "" } else { "s" };
            text += &format!("  {steps} step{plural}{reason}\n");
        }
        // Lists are for programs.
        for (name, value) in summary.details.iter().filter(|(_, value)| !value.is_array()) {
            text += &format!("  {}: {}\n", name.replace('_', " "), table::value(value));
        }
        text
    }
}
