//! `compare`: how far two surfaces are apart.

use std::path::PathBuf;

use clap::builder::ValueParser;
use clap::{Arg, ArgMatches, Command};
use serde_json::{Value, json};

use super::context::Context;
use super::{Verb, args, files, table};
use crate::error::{EditError, Result};
use crate::files::input;
use crate::ops::compare::{Comparison, compare};

/// The command.
pub const VERB: Verb = Verb { name: "compare", build, run };

fn build(command: Command) -> Command {
    let tolerance = |text: &str| match text.parse::<f64>() {
        Ok(value) if value >= 0.0 => Ok(value),
        _ => Err("not a number of voxels, 0 or more".to_owned()),
    };
    let command = command
        .about("Compare two level sets; exit with 1 when they differ by more than --tolerance")
        .arg(args::path("input").value_names(["A", "B"]).num_args(2).required(true).help("A .vdb or a mesh each"))
        .arg(
            Arg::new("tolerance")
                .long("tolerance")
                .value_name("VOXELS")
                .allow_hyphen_values(true)
                .value_parser(ValueParser::new(tolerance))
                .help("Largest difference in the band that is still alike, in voxels [default: any]"),
        );
    args::conversion(args::grids(command), |_| false)
}

fn run(matches: &ArgMatches, context: &Context) -> Result<()> {
    let paths: Vec<PathBuf> = args::paths(matches, "input");
    let mut warnings = Vec::new();
    let inputs = input::load(&paths, &files::input_options(matches)?, &mut warnings, &context.run)?;
    let [a, b] = &inputs[..] else { return Ok(()) };
    let comparison = compare(&a.level_set, &b.level_set, &context.run)?;
    if comparison.resampled {
        warnings.push(format!("{} was resampled to the voxels of {}", b.path.display(), a.path.display()));
    }
    warnings.iter().for_each(|warning| context.reporter.warn(warning));
    let mut value = serde_json::to_value(&comparison).unwrap_or(Value::Null);
    if let Some(object) = value.as_object_mut() {
        object.insert("warnings".into(), json!(warnings));
    }
    context.reporter.result(&value, || text(&comparison))?;
    match matches.get_one::<f64>("tolerance") {
        Some(tolerance) if comparison.max_diff_voxels > *tolerance => Err(EditError::Unmet {
            operation: "compare".into(),
            problem: format!(
                "the largest difference is {} voxels, the tolerance {tolerance}",
                table::number(comparison.max_diff_voxels)
            ),
        }),
        _ => Ok(()),
    }
}

fn text(comparison: &Comparison) -> String {
    let ratio = |ratio: Option<f64>| ratio.map_or("-".into(), |ratio| format!("{ratio:.6}"));
    let voxels = |value: f64| format!("{} voxels", table::number(value));
    let mut rows = vec![
        ("identical", if comparison.identical { "yes" } else { "no" }.into()),
        ("largest difference", voxels(comparison.max_diff_voxels)),
        ("rms difference", voxels(comparison.rms_diff_voxels)),
        ("active only in A", table::count(comparison.active_only_in_a)),
        ("active only in B", table::count(comparison.active_only_in_b)),
    ];
    if let Some(distance) = &comparison.surface_distance {
        rows.push(("surface distance, mean", voxels(distance.mean)));
        rows.push(("surface distance, rms", voxels(distance.rms)));
        rows.push(("surface distance, max", voxels(distance.max)));
    }
    rows.push(("volume of B / A", ratio(comparison.volume_ratio)));
    rows.push(("area of B / A", ratio(comparison.area_ratio)));
    table::pairs(rows)
}
