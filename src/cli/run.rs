//! `run`: a recipe, once, for a list of frames, or again whenever its files change. `schema`: what a recipe may hold.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::builder::ValueParser;
use clap::{Arg, ArgAction, ArgMatches, Command};
use serde_json::{Value, json};

use super::context::Context;
use super::{Verb, args, report, size, table};
use crate::error::{EditError, Result};
use crate::recipe::{FrameReport, Plan, Recipe, Results, Stamp, StepReport, parse_frames, schema};

/// The command.
pub const VERB: Verb = Verb { name: "run", build, run };

/// What a recipe may hold.
pub const SCHEMA: Verb = Verb { name: "schema", build: build_schema, run: print_schema };

/// How often `--watch` looks.
const POLL: Duration = Duration::from_millis(20);

/// Part of the memory limit that results may take that are kept for the next run.
const KEPT: u64 = 2;

fn build(command: Command) -> Command {
    command
        .about("Run a recipe: a whole editing session in one process")
        .long_about(
            "Run a recipe: a whole editing session in one process.\n\n\
             The whole recipe is checked before the first step runs, for all frames; results stay in memory until their last use, and \
             files appear when all steps of a frame have succeeded. Paths in a recipe are relative to it.",
        )
        .arg(args::path("recipe").value_name("RECIPE.toml").required(true).help("The recipe"))
        .arg(
            Arg::new("set")
                .long("set")
                .value_name("NAME=VALUE")
                .action(ArgAction::Append)
                .value_parser(ValueParser::new(assignment))
                .help("Another value for a variable of the recipe's table [set]"),
        )
        .arg(
            Arg::new("frames")
                .long("frames")
                .value_name("LIST")
                .value_parser(ValueParser::new(|text: &str| parse_frames(text).map(Frames)))
                .help("Frames: 1-100, 1-100x5 or 1,3,7-9; each is one evaluation of the whole recipe [default: 1]"),
        )
        .arg(
            Arg::new("skip-existing")
                .long("skip-existing")
                .action(ArgAction::SetTrue)
                .help("Leave out frames whose files are all there"),
        )
        .arg(
            Arg::new("watch")
                .long("watch")
                .action(ArgAction::SetTrue)
                .conflicts_with_all(["json", "dry-run"])
                .help(
                    "Run again whenever the recipe or one of its input files changes, until cancelled: only the steps that the change affects; \
                     pictures appear first, large changes in a quarter of the resolution before the whole",
                ),
        )
        .arg(
            args::path("output")
                .long("output")
                .short('o')
                .value_name("FOLDER")
                .help("Where relative paths of `write` and `render` begin [default: the recipe's folder]"),
        )
        .arg(
            Arg::new("check")
                .long("check")
                .action(ArgAction::SetTrue)
                .help("Verify the invariants of what is written; write nothing and exit with 1 if one does not hold"),
        )
        .arg(
            Arg::new("dry-run")
                .long("dry-run")
                .action(ArgAction::SetTrue)
                .help("Check the recipe and say what would be done; write nothing"),
        )
}

fn build_schema(command: Command) -> Command {
    command.about("Print the JSON schema of recipes")
}

fn print_schema(_: &ArgMatches, _: &Context) -> Result<()> {
    report::print(&format!("{:#}\n", schema()))
}

#[derive(Clone)]
struct Frames(Vec<i64>);

fn assignment(text: &str) -> std::result::Result<(String, String), String> {
    let (name, value) = text.split_once('=').ok_or("a variable of [set] and its value are wanted: NAME=VALUE")?;
    Ok((name.trim().into(), value.into()))
}

fn run(matches: &ArgMatches, context: &Context) -> Result<()> {
    let job = Job {
        path: args::paths(matches, "recipe").pop().unwrap_or_default(),
        set: matches.get_many("set").map(|set| set.cloned().collect()).unwrap_or_default(),
        frames: matches.get_one::<Frames>("frames").map(|frames| frames.0.clone()).unwrap_or_default(),
        skip_existing: args::flag(matches, "skip-existing"),
        output_folder: args::paths(matches, "output").pop(),
        check: args::flag(matches, "check"),
        dry_run: args::flag(matches, "dry-run"),
        context,
    };
    if !args::flag(matches, "watch") {
        return job.once(&mut Vec::new(), None);
    }
    let mut results = Results::within(context.run.memory_limit.map(|limit| limit / KEPT));
    loop {
        let mut watched = vec![job.path.clone()];
        let before = stamps(&watched);
        match job.once(&mut watched, Some(&mut results)) {
            Err(error @ EditError::Cancelled { .. }) => return Err(error),
            Err(error) => context.reporter.error(&error, error.exit_code()),
            Ok(()) => results.forget_unused(),
        }
        context.reporter.text(|| format!("watching {} and what it reads\n", job.path.display()));
        // The recipe may have changed while it ran; of its inputs this would be seen at the next change only.
        let mut seen = stamps(&watched);
        if let (Some(seen), Some(before)) = (seen.first_mut(), before.first()) {
            *seen = *before;
        }
        // A file that is being written is not yet what is meant: until nothing changes any more.
        let mut last = stamps(&watched);
        loop {
            context.run.check("watching")?;
            std::thread::sleep(POLL);
            let now = stamps(&watched);
            if now == last && now != seen {
                break;
            }
            last = now;
        }
    }
}

fn stamps(paths: &[PathBuf]) -> Vec<Stamp> {
    paths.iter().map(|path| Stamp::of(path)).collect()
}

/// What is to be run.
struct Job<'a> {
    path: PathBuf,
    set: Vec<(String, String)>,
    frames: Vec<i64>,
    skip_existing: bool,
    output_folder: Option<PathBuf>,
    check: bool,
    dry_run: bool,
    context: &'a Context,
}

impl Job<'_> {
    /// Runs all frames, of their steps only those whose results are not kept; the files that they read go to `watched`.
    fn once(&self, watched: &mut Vec<PathBuf>, mut results: Option<&mut Results>) -> Result<()> {
        let began = Instant::now();
        let mut recipe = Recipe::read(&self.path)?;
        if let Some(folder) = &self.output_folder {
            recipe.set_output_folder(folder.clone());
        }
        if self.check {
            recipe.check_outputs();
        }
        for (name, value) in &self.set {
            recipe.set(name, value)?;
        }
        let plans = recipe.plan(&self.frames)?;
        watched.extend(plans.iter().flat_map(Plan::files).cloned());
        watched.retain(|file| !plans.iter().any(|plan| plan.outputs().contains(file)));
        if self.dry_run {
            return self.describe(&plans);
        }
        let several = plans.len() > 1;
        let task = several.then(|| self.context.run.task("frames", plans.len() as u64));
        let mut frames: Vec<Value> = Vec::new();
        let mut warnings: Vec<String> = Vec::new();
        for plan in &plans {
            let is_there =
                self.skip_existing && !plan.outputs().is_empty() && plan.outputs().iter().all(|p| p.exists());
            if is_there {
                frames.push(json!({ "frame": plan.frame(), "skipped": true, "outputs": plan.outputs() }));
                self.context.reporter.text(|| format!("frame {}: skipped, its files are there\n", plan.frame()));
            } else {
                let reporter = &self.context.reporter;
                let mut warn = |warning: &str| {
                    reporter.warn(warning);
                    warnings.push(warning.to_owned());
                };
                let done = match results.as_deref_mut() {
                    Some(results) => plan.rerun(results, &self.context.run, &mut warn)?,
                    None => plan.run(&self.context.run, &mut warn)?,
                };
                reporter.text(|| text(&self.path, &done, several));
                let mut value = serde_json::to_value(&done).unwrap_or(Value::Null);
                if let Some(value) = value.as_object_mut() {
                    value.insert("skipped".into(), false.into());
                }
                frames.push(value);
            }
            if let Some(task) = &task {
                task.advance(1);
            }
        }
        drop(task);
        let value = json!({
            "operation": "run", "recipe": self.path, "seconds": began.elapsed().as_secs_f64(), "frames": frames,
            "warnings": warnings,
        });
        self.context.reporter.result(&value, String::new)
    }

    fn describe(&self, plans: &[Plan]) -> Result<()> {
        let frame = |plan: &Plan| json!({ "frame": plan.frame(), "steps": plan.describe(), "inputs": plan.files(), "outputs": plan.outputs() });
        let frames: Vec<Value> = plans.iter().map(frame).collect();
        let value = json!({ "dry_run": true, "operation": "run", "recipe": self.path, "frames": frames });
        self.context.reporter.result(&value, || {
            let mut text = format!("{} is in order; nothing is written\n", self.path.display());
            for plan in plans {
                text += &format!("frame {}\n", plan.frame());
                for step in plan.describe().as_array().into_iter().flatten() {
                    text += &format!("  {}\n", line_of(step));
                }
                for path in plan.outputs() {
                    let verb = if path.exists() { "would replace" } else { "would write" };
                    text += &format!("  {verb} {}\n", path.display());
                }
            }
            text
        })
    }
}

/// A step that would be done.
fn line_of(step: &Value) -> String {
    let text = |key: &str| step.get(key).and_then(Value::as_str).unwrap_or_default();
    let inputs = step.get("inputs").and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str);
    let inputs = inputs.collect::<Vec<_>>().join(", ");
    let parameters = step.get("parameters").and_then(Value::as_object).into_iter().flatten();
    let parameters: Vec<String> = parameters.map(|(name, value)| format!("{name} = {value}")).collect();
    let made = if text("name").is_empty() { String::new() } else { format!("{} = ", text("name")) };
    format!("{made}{}({inputs}) {}", text("op"), parameters.join(", ")).trim_end().to_owned()
}

/// What a frame did.
fn text(recipe: &Path, done: &FrameReport, several: bool) -> String {
    let frame = if several { format!(", frame {}", done.frame) } else { String::new() };
    let rows = done.steps.iter().map(|step| {
        let StepReport { op, name, seconds, kept, active_voxels, summary, .. } = step;
        let made = active_voxels.map(|n| format!("{} voxels", table::count(n)));
        let bytes = summary.details.get("bytes").and_then(Value::as_u64).map(size::shown);
        let pixels = summary.details.get("pixels_drawn").and_then(Value::as_u64).map(table::count);
        let pixels = || pixels.map(|count| format!("{count} pixels"));
        vec![
            (*op).to_owned(),
            name.clone().unwrap_or_default(),
            if *kept { "kept".into() } else { format!("{seconds:.2} s") },
            made.or(bytes).or_else(pixels).unwrap_or_default(),
        ]
    });
    let mut text = format!(
        "{}{frame}: {} steps in {:.2} s\n",
        recipe.display(),
        done.steps.iter().filter(|step| !step.kept).count(),
        done.seconds
    );
    text += &table::columns(rows);
    for path in &done.outputs {
        text += &format!("  wrote {}\n", path.display());
    }
    text
}
