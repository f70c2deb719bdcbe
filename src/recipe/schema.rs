//! The JSON schema of recipes, made from the registry.

use serde_json::{Map, Value, json};

use super::step::Op;
use crate::ops::Parameter;

/// The schema (draft 2020-12): one alternative an operator, told apart by `op`.
pub fn schema() -> Value {
    let mut definitions = Map::new();
    let steps: Vec<Value> = Op::all().map(|op| step(op, &mut definitions)).collect();
    definitions.insert(
        "keyframes".into(),
        json!({
            "description": "A value that changes with the frame: linear between keys, constant before and after",
            "type": "object",
            "properties": {
                "frames": { "type": "array", "items": { "type": "number" }, "minItems": 1 },
                "values": {
                    "type": "array", "minItems": 1,
                    "items": { "anyOf": [{ "type": "number" }, { "type": "array", "items": { "type": "number" } }] },
                },
            },
            "required": ["frames", "values"],
            "additionalProperties": false,
        }),
    );
    definitions.insert(
        "variable".into(),
        json!({
            "description": "`$name` of [set], `$F` for the frame, `$F4` for the frame with four digits",
            "type": "string", "pattern": "\\$",
        }),
    );
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Recipe of vdb-edit",
        "type": "object",
        "properties": {
            "version": { "const": 1 },
            "set": {
                "description": "Variables, `$name` in the steps; `--set name=value` changes them",
                "type": "object",
                "propertyNames": { "pattern": "^[a-z_][A-Za-z0-9_]*$" },
            },
            "step": { "type": "array", "minItems": 1, "items": { "oneOf": steps } },
        },
        "required": ["version", "step"],
        "additionalProperties": false,
        "$defs": definitions,
    })
}

/// The alternative of an operator.
fn step(op: Op, definitions: &mut Map<String, Value>) -> Value {
    let schema = op.set().schema();
    if let Some(own) = schema.get("$defs").and_then(Value::as_object) {
        definitions.extend(own.clone());
    }
    let own = schema.get("properties").and_then(Value::as_object);
    let mut properties = Map::new();
    properties.insert("op".into(), json!({ "const": op.name() }));
    let mut required = vec!["op"];
    let text = || json!({ "type": "string" });
    let name = json!({ "type": "string", "pattern": "^[\\p{L}\\p{N}_-]+$", "description": "By which later steps take the result" });
    properties.insert("name".into(), name);
    if op.makes() {
        required.push("name");
    }
    let (least, most, _) = op.inputs();
    if most > 0 {
        if least <= 1 {
            properties.insert("input".into(), text());
        }
        let mut inputs = json!({ "type": "array", "items": text(), "minItems": least });
        if let (Ok(most), Some(inputs)) = (u32::try_from(most), inputs.as_object_mut()) {
            inputs.insert("maxItems".into(), most.into());
        }
        properties.insert("inputs".into(), inputs);
    }
    for parameter in op.set().list() {
        let schema = own.and_then(|own| own.get(&parameter.name)).cloned().unwrap_or_else(|| json!({}));
        if let Some(sequence) = parameter.sequence() {
            for option in sequence.options {
                let help = option.help.unwrap_or(&parameter.help);
                let entry = json!({
                    "description": help,
                    "anyOf": [
                        { "type": ["string", "number"] },
                        { "type": "array", "items": { "type": ["string", "number"] } },
                        { "$ref": "#/$defs/keyframes" },
                    ],
                });
                properties.insert(option.name.into(), entry);
            }
        }
        if !properties.contains_key(&parameter.name) {
            properties.insert(parameter.name.clone(), dynamic(schema, &parameter));
        }
    }
    let mut step = json!({
        "type": "object", "description": op.set().help(), "properties": properties, "required": required,
        "additionalProperties": false,
    });
    if most > 0
        && let Some(step) = step.as_object_mut()
    {
        let alternatives = if least <= 1 {
            json!([{ "required": ["input"] }, { "required": ["inputs"] }])
        } else {
            json!([{ "required": ["inputs"] }])
        };
        step.insert("oneOf".into(), alternatives);
    }
    step
}

/// A parameter's schema, or a variable, or keyframes where it is made of numbers.
fn dynamic(schema: Value, parameter: &Parameter) -> Value {
    let kind = parameter.kind.as_str();
    let is_numeric = ["number", "integer", "length", "x,y,z", "array"].iter().any(|word| kind.contains(word));
    let mut alternatives = vec![schema, json!({ "$ref": "#/$defs/variable" })];
    if is_numeric {
        alternatives.push(json!({ "$ref": "#/$defs/keyframes" }));
    }
    json!({ "description": parameter.help, "anyOf": alternatives })
}
