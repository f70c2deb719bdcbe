//! `crosscheck`: our operators and OpenVDB's own tools on the same grid.

use clap::{Arg, ArgAction, ArgMatches, Command};
use serde_json::json;

use super::context::Context;
use super::{Verb, args, files, table};
use crate::crosscheck::{Row, crosscheck, operators};
use crate::error::{EditError, Result};
use crate::files::input;
use crate::mesh::MeshFormat;

/// The command.
pub const VERB: Verb = Verb { name: "crosscheck", build, run };

fn build(command: Command) -> Command {
    let command = command
        .about("Run our operators and OpenVDB's own tools on the same grid, in turn, and compare times and results")
        .long_about(format!(
            "Run our operators and OpenVDB's own tools on the same grid, in turn, and compare times and results; exit with 1 \
             when a result is above its tolerance.\n\nOperators: {}.",
            operators().collect::<Vec<_>>().join(", ")
        ))
        .arg(args::path("input").value_name("IN").required(true).help("A .vdb or a mesh"))
        .arg(
            Arg::new("only")
                .long("only")
                .value_name("OPERATOR")
                .action(ArgAction::Append)
                .value_delimiter(',')
                .help("Only these operators"),
        );
    args::conversion(args::grids(command), |_| false)
}

fn run(matches: &ArgMatches, context: &Context) -> Result<()> {
    let paths = args::paths(matches, "input");
    let mut warnings = Vec::new();
    let inputs = input::load(&paths, &files::input_options(matches)?, &mut warnings, &context.run)?;
    warnings.iter().for_each(|warning| context.reporter.warn(warning));
    let Some(input) = inputs.first() else { return Ok(()) };
    let only: Vec<String> = matches.get_many::<String>("only").into_iter().flatten().cloned().collect();
    let source = match MeshFormat::of(&input.path) {
        Some(_) => Some(input::read_mesh(&input.path, &mut Vec::new())?),
        None => None,
    };
    let rows = crosscheck(&input.level_set, source.as_ref(), &only, &context.run, |_| ())?;
    let value = json!({
        "file": input.path.display().to_string(),
        "active_voxels": input.level_set.grid().active_voxels(),
        "threads": rayon::current_num_threads(),
        "openvdb_version": crate::vdb::library_version(),
        "rows": rows,
        "warnings": warnings,
    });
    context.reporter.result(&value, || text(&rows))?;
    match rows.iter().find(|row| !row.passes()) {
        None => Ok(()),
        Some(row) => Err(EditError::Unmet {
            operation: "crosscheck".into(),
            problem: format!(
                "{}: {} voxels apart, the tolerance is {}",
                row.operator,
                table::number(row.max_diff_voxels),
                table::number(row.tolerance_voxels)
            ),
        }),
    }
}

fn text(rows: &[Row]) -> String {
    let heads = [
        "operator",
        "ours, ms",
        "OpenVDB, ms",
        "ratio",
        "min",
        "max",
        "max diff, voxels",
        "rms",
        "active diff",
        "tolerance",
    ];
    let lines = rows.iter().map(|row| {
        let max = match row.openvdb_max_error_voxels {
            Some(theirs) => format!("{:.1e} (OpenVDB {theirs:.1e})", row.max_diff_voxels),
            None => format!("{:.1e}", row.max_diff_voxels),
        };
        vec![
            row.operator.to_owned(),
            format!("{:.2}", row.ours_ms),
            format!("{:.2}", row.openvdb_ms),
            format!("{:.1}", row.ratio),
            format!("{:.1}", row.ratio_min),
            format!("{:.1}", row.ratio_max),
            max,
            format!("{:.1e}", row.rms_diff_voxels),
            table::count(row.active_diff),
            format!("{:.0e}", row.tolerance_voxels),
        ]
    });
    table::columns(std::iter::once(heads.map(str::to_owned).to_vec()).chain(lines))
}
