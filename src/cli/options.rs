//! Options made from the parameters of operators.
//!
//! A parameter `d_min` becomes `--d-min`; what is typed becomes JSON by the parameter's kind, and what is not typed is not
//! passed on, so that defaults live in the operator alone. Two declared exceptions: [`POSITIONALS`] are written without an
//! option's name, and a [`Sequence`] is a list whose entries have options of their own and keep the order in which they were
//! typed.

use clap::builder::{BoolValueParser, PossibleValuesParser, TypedValueParser, ValueParser};
use clap::{Arg, ArgAction, ArgMatches, Command};
use serde_json::{Map, Number, Value};

use crate::ops::{Entry, Parameter, Sequence};

/// A parameter that is written without its name, before the inputs.
struct Positional {
    operator: &'static str,
    parameter: &'static str,
    value_name: &'static str,
}

const POSITIONALS: &[Positional] = &[
    Positional { operator: "csg", parameter: "operation", value_name: "OP" },
    Positional { operator: "shape", parameter: "spec", value_name: "SPEC" },
    Positional { operator: "segment", parameter: "volume", value_name: "IN" },
    Positional { operator: "reconstruct", parameter: "scans", value_name: "SCANS" },
];

/// `d_min` as `d-min`.
pub fn kebab(name: &str) -> String {
    name.replace('_', "-")
}

fn positional(entry: &Entry, parameter: &Parameter) -> Option<&'static Positional> {
    POSITIONALS.iter().find(|p| p.operator == entry.name && p.parameter == parameter.name)
}

/// Adds the parameters of an operator to its command: positional ones, then options.
pub fn add(mut command: Command, entry: &Entry) -> Command {
    for parameter in entry.parameters() {
        command = match (positional(entry, &parameter), parameter.sequence()) {
            (Some(place), _) => {
                let arg = Arg::new(parameter.name.clone()).required(true).value_name(place.value_name);
                command.arg(described(arg, &parameter).value_parser(Kind::of(&parameter).parser()))
            }
            (None, Some(sequence)) => sequence.options.iter().fold(command, |command, option| {
                let arg = Arg::new(option.name)
                    .long(kebab(option.name))
                    .value_name(option.value_name)
                    .action(ArgAction::Append)
                    .allow_hyphen_values(true)
                    .value_parser(ValueParser::new(not_an_option));
                command.arg(match option.help {
                    Some(help) => arg.help(help),
                    None => described(arg, &parameter),
                })
            }),
            (None, None) => command.arg(option_of(&parameter)),
        };
    }
    command
}

fn option_of(parameter: &Parameter) -> Arg {
    let kind = Kind::of(parameter);
    let arg = Arg::new(parameter.name.clone()).long(kebab(&parameter.name)).value_parser(kind.parser());
    let arg = match &kind {
        Kind::Flag => arg
            .value_name("BOOL")
            .num_args(0..=1)
            .require_equals(true)
            .default_missing_value("true")
            .hide_possible_values(true),
        // The words are shown as possible values.
        Kind::Words(_) => arg.value_name(parameter.name.to_uppercase()),
        // Entries of lists may be places, whose first number may be negative.
        Kind::Text if parameter.is_list => arg
            .value_name(kind.value_name(parameter))
            .allow_hyphen_values(true)
            .value_parser(ValueParser::new(|text: &str| not_an_option(text).map(Value::String))),
        _ => arg.value_name(kind.value_name(parameter)).allow_hyphen_values(kind.may_be_negative()),
    };
    let arg = if parameter.is_list { arg.action(ArgAction::Append) } else { arg };
    let arg = if parameter.values > 1 { arg.num_args(parameter.values) } else { arg };
    described(arg, parameter)
}

/// The doc comment as help, with the default.
fn described(arg: Arg, parameter: &Parameter) -> Arg {
    let text = parameter.help.replace('\n', " ");
    let unit = match parameter.kind.split_once('(') {
        Some((_, unit)) => format!(" [{}]", unit.trim_end_matches(')')),
        None => String::new(),
    };
    let default = default_of(parameter).map(|default| format!(" [default: {default}]")).unwrap_or_default();
    arg.help(format!("{text}{unit}{default}"))
}

/// The default as it would be typed; none of what is off or empty.
pub fn default_of(parameter: &Parameter) -> Option<String> {
    match &parameter.default {
        Value::Null | Value::Bool(false) => None,
        Value::Array(list) if list.is_empty() => None,
        Value::String(text) if text.is_empty() => None,
        Value::Array(list) => Some(list.iter().map(plain).collect::<Vec<_>>().join(",")),
        value => Some(plain(value)),
    }
}

/// How a parameter is named: by its option, or by its place.
pub fn written(entry: &Entry, parameter: &Parameter) -> String {
    match positional(entry, parameter) {
        Some(place) => format!("{} (`{}`)", place.value_name, parameter.name),
        None => format!("`--{}`", kebab(&parameter.name)),
    }
}

fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        value => value.to_string(),
    }
}

/// What was typed, by parameter.
pub fn collect(entry: &Entry, matches: &ArgMatches) -> Map<String, Value> {
    let mut values = Map::new();
    for parameter in entry.parameters() {
        let value = match parameter.sequence() {
            Some(sequence) => in_order(sequence, matches),
            None => typed(&parameter, matches),
        };
        if let Some(value) = value {
            values.insert(parameter.name, value);
        }
    }
    values
}

fn typed(parameter: &Parameter, matches: &ArgMatches) -> Option<Value> {
    let mut given = matches.get_many::<Value>(&parameter.name)?.cloned();
    match parameter.is_list {
        // An entry that is a list itself (`1,2,3`) stays one.
        true => Some(Value::Array(given.collect())),
        false => given.next_back(),
    }
}

/// The entries of a sequence in the order in which they were typed.
fn in_order(sequence: &Sequence, matches: &ArgMatches) -> Option<Value> {
    let mut entries: Vec<(usize, String)> = Vec::new();
    for option in sequence.options {
        let (Some(places), Some(values)) = (matches.indices_of(option.name), matches.get_many::<String>(option.name))
        else {
            continue;
        };
        entries.extend(places.zip(values).map(|(place, value)| (place, format!("{}{value}", option.prefix))));
    }
    entries.sort_by_key(|entry| entry.0);
    (!entries.is_empty()).then(|| entries.into_iter().map(|(_, text)| Value::String(text)).collect())
}

/// What is typed for a parameter.
#[derive(Debug, PartialEq)]
enum Kind {
    /// Nothing, or `=false`.
    Flag,
    Integer,
    Number,
    /// A number with an optional unit.
    Length,
    /// Numbers with commas between.
    Numbers,
    /// One of these.
    Words(Vec<String>),
    /// Anything.
    Text,
}

impl Kind {
    fn of(parameter: &Parameter) -> Self {
        let kind = parameter.kind.as_str();
        if parameter.is_flag {
            return Self::Flag;
        }
        match kind {
            "integer" => return Self::Integer,
            "number" => return Self::Number,
            "x,y,z" | "array" => return Self::Numbers,
            _ if kind.starts_with("length") => return Self::Length,
            _ => {}
        }
        let is_word = |word: &str| {
            !word.is_empty()
                && word.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-')
                && !matches!(word, "string" | "number" | "integer" | "array" | "boolean" | "object" | "value")
        };
        let words: Vec<&str> = kind.split('|').collect();
        match words.iter().all(|word| is_word(word)) {
            true => Self::Words(words.into_iter().map(str::to_owned).collect()),
            false => Self::Text,
        }
    }

    fn value_name(&self, parameter: &Parameter) -> String {
        match self {
            Self::Integer => "N".into(),
            Self::Number => "NUMBER".into(),
            Self::Length => "LENGTH".into(),
            Self::Numbers if parameter.kind == "array" => "A,B".into(),
            Self::Numbers => "X,Y,Z".into(),
            Self::Text if parameter.kind == "FILE" => "FILE".into(),
            Self::Flag | Self::Words(_) | Self::Text => "TEXT".into(),
        }
    }

    fn may_be_negative(&self) -> bool {
        matches!(self, Self::Integer | Self::Number | Self::Length | Self::Numbers)
    }

    fn parser(&self) -> ValueParser {
        match self {
            Self::Flag => BoolValueParser::new().map(Value::Bool).into(),
            Self::Words(words) => PossibleValuesParser::new(words.clone()).map(Value::String).into(),
            Self::Integer => ValueParser::new(integer),
            Self::Number => ValueParser::new(number),
            Self::Length => ValueParser::new(length),
            Self::Numbers => ValueParser::new(numbers),
            Self::Text => ValueParser::new(|text: &str| Ok::<_, String>(Value::String(text.to_owned()))),
        }
    }
}

fn integer(text: &str) -> Result<Value, String> {
    let signed = text.trim().parse::<i64>().map(Value::from);
    signed.or_else(|_| text.trim().parse::<u64>().map(Value::from)).map_err(|_| "not a whole number".to_owned())
}

fn number(text: &str) -> Result<Value, String> {
    let value = text.trim().parse().ok().and_then(Number::from_f64);
    value.map(Value::Number).ok_or_else(|| "not a finite number".to_owned())
}

/// A number with an optional unit; the unit goes on to the operator as text.
pub fn length(text: &str) -> Result<Value, String> {
    let text = text.trim();
    let bare = text.strip_suffix("vx").or_else(|| text.strip_suffix("wu"));
    match number(bare.unwrap_or(text).trim_end()) {
        Ok(value) => Ok(if bare.is_some() { Value::String(text.to_owned()) } else { value }),
        Err(_) => Err("not a length: a number, `3vx` (voxels) or `0.5wu` (world units)".to_owned()),
    }
}

fn numbers(text: &str) -> Result<Value, String> {
    let one = |part: &str| number(part).map_err(|_| format!("`{}` is not a finite number", part.trim()));
    text.split(',').map(one).collect::<Result<Vec<_>, _>>().map(Value::Array)
}

/// Values of a sequence may begin with a minus, but an option's name is no value.
fn not_an_option(text: &str) -> Result<String, String> {
    match text.strip_prefix('-').and_then(|rest| rest.chars().next()) {
        Some(c) if c == '-' || c.is_ascii_alphabetic() => Err("a value is needed here, this is an option".to_owned()),
        _ => Ok(text.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::REGISTRY;

    fn parameter(name: &str, kind: &str) -> Parameter {
        Parameter {
            name: name.into(),
            help: String::new(),
            kind: kind.into(),
            default: Value::Null,
            is_list: false,
            values: 1,
            is_flag: kind == "boolean",
        }
    }

    #[test]
    fn kinds_are_told_apart() {
        for (kind, expected) in [
            ("boolean", Kind::Flag),
            ("integer", Kind::Integer),
            ("length (voxels, or `0.5wu`)", Kind::Length),
            ("x,y,z", Kind::Numbers),
            ("first|weno5", Kind::Words(vec!["first".into(), "weno5".into()])),
            ("openvdb", Kind::Words(vec!["openvdb".into()])),
            ("string", Kind::Text),
            ("number|string", Kind::Text),
            ("'sphere center=… radius=…'", Kind::Text),
        ] {
            assert_eq!(Kind::of(&parameter("p", kind)), expected, "{kind}");
        }
    }

    #[test]
    fn values_become_json() {
        assert_eq!(numbers("-1, 2,3e-1"), Ok(serde_json::json!([-1.0, 2.0, 0.3])));
        assert!(numbers("1,,2").is_err() && numbers("1,nan,2").is_err());
        assert_eq!(length("-3vx"), Ok(Value::from("-3vx")));
        assert_eq!(length("0.5"), Ok(Value::from(0.5)));
        assert!(length("--json").is_err() && length("3m").is_err() && length("infvx").is_err());
        assert_eq!(integer("18446744073709551615"), Ok(Value::from(u64::MAX)));
        assert!(integer("1.5").is_err() && number("inf").is_err());
    }

    fn parse(entry: &Entry, words: &[&str]) -> Result<Map<String, Value>, clap::Error> {
        let command = add(Command::new("test").no_binary_name(true), entry);
        command.try_get_matches_from(words).map(|matches| collect(entry, &matches))
    }

    #[test]
    fn only_what_is_typed_is_passed_on() {
        let smooth = REGISTRY.iter().find(|e| e.name == "smooth").unwrap();
        assert!(parse(smooth, &[]).unwrap().is_empty());
        let values = parse(smooth, &["--iterations", "3", "--method", "laplacian"]).unwrap();
        assert_eq!(Value::Object(values), serde_json::json!({ "method": "laplacian", "iterations": 3 }));
        assert!(parse(smooth, &["--iterations", "--scheme"]).is_err());
        assert!(parse(smooth, &["--method", "magic"]).is_err());
    }

    #[test]
    fn regions_keep_their_order() {
        let smooth = REGISTRY.iter().find(|e| e.name == "smooth").unwrap();
        let values =
            parse(smooth, &["--region", "a", "--region-not", "b", "--region", "c", "--region-or", "d"]).unwrap();
        assert_eq!(values["region"], serde_json::json!(["a", "not b", "c", "or d"]));
        assert!(parse(smooth, &["--region", "--region-not"]).is_err());
    }

    #[test]
    fn every_default_of_every_operator_can_be_typed() {
        for entry in REGISTRY {
            for parameter in entry.parameters() {
                if parameter.sequence().is_some() || parameter.is_list {
                    continue;
                }
                let text = match &parameter.default {
                    Value::Null => continue,
                    Value::Array(list) => list.iter().map(plain).collect::<Vec<_>>().join(","),
                    value => plain(value),
                };
                let name = kebab(&parameter.name);
                let typed = match positional(entry, &parameter) {
                    Some(_) => continue,
                    None => [format!("--{name}={text}")],
                };
                let mut words: Vec<&str> = typed.iter().map(String::as_str).collect();
                for place in POSITIONALS.iter().filter(|p| p.operator == entry.name) {
                    let own = entry.parameters().into_iter().find(|p| p.name == place.parameter).unwrap();
                    words.push(match Kind::of(&own) {
                        Kind::Words(words) => words[0].clone().leak(),
                        _ => "sphere radius=1",
                    });
                }
                let values = parse(entry, &words).unwrap_or_else(|e| panic!("{} {name}: {e}", entry.name));
                let same = match (&values[&parameter.name], &parameter.default) {
                    (Value::Number(a), Value::Number(b)) => a.as_f64() == b.as_f64(),
                    (a, b) => a.to_string().replace(".0", "") == b.to_string().replace(".0", ""),
                };
                assert!(same, "{} {name}: {:?}", entry.name, values[&parameter.name]);
            }
        }
    }
}
