//! Values that depend on variables and on the frame.

use serde_json::{Map, Number, Value};

/// What keyframes look like.
pub(super) const KEYFRAMES: &str = "keyframes `{ frames = [1, 24], values = [0, 45] }`: frames in rising order, as many values, each \
                                    a number or all of them vectors of one length";

/// The value at a frame, its variables replaced; otherwise what would be accepted.
pub(super) fn resolve(value: &Value, frame: i64, variables: &Map<String, Value>) -> Result<Value, String> {
    match value {
        Value::String(text) => substitute(text, frame, variables),
        Value::Array(list) => list.iter().map(|entry| resolve(entry, frame, variables)).collect(),
        Value::Object(table) => keyframed(table, frame).ok_or_else(|| KEYFRAMES.into()),
        value => Ok(value.clone()),
    }
}

/// The value of keyframes at a frame, linear between them and constant beyond; `None` if they are none.
pub(super) fn keyframed(table: &Map<String, Value>, frame: i64) -> Option<Value> {
    let [frames, values] = ["frames", "values"].map(|key| table.get(key).and_then(Value::as_array));
    let (frames, values) = (frames?, values?);
    let frames: Vec<f64> = frames.iter().map(Value::as_f64).collect::<Option<_>>()?;
    let values: Vec<Vec<f64>> = values.iter().map(numbers).collect::<Option<_>>()?;
    let is_vector = table.get("values")?.get(0)?.is_array();
    let all = |ok: fn(&[f64; 2]) -> bool| frames.windows(2).all(|pair| ok(&[pair[0], pair[1]]));
    let length = values.first()?.len();
    if table.len() != 2 || frames.len() != values.len() || !all(|[a, b]| a < b) || length == 0 {
        return None;
    }
    let alike = |v: &Value| v.is_array() == is_vector;
    if values.iter().any(|v| v.len() != length) || !table.get("values")?.as_array()?.iter().all(alike) {
        return None;
    }
    let at = frame as f64;
    let after = frames.iter().position(|f| *f >= at).unwrap_or(frames.len() - 1);
    let before = after.saturating_sub(1);
    let span = frames[after] - frames[before];
    // At a key, and beyond the first and last one, the value is the key's to the bit.
    let between = if frames[after] <= at || span == 0.0 { 1.0 } else { ((at - frames[before]) / span).max(0.0) };
    let mix = |(a, b): (&f64, &f64)| match between {
        0.0 => *a,
        1.0 => *b,
        t => a + (b - a) * t,
    };
    let mixed = values[before].iter().zip(&values[after]).map(mix).map(|v| Number::from_f64(v).map(Value::Number));
    let mixed: Vec<Value> = mixed.collect::<Option<_>>()?;
    if is_vector { Some(Value::Array(mixed)) } else { mixed.into_iter().next() }
}

fn numbers(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Array(list) => list.iter().map(Value::as_f64).collect(),
        value => value.as_f64().map(|v| vec![v]),
    }
}

/// A text with its variables replaced.
fn substitute(text: &str, frame: i64, variables: &Map<String, Value>) -> Result<Value, String> {
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = rest.find('$') {
        let (name, length) = variable(&rest[at..]);
        if name.is_empty() {
            out.push_str(&rest[..=at]);
            rest = &rest[at + 1..];
            continue;
        }
        let value = value_of(name, frame, variables)?;
        if length == text.len() {
            return Ok(value);
        }
        out.push_str(&rest[..at]);
        out.push_str(&plain(&value));
        rest = &rest[at + length..];
    }
    out.push_str(rest);
    Ok(Value::String(out))
}

/// The name after a `$` and the length of the whole; an empty name if it is none.
fn variable(text: &str) -> (&str, usize) {
    let inner = &text[1..];
    if let Some(braced) = inner.strip_prefix('{') {
        return match braced.find('}') {
            Some(end) => (&braced[..end], end + 3),
            None => ("", 1),
        };
    }
    let end = inner.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(inner.len());
    if inner.starts_with(|c: char| c.is_ascii_digit()) { ("", 1) } else { (&inner[..end], end + 1) }
}

fn value_of(name: &str, frame: i64, variables: &Map<String, Value>) -> Result<Value, String> {
    if let Some(width) = name.strip_prefix('F').filter(|digits| digits.bytes().all(|b| b.is_ascii_digit())) {
        return match width.parse::<usize>() {
            _ if width.is_empty() => Ok(frame.into()),
            Ok(width) if width <= 20 => Ok(format!("{frame:0width$}").into()),
            _ => Err("`$F4` has at most 20 digits".into()),
        };
    }
    let value = variables.get(name).ok_or_else(|| {
        let names = variables.keys().map(String::as_str).chain(["F"]);
        format!("`${name}` is no variable of [set]; {}", crate::spec::suggest(name, names))
    })?;
    match value {
        Value::Object(table) => keyframed(table, frame).ok_or_else(|| KEYFRAMES.into()),
        value => Ok(value.clone()),
    }
}

/// A value within a text: vectors with commas.
pub(super) fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Array(list) => list.iter().map(plain).collect::<Vec<_>>().join(","),
        value => value.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn at(value: Value, frame: i64) -> Result<Value, String> {
        let variables =
            json!({ "r": 0.5, "c": [1, 2, 3], "file": "a b.vdb", "x": { "frames": [1, 3], "values": [0, 1] } });
        let Value::Object(variables) = variables else { unreachable!() };
        resolve(&value, frame, &variables)
    }

    #[test]
    fn keyframes_are_linear_and_constant_beyond() {
        let angle = json!({ "frames": [1, 24], "values": [0, 46] });
        for (frame, value) in [(0, 0.0), (1, 0.0), (12, 22.0), (24, 46.0), (99, 46.0)] {
            assert_eq!(at(angle.clone(), frame), Ok(json!(value)), "{frame}");
        }
        let path = json!({ "frames": [1, 3, 5], "values": [[0, 0, 0], [1, 2, 4], [1, 2, 0]] });
        assert_eq!(at(path.clone(), 2), Ok(json!([0.5, 1.0, 2.0])));
        assert_eq!(at(path, 4), Ok(json!([1.0, 2.0, 2.0])));
        assert_eq!(at(json!({ "frames": [7], "values": [3] }), 1), Ok(json!(3.0)));
        for bad in [
            json!({}),
            json!({ "frames": [1, 2], "values": [1] }),
            json!({ "frames": [2, 1], "values": [1, 2] }),
            json!({ "frames": [1, 1], "values": [1, 2] }),
            json!({ "frames": [1, 2], "values": [1, "2"] }),
            json!({ "frames": [1, 2], "values": [[1, 2], [1]] }),
            json!({ "frames": [1, 2], "values": [[1], 1] }),
            json!({ "frames": [], "values": [] }),
            json!({ "frames": [1], "values": [1], "ease": "in" }),
        ] {
            assert!(at(bad.clone(), 1).is_err(), "{bad}");
        }
    }

    #[test]
    fn variables_take_their_place_in_texts() {
        for (text, value) in [
            ("$r", json!(0.5)),
            ("$c", json!([1, 2, 3])),
            ("sphere radius=$r center=$c", json!("sphere radius=0.5 center=1,2,3")),
            ("${r}vx", json!("0.5vx")),
            ("$x", json!(0.5)),
            ("$x,0,0", json!("0.5,0,0")),
            ("a.$F.vdb", json!("a.2.vdb")),
            ("a$F4.vdb", json!("a0002.vdb")),
            ("$F", json!(2)),
            ("5 $ or $5", json!("5 $ or $5")),
            ("${r", json!("${r")),
        ] {
            assert_eq!(at(json!(text), 2), Ok(value), "{text}");
        }
        assert!(at(json!("$fill"), 1).unwrap_err().contains("did you mean `file`"));
        assert!(at(json!("$F99"), 1).is_err());
    }
}
