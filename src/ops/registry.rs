//! The list of operators, and what the command line needs to know of each.

use std::sync::Arc;

use schemars::{JsonSchema, Schema, schema_for};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::error::{EditError, Result};
use crate::levelset::LevelSet;
use crate::mesh::TriangleMesh;
use crate::pde::{Report, StopReason};
use crate::run::RunOptions;
use crate::spec::suggest;

/// How many level sets an operator takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arity {
    /// None: it makes one.
    Source,
    /// One.
    One,
    /// Two or more.
    Many,
    /// A base, and a solid that is put on it in a size of its own: of two meshes each gets voxels of its own size.
    BaseAndSolid,
}

/// What an operator did, beside its result.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// Time steps taken.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steps: Option<u32>,
    /// Why a flow ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stopped_because: Option<String>,
    /// The surface with colours, where the operator found any: for files that hold them.
    #[serde(skip)]
    pub colored: Option<Arc<TriangleMesh>>,
    /// What the user should know: repairs, resampling, parameters that did nothing.
    pub warnings: Vec<String>,
    /// Anything else worth telling, by name.
    #[serde(flatten)]
    pub details: Map<String, Value>,
}

impl From<&Report> for Summary {
    fn from(report: &Report) -> Self {
        let reason = match report.stopped {
            StopReason::Iterations => "all steps were taken",
            StopReason::Time => "the time was reached",
            StopReason::NothingLeft => "nothing was left to move",
            StopReason::AtRest => "nothing moves any more",
        };
        Self { steps: Some(report.steps), stopped_because: Some(reason.into()), ..Self::default() }
    }
}

/// The result of an operator.
pub struct Outcome {
    /// The new level set.
    pub level_set: LevelSet,
    /// What was done.
    pub summary: Summary,
}

impl From<LevelSet> for Outcome {
    fn from(level_set: LevelSet) -> Self {
        Self { level_set, summary: Summary::default() }
    }
}

/// An operator: a struct of parameters that acts on level sets.
pub trait Operator: Default + Serialize + DeserializeOwned + JsonSchema + Send + Sync + 'static {
    /// Its name, and that of its command.
    const NAME: &'static str;
    /// What it takes.
    const ARITY: Arity;

    /// Refuses parameters that cannot work, before any work is done.
    fn validate(&self) -> Result<()>;

    /// Does the work. `inputs` has as many level sets as [`ARITY`](Self::ARITY) says.
    fn apply(&self, inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome>;
}

/// One parameter of an operator, as help and documents show it.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// The field's name (`d_min`).
    pub name: String,
    /// Its doc comment.
    pub help: String,
    /// What a value looks like (`number`, `x,y,z`, `curvature|laplacian`).
    pub kind: String,
    /// The default as JSON; `null` where there is none.
    pub default: Value,
    /// Whether several values make a list.
    pub is_list: bool,
    /// How many values are typed after its option.
    pub values: usize,
    /// Whether naming it is enough.
    pub is_flag: bool,
}

/// What there is to know of a struct of parameters.
pub struct ParameterSet {
    schema: fn() -> Schema,
    defaults: fn() -> Value,
    check: fn(Map<String, Value>) -> Result<()>,
}

impl ParameterSet {
    /// Of `P`, whose values `check` verifies.
    pub(crate) const fn of<P: Default + Serialize + JsonSchema>(check: fn(Map<String, Value>) -> Result<()>) -> Self {
        Self {
            schema: || schema_for!(P),
            defaults: || serde_json::to_value(P::default()).unwrap_or(Value::Null),
            check,
        }
    }

    /// What it is for: the doc comment of the struct.
    pub fn help(&self) -> String {
        self.schema().get("description").and_then(Value::as_str).unwrap_or_default().to_owned()
    }

    /// Its JSON schema.
    pub fn schema(&self) -> Schema {
        (self.schema)()
    }

    /// The parameters in the order of the struct.
    pub fn list(&self) -> Vec<Parameter> {
        let schema = self.schema();
        let defaults = (self.defaults)();
        let Some(properties) = schema.get("properties").and_then(Value::as_object) else { return Vec::new() };
        properties
            .iter()
            .map(|(name, property)| Parameter {
                name: name.clone(),
                help: property.get("description").and_then(Value::as_str).unwrap_or_default().to_owned(),
                kind: kind_of(property),
                default: defaults.get(name).cloned().unwrap_or(Value::Null),
                is_list: property.get("x-list").is_some(),
                values: property.get("x-count").and_then(Value::as_u64).unwrap_or(1) as usize,
                is_flag: property.get("type").is_some_and(|t| t == "boolean"),
            })
            .collect()
    }

    /// Verifies parameters without doing anything.
    pub fn check(&self, values: Map<String, Value>) -> Result<()> {
        (self.check)(values)
    }
}

/// An operator in the registry.
pub struct Entry {
    /// Its name.
    pub name: &'static str,
    /// What it takes.
    pub arity: Arity,
    set: ParameterSet,
    run: RunFn,
}

type RunFn = fn(Map<String, Value>, Vec<LevelSet>, &RunOptions) -> Result<Outcome>;

impl Entry {
    const fn of<O: Operator>() -> Self {
        Self {
            name: O::NAME,
            arity: O::ARITY,
            set: ParameterSet::of::<O>(|values| parse::<O>(O::NAME, values)?.validate()),
            run: |values, inputs, run| {
                let operator: O = parse(O::NAME, values)?;
                operator.validate()?;
                operator.apply(inputs, run)
            },
        }
    }

    /// All that there is to know of its parameters.
    pub fn set(&self) -> &ParameterSet {
        &self.set
    }

    /// What the operator does: the doc comment of its struct.
    pub fn help(&self) -> String {
        self.set.help()
    }

    /// Its JSON schema.
    pub fn schema(&self) -> Schema {
        self.set.schema()
    }

    /// Its parameters in the order of the struct.
    pub fn parameters(&self) -> Vec<Parameter> {
        self.set.list()
    }

    /// Verifies parameters without doing anything.
    pub fn check(&self, values: Map<String, Value>) -> Result<()> {
        self.set.check(values)
    }

    /// Runs the operator with the given parameters over its defaults.
    pub fn run(&self, values: Map<String, Value>, inputs: Vec<LevelSet>, run: &RunOptions) -> Result<Outcome> {
        let fits = match self.arity {
            Arity::Source => inputs.is_empty(),
            Arity::One => inputs.len() == 1,
            Arity::Many => inputs.len() >= 2,
            Arity::BaseAndSolid => inputs.len() == 2,
        };
        if !fits {
            let accepted = match self.arity {
                Arity::Source => "it takes no input",
                Arity::One => "it takes one input",
                Arity::Many => "it takes two or more inputs",
                Arity::BaseAndSolid => "it takes two inputs, the base and the texture",
            };
            return Err(EditError::parameter(self.name, "inputs", inputs.len(), accepted));
        }
        (self.run)(values, inputs, run)
    }
}

/// All operators, in the order of the manual.
pub static REGISTRY: &[Entry] = &[
    Entry::of::<super::shape::Shape>(),
    Entry::of::<super::segment::Segment>(),
    Entry::of::<super::reconstruct::Reconstruct>(),
    Entry::of::<super::transform::TransformOperator>(),
    Entry::of::<super::csg::Csg>(),
    Entry::of::<super::blend::Blend>(),
    Entry::of::<super::smooth::Smooth>(),
    Entry::of::<super::sharpen::Sharpen>(),
    Entry::of::<super::fillet::Fillet>(),
    Entry::of::<super::emboss::Emboss>(),
    Entry::of::<super::texture::Texture>(),
    Entry::of::<super::warp::Warp>(),
    Entry::of::<super::sweep::Sweep>(),
    Entry::of::<super::advect::Advect>(),
    Entry::of::<super::morph::Morph>(),
    Entry::of::<super::morphology::Offset>(),
    Entry::of::<super::morphology::Dilate>(),
    Entry::of::<super::morphology::Erode>(),
    Entry::of::<super::morphology::Open>(),
    Entry::of::<super::morphology::Close>(),
    Entry::of::<super::distance::RebuildDistance>(),
    Entry::of::<super::distance::Renormalize>(),
];

/// The operator of a name.
pub fn find(name: &str) -> Result<&'static Entry> {
    REGISTRY.iter().find(|e| e.name == name).ok_or_else(|| {
        let names = REGISTRY.iter().map(|e| e.name);
        EditError::parameter("operator", "op", name, suggest(name, names))
    })
}

/// What a value of a schema looks like.
fn kind_of(property: &Value) -> String {
    if let Some(kind) = property.get("x-kind").and_then(Value::as_str) {
        return kind.to_owned();
    }
    let alternatives = ["anyOf", "oneOf"].iter().find_map(|k| property.get(*k).and_then(Value::as_array));
    if let Some(alternatives) = alternatives {
        let kinds: Vec<_> = alternatives.iter().map(kind_of).filter(|k| k != "null").collect();
        return kinds.join("|");
    }
    if let Some(words) = property.get("enum").and_then(Value::as_array) {
        let words: Vec<_> = words.iter().filter_map(Value::as_str).collect();
        return words.join("|");
    }
    if let Some(word) = property.get("const").and_then(Value::as_str) {
        return word.to_owned();
    }
    match property.get("type") {
        Some(Value::String(kind)) => kind.clone(),
        Some(Value::Array(kinds)) => {
            let kinds: Vec<_> = kinds.iter().filter_map(Value::as_str).filter(|k| *k != "null").collect();
            kinds.join("|")
        }
        _ => "value".to_owned(),
    }
}

/// Parameters from named values; a bad one is blamed by name.
///
/// A failed deserialisation of the whole struct does not say which field it was where structs are flattened, so each
/// value is then tried alone over the defaults.
pub(crate) fn parse<P: DeserializeOwned + JsonSchema>(operation: &str, values: Map<String, Value>) -> Result<P> {
    let schema = schema_for!(P);
    let known = schema.get("properties").and_then(Value::as_object);
    if let Some(known) = known
        && let Some(name) = values.keys().find(|k| !known.contains_key(*k))
    {
        let accepted = suggest(name, known.keys().map(String::as_str));
        return Err(EditError::parameter(
            operation,
            name,
            values[name].to_string(),
            format!("no such parameter; {accepted}"),
        ));
    }
    let whole = serde_json::from_value(Value::Object(values.clone()));
    whole.map_err(|error| {
        for (name, value) in values {
            let alone = Map::from_iter([(name.clone(), value.clone())]);
            if let Err(error) = serde_json::from_value::<P>(Value::Object(alone)) {
                let property = known.and_then(|k| k.get(&name)).unwrap_or(&Value::Null);
                let accepted = accepted(property, &value, &error.to_string());
                return EditError::parameter(operation, &name, value, accepted);
            }
        }
        EditError::parameter(operation, "parameters", "", error.to_string())
    })
}

/// What a parameter takes, in words for a user who gave it a `value` that was refused with `error`.
fn accepted(property: &Value, value: &Value, error: &str) -> String {
    let kind = kind_of(property);
    // Errors of serde's own speak of types.
    let is_serdes = |kinds: &[&str]| kinds.iter().any(|kind| error.starts_with(kind));
    if is_serdes(&["unknown variant"]) && kind.contains('|') {
        return suggest(value.as_str().unwrap_or_default(), kind.split('|'));
    }
    if !is_serdes(&["unknown variant", "invalid type", "invalid value", "data did not match"]) {
        return format!("{error}; expected {kind}");
    }
    let bound = |name| property.get(name).and_then(Value::as_i64);
    let largest = (property.get("format").and_then(Value::as_str) == Some("uint32")).then_some(u32::MAX.into());
    match (kind.as_str(), bound("minimum"), bound("maximum").or(largest)) {
        ("integer", Some(least), Some(most)) => format!("a whole number from {least} to {most}"),
        ("integer", Some(least), None) => format!("a whole number, {least} or more"),
        ("integer", ..) => "a whole number".to_owned(),
        ("number", ..) => "a number".to_owned(),
        ("boolean", ..) => "true or false".to_owned(),
        ("string", ..) => "a text".to_owned(),
        ("array", ..) => match property.get("minItems").and_then(Value::as_u64) {
            Some(count) => format!("a list of {count} numbers"),
            None => "a list".to_owned(),
        },
        _ => kind.replace('|', ", "),
    }
}
