//! A recipe at a frame: every value known and verified, every file there, nothing computed yet.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde_json::{Map, Number, Value, json};

use super::assert::Assertions;
use super::read::{Key, Recipe, Source, shown};
use super::render::Picture;
use super::step::{Conversion, Meaning, Op, Step, Target};
use super::value::{plain, resolve};
use crate::error::{EditError, Result};
use crate::files::frames::numbered;
use crate::files::input::{self, InputOptions};
use crate::files::output::{Output, writable};
use crate::ops::{Arity, Entry};
use crate::spec::rebased;

/// A recipe at one frame, ready to run.
pub struct Plan<'a> {
    pub(super) recipe: &'a Recipe,
    pub(super) steps: Vec<Planned>,
    frame: i64,
    files: Vec<PathBuf>,
    outputs: Vec<PathBuf>,
}

/// A step that was checked.
pub(super) struct Planned {
    /// As errors name it.
    pub place: String,
    pub inputs: Vec<Given>,
    pub action: Action,
    /// The files that its parameters and regions name.
    pub reads: Vec<PathBuf>,
    /// The files that it writes beside its result.
    pub writes: Vec<PathBuf>,
    /// The steps that write files it reads.
    pub after: Vec<usize>,
    pub values: Map<String, Value>,
}

impl Planned {
    /// Whether the meshes it takes get voxels of their own size, each for itself.
    pub fn takes_solids_apart(&self) -> bool {
        matches!(&self.action, Action::Operator(entry, _) if entry.arity == Arity::BaseAndSolid)
    }
}

/// What a step takes.
pub(super) enum Given {
    Step(usize),
    File(PathBuf),
}

/// What a step does, with all parameters.
pub(super) enum Action {
    Operator(&'static Entry, Map<String, Value>),
    Convert(Conversion),
    Assert(Assertions),
    Write(Target),
    Render(Picture),
}

/// The frame of a recipe that is run without frames.
const ONLY_FRAME: i64 = 1;

impl Recipe {
    /// The recipe at frames, or at frame 1 where none are asked for: refused if any step could not begin, or if a file would be
    /// written twice.
    pub fn plan(&self, frames: &[i64]) -> Result<Vec<Plan<'_>>> {
        let frames = if frames.is_empty() { &[ONLY_FRAME] } else { frames };
        let mut written: HashMap<PathBuf, i64> = HashMap::new();
        let mut plans = Vec::new();
        for &frame in frames {
            let plan = self.plan_frame(frame)?;
            for (planned, path) in plan.steps.iter().filter_map(|planned| Some((planned, planned.output()?))) {
                let accepted = match written.insert(path.clone(), frame) {
                    None => continue,
                    Some(other) if other == frame => "another path: an earlier step writes this one",
                    Some(_) => {
                        "a path with the frame in it, `####`, `%04d` or `$F4`: each frame would replace the one before"
                    }
                };
                return Err(EditError::parameter(&planned.place, "path", path.display(), accepted));
            }
            plans.push(plan);
        }
        Ok(plans)
    }

    fn plan_frame(&self, frame: i64) -> Result<Plan<'_>> {
        let mut plan = Plan { recipe: self, steps: Vec::new(), frame, files: Vec::new(), outputs: Vec::new() };
        for step in &self.steps {
            let mut planner = Planner { recipe: self, step, frame, plan: &mut plan, after: Vec::new() };
            let planned = planner.step()?;
            plan.outputs.extend(planned.output());
            plan.steps.push(planned);
        }
        Ok(plan)
    }

    fn folder(&self) -> &Path {
        self.path.parent().unwrap_or(Path::new(""))
    }
}

impl Plan<'_> {
    /// Its frame.
    pub fn frame(&self) -> i64 {
        self.frame
    }

    /// The files that it reads, beside the recipe.
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// The files that it writes.
    pub fn outputs(&self) -> &[PathBuf] {
        &self.outputs
    }

    /// What would be done, a step each: operator, name, parameters and inputs.
    pub fn describe(&self) -> Value {
        let step = |(step, planned): (&Step, &Planned)| {
            let input = |given: &Given| match given {
                Given::Step(index) => self.recipe.steps[*index].name.clone().unwrap_or_default(),
                Given::File(path) => path.display().to_string(),
            };
            json!({
                "op": step.op.name(), "name": step.name, "line": step.line,
                "inputs": planned.inputs.iter().map(input).collect::<Vec<_>>(), "parameters": planned.values,
            })
        };
        self.recipe.steps.iter().zip(&self.steps).map(step).collect()
    }
}

impl Planned {
    pub fn output(&self) -> Option<PathBuf> {
        match &self.action {
            Action::Write(target) => Some(target.path.clone().into()),
            Action::Render(picture) => Some(picture.path.clone().into()),
            _ => None,
        }
    }
}

/// Makes the plan of a step.
struct Planner<'a, 'p> {
    recipe: &'a Recipe,
    step: &'a Step,
    frame: i64,
    plan: &'p mut Plan<'a>,
    /// The steps that write files it reads.
    after: Vec<usize>,
}

impl Planner<'_, '_> {
    fn step(&mut self) -> Result<Planned> {
        let step = self.step;
        let (files, outputs) = (self.plan.files.len(), self.plan.outputs.len());
        let place = self.recipe.place(step.line, step);
        let mut values = Map::new();
        for key in &step.keys {
            self.value(key, &mut values)?;
        }
        let reads = self.plan.files[files..].to_vec();
        let writes = self.plan.outputs[outputs..].to_vec();
        let action = self.action(values.clone()).map_err(|error| self.blamed(error))?;
        let inputs = step.inputs.iter().map(|source| self.input(source)).collect::<Result<Vec<_>>>()?;
        let files = inputs.iter().filter_map(|given| match given {
            Given::File(path) => Some(path.clone()),
            Given::Step(_) => None,
        });
        let files: Vec<PathBuf> = files.collect();
        self.probe(&files, &action).map_err(|error| error.at(&place))?;
        self.plan.files.extend(files);
        let after = std::mem::take(&mut self.after);
        Ok(Planned { place, inputs, action, reads, writes, after, values })
    }

    /// The place of a key.
    fn place(&self, line: usize) -> String {
        self.recipe.place(line, self.step)
    }

    /// Adds the value of a key to those of the operator.
    fn value(&mut self, key: &Key, values: &mut Map<String, Value>) -> Result<()> {
        let place = self.place(key.line);
        let value = resolve(&key.value, self.frame, &self.recipe.variables)
            .map_err(|accepted| EditError::parameter(&place, &key.name, shown(&key.value), accepted))?;
        let step = self.step;
        match step.meaning(&key.name) {
            Some(Meaning::Entries(parameter, option)) => {
                // `translate = [1, 2, 3]` is one entry, `region = ["…", "…"]` are two.
                let entries = match &value {
                    Value::Array(list) if list.iter().all(Value::is_string) => list.clone(),
                    value => vec![value.clone()],
                };
                let list = values.entry(parameter.name.clone()).or_insert_with(|| json!([]));
                for entry in entries {
                    let text = format!("{}{}", option.prefix, plain(&entry));
                    let text = if parameter.name == "region" { self.spec(&text, &place)? } else { text };
                    if let Some(list) = list.as_array_mut() {
                        list.push(text.into());
                    }
                }
            }
            Some(Meaning::Parameter(parameter)) => {
                let value = match value {
                    Value::String(path) if parameter.kind == "FILE" => self.file(&key.name, &path, &place)?.into(),
                    Value::String(text) if parameter.name == "spec" => self.spec(&text, &place)?.into(),
                    // Between keyframes, whole numbers are rounded.
                    Value::Number(number) if parameter.kind == "integer" && !key.value.is_number() => whole(number),
                    value => value,
                };
                values.insert(key.name.clone(), value);
            }
            None => {}
        }
        Ok(())
    }

    /// A specification with its files found.
    fn spec(&mut self, text: &str, place: &str) -> Result<String> {
        let (text, files) = rebased(text, self.recipe.folder());
        for file in files {
            readable(&file).map_err(|error| error.at(place))?;
            self.plan.files.push(file);
        }
        Ok(text)
    }

    /// A file of a parameter: one that is written, or one that is read and must be there.
    fn file(&mut self, name: &str, text: &str, place: &str) -> Result<String> {
        let by_operator = name.starts_with("write_");
        let is_output = by_operator || matches!(self.step.op, Op::Write | Op::Render) && name == "path";
        let output_folder = self.recipe.output_folder.as_deref().unwrap_or(self.recipe.folder());
        let in_folder = |folder: &Path| {
            let path = folder.join(text);
            numbered(&path, self.frame).unwrap_or(path)
        };
        let mut path = in_folder(output_folder);
        let writes = |planned: &Planned| planned.writes.contains(&path) || planned.output().as_ref() == Some(&path);
        if by_operator {
            self.plan.outputs.push(path.clone());
        } else if !is_output && let Some(step) = self.plan.steps.iter().position(writes) {
            self.after.push(step);
        } else if !is_output {
            path = in_folder(self.recipe.folder());
            readable(&path).map_err(|error| error.at(place))?;
            self.plan.files.push(path.clone());
        }
        match path.to_str() {
            Some(path) => Ok(path.into()),
            None => Err(EditError::parameter(place, name, path.display(), "a path that is valid UTF-8")),
        }
    }

    fn input(&self, source: &Source) -> Result<Given> {
        let (text, line) = match source {
            Source::Step(index) => return Ok(Given::Step(*index)),
            Source::File { text, line } => (text, *line),
        };
        let refuse =
            |accepted: String| EditError::parameter(&self.place(line), "input", format!("\"{text}\""), accepted);
        let resolved = resolve(&Value::String(text.clone()), self.frame, &self.recipe.variables).map_err(refuse)?;
        let path = self.recipe.folder().join(plain(&resolved));
        Ok(Given::File(numbered(&path, self.frame).unwrap_or(path)))
    }

    fn action(&self, values: Map<String, Value>) -> Result<Action> {
        Ok(match self.step.op {
            Op::Operator(entry) => {
                entry.check(values.clone())?;
                Action::Operator(entry, values)
            }
            Op::Convert => Action::Convert(Conversion::read(values)?),
            Op::Assert => Action::Assert(Assertions::read(values)?),
            Op::Write => {
                let target = Target::read(values)?;
                Output::check(Path::new(&target.path))?;
                target.mesh().fits(Path::new(&target.path))?;
                Action::Write(target)
            }
            Op::Render => {
                let picture = Picture::read(values)?;
                picture.takes(self.step.inputs.len())?;
                writable(Path::new(&picture.path))?;
                Action::Render(picture)
            }
        })
    }

    /// An error about a parameter, at the line where that is given.
    fn blamed(&self, error: EditError) -> EditError {
        let EditError::Parameter { operation, field, .. } = &error else {
            return error.at(&self.place(self.step.line));
        };
        let parameter = |key: &Key| match self.step.meaning(&key.name) {
            Some(Meaning::Parameter(parameter) | Meaning::Entries(parameter, _)) => parameter.name.clone(),
            None => String::new(),
        };
        let names = |key: &Key, name: &str| key.name == name || parameter(key) == name;
        // What a command calls its output is the path of a step.
        let field = if field == "output" { "path" } else { field };
        // The grammars of shapes and regions do not know whose value they are.
        let of_grammar = |key: &Key| match operation.as_str() {
            "region" => names(key, "region"),
            "shape" => names(key, "spec"),
            _ => false,
        };
        let key = self.step.keys.iter().find(|key| names(key, field));
        let key = key.or_else(|| self.step.keys.iter().find(|key| of_grammar(key)));
        let line = key.map_or(self.step.line, |key| key.line);
        error.at(&self.place(line))
    }

    /// Whether the inputs that are files are there and of a kind that can be read.
    fn probe(&self, files: &[PathBuf], action: &Action) -> Result<()> {
        let (options, has_iso) = match action {
            Action::Convert(conversion) => (conversion.options(), conversion.iso.is_some()),
            _ => (InputOptions::default(), false),
        };
        if let Some(pipe) = files.iter().find(|path| input::is_pipe(path)) {
            let accepted = "a file: a recipe does not read standard input";
            return Err(EditError::parameter("run", "input", pipe.display(), accepted));
        }
        match input::probe(files, &options) {
            // A volume that is no level set is what `iso` is for.
            Err(_) if has_iso && files.iter().all(|path| path.exists()) => Ok(()),
            probed => probed.map(drop),
        }
    }
}

fn whole(number: Number) -> Value {
    let rounded = number.as_f64().map(f64::round).filter(|v| v.abs() < 9e15);
    rounded.map_or(Value::Number(number), |v| Value::from(v as i64))
}

/// Refuses a file that cannot be opened.
fn readable(path: &Path) -> Result<()> {
    match std::fs::File::open(path).and_then(|file| file.metadata()) {
        Err(e) => Err(EditError::input(path, format!("cannot be opened: {e}"))),
        Ok(facts) if facts.is_dir() => Err(EditError::input(path, "is a folder; a file is wanted")),
        Ok(_) => Ok(()),
    }
}
