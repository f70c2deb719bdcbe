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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::read::json_of;
    use super::*;

    /// Whether a value is valid by the keywords that the schema uses; any other keyword that restricts is a failure of the test.
    fn valid(value: &Value, schema: &Value, root: &Value) -> bool {
        let all = |list: &Value| list.as_array().unwrap().iter().filter(|s| valid(value, s, root)).count();
        let count = value.as_array().map(Vec::len);
        schema.as_object().unwrap().iter().all(|(keyword, rule)| match keyword.as_str() {
            "$ref" => valid(value, root.pointer(rule.as_str().unwrap().trim_start_matches('#')).unwrap(), root),
            "anyOf" => all(rule) > 0,
            "oneOf" => all(rule) == 1,
            "const" => value == rule,
            "enum" => rule.as_array().unwrap().contains(value),
            "type" => match rule {
                Value::Array(kinds) => kinds.iter().any(|kind| is_a(value, kind.as_str().unwrap())),
                kind => is_a(value, kind.as_str().unwrap()),
            },
            "properties" => {
                let given = value.as_object().into_iter().flatten();
                given.into_iter().all(|(name, value)| rule.get(name).is_none_or(|schema| valid(value, schema, root)))
            }
            "required" => {
                let has = |name: &Value| value.get(name.as_str().unwrap()).is_some();
                !value.is_object() || rule.as_array().unwrap().iter().all(has)
            }
            "additionalProperties" => {
                assert_eq!(rule, false);
                let known = schema["properties"].as_object().unwrap();
                value.as_object().is_none_or(|given| given.keys().all(|name| known.contains_key(name)))
            }
            "items" => value.as_array().into_iter().flatten().all(|entry| valid(entry, rule, root)),
            "minItems" => count.is_none_or(|n| n as u64 >= rule.as_u64().unwrap()),
            "maxItems" => count.is_none_or(|n| n as u64 <= rule.as_u64().unwrap()),
            "minimum" => value.as_f64().is_none_or(|v| v >= rule.as_f64().unwrap()),
            "maximum" => value.as_f64().is_none_or(|v| v <= rule.as_f64().unwrap()),
            "pattern" if rule == "\\$" => value.as_str().is_none_or(|text| text.contains('$')),
            "pattern" | "propertyNames" | "format" | "default" | "description" | "title" | "$schema" | "$defs" => true,
            "x-kind" | "x-list" | "x-count" => true,
            other => panic!("the test does not know `{other}`"),
        })
    }

    fn is_a(value: &Value, kind: &str) -> bool {
        match kind {
            "object" => value.is_object(),
            "array" => value.is_array(),
            "string" => value.is_string(),
            "boolean" => value.is_boolean(),
            "null" => value.is_null(),
            "integer" => value.is_i64() || value.is_u64(),
            "number" => value.is_number(),
            other => panic!("the test does not know the type `{other}`"),
        }
    }

    #[test]
    fn the_examples_are_valid_and_slips_are_not() {
        let schema = schema();
        let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/recipes");
        let mut count = 0;
        for entry in std::fs::read_dir(examples).unwrap() {
            let path = entry.unwrap().path();
            let text = std::fs::read_to_string(&path).unwrap();
            let recipe = json_of(&text);
            assert!(valid(&recipe, &schema, &schema), "{}", path.display());
            for (right, wrong) in [
                ("voxel_size =", "voxl_size ="),
                ("name = \"", "name = 3 #"),
                ("op = \"shape\"", "op = \"shap\""),
                ("version = 1", "version = 2"),
                ("input = \"", "inputt = \""),
            ] {
                // Variables of [set] have any name.
                let steps = text.find("[[step]]").unwrap();
                let slip = format!("{}{}", &text[..steps], text[steps..].replacen(right, wrong, 1));
                let slip = if right.starts_with("version") { text.replacen(right, wrong, 1) } else { slip };
                assert!(slip == text || !valid(&json_of(&slip), &schema, &schema), "{}: {wrong}", path.display());
            }
            count += 1;
        }
        assert!(count > 0);
    }

    #[test]
    fn what_differs_by_frame_is_valid_too() {
        let schema = schema();
        let recipe = |step: &str| json_of(&format!("version = 1\n[[step]]\nname = \"a\"\n{step}"));
        for (step, fits) in [
            ("op = \"smooth\"\ninput = \"b\"\niterations = { frames = [1, 2], values = [3, 4] }", true),
            ("op = \"smooth\"\ninput = \"b\"\niterations = \"$n\"\nregion_not = [\"sphere radius=1\"]", true),
            ("op = \"smooth\"\ninput = \"b\"\niterations = \"many\"", false),
            ("op = \"transform\"\ninput = \"b\"\nmirror = \"x\"\ntranslate = [1, 2, 3]", true),
            ("op = \"csg\"\ninput = \"b\"", false),
            ("op = \"csg\"\ninputs = [\"b\", \"c.obj\"]\noperation = \"union\"", true),
            ("op = \"assert\"\ninput = \"b\"\nvolume = [1, 2]\ngenus = [0, 1]\nlargest_curvature = 0.5", true),
            ("op = \"assert\"\ninput = \"b\"\nvolume = 1", false),
        ] {
            assert_eq!(valid(&recipe(step), &schema, &schema), fits, "{step}");
        }
    }
}
