//! A recipe as it is written: TOML with the lines of everything.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde_json::{Map, Number, Value};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::step::{Op, Step};
use super::value::{KEYFRAMES, keyframed};
use crate::error::{EditError, Result};
use crate::spec::suggest;

/// The version of the format.
const VERSION: u32 = 1;

/// The keys of every step, beside the parameters of its operator.
pub(super) const STEP_KEYS: [&str; 4] = ["op", "input", "inputs", "name"];

/// A recipe whose keys, names and references are in order.
pub struct Recipe {
    pub(super) path: PathBuf,
    pub(super) steps: Vec<Step>,
    /// What `[set]` declares, keyframes included.
    pub(super) variables: Map<String, Value>,
    pub(super) output_folder: Option<PathBuf>,
    pub(super) check: bool,
}

/// A key of a step and what it is given.
pub(super) struct Key {
    pub name: String,
    pub line: usize,
    pub value: Value,
}

/// What a step takes.
#[derive(Clone)]
pub(super) enum Source {
    /// The result of an earlier step.
    Step(usize),
    /// A file, its variables not yet replaced.
    File { text: String, line: usize },
}

impl Recipe {
    /// Reads a recipe from its file.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path);
        Self::parse(&text.map_err(|e| EditError::input(path, format!("cannot be read as a recipe: {e}")))?, path)
    }

    /// A recipe from its text; `path` is where its relative paths begin, and what errors call it.
    pub fn parse(text: &str, path: &Path) -> Result<Self> {
        let reader = Reader { text, path };
        let table = DeTable::parse(text).map_err(|error| {
            let line = error.span().map_or(1, |span| reader.line(span.start));
            EditError::input(path, format!("line {line}: {}", error.message()))
        })?;
        let mut recipe =
            Self { path: path.into(), steps: Vec::new(), variables: Map::new(), output_folder: None, check: false };
        let mut version = None;
        let mut steps = None;
        for (key, value) in table.get_ref() {
            let line = reader.line(key.span().start);
            let place = reader.place(line);
            match (key.get_ref().as_ref(), value.get_ref()) {
                ("version", given) => {
                    let number = given.as_integer().and_then(|n| n.as_str().parse().ok());
                    if number != Some(VERSION) {
                        let given = shown(&reader.json(value)?);
                        return Err(EditError::parameter(&place, "version", given, "this program reads `version = 1`"));
                    }
                    version = number;
                }
                ("set", DeValue::Table(set)) => recipe.variables = reader.variables(set)?,
                ("step", DeValue::Array(list)) => steps = Some(list),
                (name @ ("set" | "step"), _) => {
                    let accepted = "a table `[set]`, or `[[step]]` for each step";
                    return Err(EditError::parameter(&place, name, value.get_ref().type_str(), accepted));
                }
                (name, _) => {
                    let accepted = format!("no such key; {}", suggest(name, ["version", "set", "step"].into_iter()));
                    return Err(EditError::parameter(&place, name, value.get_ref().type_str(), accepted));
                }
            }
        }
        if version.is_none() {
            return Err(EditError::parameter(&reader.place(1), "version", "nothing", "`version = 1` at the top"));
        }
        let Some(steps) = steps.filter(|steps| !steps.is_empty()) else {
            return Err(EditError::parameter(&reader.place(1), "step", "nothing", "one `[[step]]` or more"));
        };
        let mut raw = Vec::new();
        for step in steps {
            let line = reader.line(step.span().start);
            let Some(table) = step.get_ref().as_table() else {
                let given = step.get_ref().type_str();
                return Err(EditError::parameter(&reader.place(line), "step", given, "tables `[[step]]`"));
            };
            raw.push(reader.step(table, line)?);
        }
        recipe.steps = reader.linked(raw)?;
        Ok(recipe)
    }

    /// Gives a variable of `[set]` another value, written as in the recipe; a text needs no quotes.
    pub fn set(&mut self, name: &str, text: &str) -> Result<()> {
        let Some(variable) = self.variables.get_mut(name) else {
            let names = self.variables.keys().map(String::as_str);
            let accepted = match self.variables.is_empty() {
                true => format!("{} has no table [set], so there is nothing to set", self.path.display()),
                false => format!("no such variable in [set]; {}", suggest(name, names)),
            };
            return Err(EditError::parameter("run", "set", format!("{name}={text}"), accepted));
        };
        let reader = Reader { text, path: &self.path };
        let parsed = DeValue::parse(text).ok().and_then(|value| reader.json(&value).ok());
        let value = match (&*variable, parsed) {
            // A text may look like a number or a list, as `1-2` and `1,2` nearly do.
            (Value::String(_), Some(Value::String(quoted))) => Value::String(quoted),
            (Value::String(_), _) => Value::String(text.into()),
            (_, Some(value)) => value,
            (_, None) => Value::String(text.into()),
        };
        let fits = match (&*variable, &value) {
            (Value::Number(_) | Value::Object(_), Value::Number(_)) => true,
            (Value::Number(_) | Value::Array(_) | Value::Object(_), Value::Object(table)) => {
                keyframed(table, 1).is_some()
            }
            (a, b) => std::mem::discriminant(a) == std::mem::discriminant(b),
        };
        if !fits {
            let accepted = format!("a value like that of the recipe, `{}`", shown(variable));
            return Err(EditError::parameter("run", "set", format!("{name}={text}"), accepted));
        }
        *variable = value;
        Ok(())
    }

    /// Lets relative paths of `write` and `render` begin in another folder than the recipe's.
    pub fn set_output_folder(&mut self, folder: PathBuf) {
        self.output_folder = Some(folder);
    }

    /// Has every level set that is written verified; one that breaks an invariant stops the run.
    pub fn check_outputs(&mut self) {
        self.check = true;
    }

    /// The names of `[set]` and their values.
    pub fn variables(&self) -> &Map<String, Value> {
        &self.variables
    }

    /// A line of this recipe and a step there, as errors name it.
    pub(super) fn place(&self, line: usize, step: &Step) -> String {
        place_of(&self.path, line, &step.label())
    }
}

fn place_of(path: &Path, line: usize, label: &str) -> String {
    format!("{}:{line}: {label}", path.display())
}

/// A value as a person would write it.
pub(super) fn shown(value: &Value) -> String {
    match value {
        Value::String(text) => format!("\"{text}\""),
        value => value.to_string(),
    }
}

/// The text that is read, and its lines.
struct Reader<'a> {
    text: &'a str,
    path: &'a Path,
}

impl Reader<'_> {
    fn line(&self, offset: usize) -> usize {
        1 + self.text.bytes().take(offset).filter(|b| *b == b'\n').count()
    }

    fn place(&self, line: usize) -> String {
        format!("{}:{line}", self.path.display())
    }

    fn json(&self, value: &Spanned<DeValue>) -> Result<Value> {
        let line = self.line(value.span().start);
        let refuse = |given: String, accepted: &str| {
            Err(EditError::parameter(&self.place(line), "value", given, accepted.to_owned()))
        };
        Ok(match value.get_ref() {
            DeValue::String(text) => Value::String(text.to_string()),
            DeValue::Boolean(flag) => Value::Bool(*flag),
            DeValue::Integer(number) => match i64::from_str_radix(number.as_str(), number.radix()) {
                Ok(number) => number.into(),
                Err(_) => return refuse(number.to_string(), "an integer of 64 bits"),
            },
            DeValue::Float(number) => match number.as_str().parse().ok().and_then(Number::from_f64) {
                Some(number) => Value::Number(number),
                None => return refuse(number.to_string(), "a finite number"),
            },
            DeValue::Datetime(date) => return refuse(date.to_string(), "a number, text, list or keyframes; no dates"),
            DeValue::Array(list) => list.iter().map(|entry| self.json(entry)).collect::<Result<_>>()?,
            DeValue::Table(table) => {
                let entry = |(key, value): (&Spanned<_>, _)| {
                    let key: &std::borrow::Cow<str> = key.get_ref();
                    Ok((key.to_string(), self.json(value)?))
                };
                Value::Object(table.iter().map(entry).collect::<Result<_>>()?)
            }
        })
    }

    fn variables(&self, set: &DeTable) -> Result<Map<String, Value>> {
        let mut variables = Map::new();
        for (key, value) in set {
            let name = key.get_ref().to_string();
            let place = self.place(self.line(key.span().start));
            let is_name = name.starts_with(|c: char| c.is_ascii_lowercase() || c == '_')
                && name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_');
            if !is_name {
                let accepted = "a name of letters, digits and `_` that begins with a small letter";
                return Err(EditError::parameter(&place, "set", name, accepted));
            }
            let value = self.json(value)?;
            if value.as_object().is_some_and(|table| keyframed(table, 1).is_none()) {
                return Err(EditError::parameter(&place, &name, shown(&value), KEYFRAMES));
            }
            variables.insert(name, value);
        }
        Ok(variables)
    }

    /// A step whose inputs are still texts.
    fn step(&self, table: &DeTable, line: usize) -> Result<(Step, Vec<(String, usize)>)> {
        let place = self.place(line);
        let text = |key: &str| match table.iter().find(|(k, _)| k.get_ref() == key) {
            None => Ok(None),
            Some((k, value)) => match value.get_ref().as_str() {
                Some(text) => Ok(Some((text.to_owned(), self.line(k.span().start)))),
                None => {
                    let place = self.place(self.line(k.span().start));
                    Err(EditError::parameter(&place, key, shown(&self.json(value)?), "a text in quotes"))
                }
            },
        };
        let Some((name, op_line)) = text("op")? else {
            let accepted = "`op = \"…\"`: what the step does";
            return Err(EditError::parameter(&place, "op", "nothing", accepted));
        };
        let Some(op) = Op::find(&name) else {
            let accepted = suggest(&name, Op::names().into_iter());
            return Err(EditError::parameter(&self.place(op_line), "op", format!("\"{name}\""), accepted));
        };
        let name = text("name")?;
        if let Some((name, line)) = &name
            && (name.is_empty() || !name.chars().all(|c| c.is_alphanumeric() || matches!(c, '_' | '-')))
        {
            let accepted = "a name of letters, digits, `_` and `-`";
            return Err(EditError::parameter(&self.place(*line), "name", format!("\"{name}\""), accepted));
        }
        let mut step = Step::new(op, name.map(|(name, _)| name), line);
        let mut inputs: Vec<(String, usize)> = text("input")?.into_iter().collect();
        for (key, value) in table {
            let name: &str = key.get_ref();
            let line = self.line(key.span().start);
            let place = place_of(self.path, line, &step.label());
            if name == "inputs" {
                let list = match self.json(value)? {
                    Value::Array(list) => {
                        list.iter().map(|v| v.as_str().map(str::to_owned)).collect::<Option<Vec<_>>>()
                    }
                    _ => None,
                };
                let Some(list) = list else {
                    let accepted = "a list of names of steps and files, `[\"a\", \"b\"]`";
                    return Err(EditError::parameter(&place, name, shown(&self.json(value)?), accepted));
                };
                if !inputs.is_empty() {
                    return Err(EditError::parameter(&place, name, shown(&list.into()), "either `input` or `inputs`"));
                }
                inputs = list.into_iter().map(|text| (text, line)).collect();
            } else if !STEP_KEYS.contains(&name) {
                let value = self.json(value)?;
                if !step.knows(name) {
                    let names = step.key_names();
                    let names = names.iter().map(String::as_str).chain(STEP_KEYS);
                    let accepted = format!("no such key; {}", suggest(name, names));
                    return Err(EditError::parameter(&place, name, shown(&value), accepted));
                }
                step.keys.push(Key { name: name.into(), line, value });
            }
        }
        let place = place_of(self.path, line, &step.label());
        if op.makes() && step.name.is_none() {
            let accepted = "`name = \"…\"`, by which later steps take what it makes";
            return Err(EditError::parameter(&place, "name", "nothing", accepted));
        }
        let (least, most, accepted) = op.inputs();
        if !(least..=most).contains(&inputs.len()) {
            let given: Vec<&str> = inputs.iter().map(|(text, _)| text.as_str()).collect();
            let field = if most == 1 { "input" } else { "inputs" };
            return Err(EditError::parameter(&place, field, format!("[{}]", given.join(", ")), accepted));
        }
        Ok((step, inputs))
    }

    /// The steps with their inputs found; names that are wrong and results that nobody takes are refused.
    fn linked(&self, raw: Vec<(Step, Vec<(String, usize)>)>) -> Result<Vec<Step>> {
        let mut names: HashMap<String, usize> = HashMap::new();
        for (index, (step, _)) in raw.iter().enumerate() {
            let Some(name) = &step.name else { continue };
            if let Some(first) = names.insert(name.clone(), index) {
                let accepted = format!("another name: the step of line {} has it already", raw[first].0.line);
                let place = place_of(self.path, step.line, &step.label());
                return Err(EditError::parameter(&place, "name", format!("\"{name}\""), accepted));
            }
        }
        let lines: Vec<(usize, bool)> = raw.iter().map(|(step, _)| (step.line, step.op.makes())).collect();
        let mut steps: Vec<Step> = Vec::new();
        for (index, (mut step, inputs)) in raw.into_iter().enumerate() {
            for (text, line) in inputs {
                let place = place_of(self.path, line, &step.label());
                let refuse =
                    |accepted: String| Err(EditError::parameter(&place, "input", format!("\"{text}\""), accepted));
                match names.get(&text) {
                    Some(&other) if other == index => {
                        return refuse("another step: a step that takes its own result is circular".into());
                    }
                    Some(&other) if other > index => {
                        return refuse(format!(
                            "an earlier step: that one is in line {}, and steps run in the order in which they are written, so \
                             this would be circular",
                            lines[other].0
                        ));
                    }
                    Some(&other) if !lines[other].1 => {
                        return refuse(format!(
                            "a step that makes a level set; that of line {} makes none",
                            lines[other].0
                        ));
                    }
                    Some(&other) => {
                        if step.op.reads_files_only() {
                            return refuse("a file: what a step makes is a level set already".into());
                        }
                        steps[other].uses += 1;
                        step.inputs.push(Source::Step(other));
                    }
                    None if !text.contains(['.', '/', '\\', '$']) => {
                        let earlier = steps.iter().filter_map(|step| step.name.as_deref());
                        return refuse(format!("neither an earlier step nor a file; {}", suggest(&text, earlier)));
                    }
                    None => step.inputs.push(Source::File { text, line }),
                }
            }
            steps.push(step);
        }
        if let Some(unused) = steps.iter().find(|step| step.op.makes() && step.uses == 0) {
            let place = place_of(self.path, unused.line, &unused.label());
            let name = unused.name.clone().unwrap_or_default();
            let accepted = "a later step that takes it: nothing uses what this step makes";
            return Err(EditError::parameter(&place, "name", format!("\"{name}\""), accepted));
        }
        Ok(steps)
    }
}

/// A whole text as JSON.
#[cfg(test)]
pub(super) fn json_of(text: &str) -> Value {
    let reader = Reader { text, path: Path::new("test.toml") };
    let table = DeTable::parse(text).unwrap();
    let span = table.span();
    reader.json(&Spanned::new(span, DeValue::Table(table.into_inner()))).unwrap()
}
