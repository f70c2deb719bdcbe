//! `geodesic`: distance along the surface, as a float grid on the band or as vertex colour.

use std::path::PathBuf;
use std::time::Instant;

use clap::builder::ValueParser;
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command};
use glam::DVec3;
use serde_json::{Map, json};

use super::context::Context;
use super::{Verb, args, edit, files, table};
use crate::error::{EditError, Result};
use crate::files::output::Written;
use crate::files::{input, volume};
use crate::mesh::level_set_to_mesh;
use crate::ops::Vector;
use crate::render::distance_colors;

/// The command.
pub const VERB: Verb = Verb { name: "geodesic", build, run };

/// The name of the grid.
const GRID: &str = "geodesic";

fn build(command: Command) -> Command {
    let command = command
        .about("Measure the distance along the surface from points on it")
        .long_about(
            "Measure the distance along the surface from points on it.\n\n\
             A .vdb gets the distances as a float grid on the band, after all that the input file holds; a mesh gets them as vertex colour, from dark blue at the points to yellow at the farthest. \
             What cannot be reached has no value in the grid and is grey in the mesh.",
        )
        .arg(args::path("input").value_name("IN").required(true).help("A .vdb, a mesh, or `-`"))
        .arg(
            Arg::new("from")
                .long("from")
                .value_name("X,Y,Z")
                .action(ArgAction::Append)
                .required(true)
                .allow_hyphen_values(true)
                .value_parser(ValueParser::new(|text: &str| text.parse::<Vector>()))
                .help("A point on the surface or within the band around it; of several, one behind the other, the nearest counts"),
        );
    let command = args::output(args::conversion(args::grids(command), |_| false));
    OF_LEVEL_SETS.iter().fold(command, |command, id| command.mut_arg(id, |arg| arg.hide(true)))
}

/// Options of results that are level sets, which this one is not.
const OF_LEVEL_SETS: [&str; 6] = ["check", "preview", "only-result", "attributes-from", "precision", "compression"];

fn run(matches: &ArgMatches, context: &Context) -> Result<()> {
    let began = Instant::now();
    let paths: Vec<PathBuf> = args::paths(matches, "input");
    let options = files::input_options(matches)?;
    let given = |id: &&&str| matches.value_source(id) == Some(ValueSource::CommandLine);
    if let Some(id) = OF_LEVEL_SETS.iter().find(given) {
        let accepted = "only where a level set is written; this writes distances beside it";
        return Err(EditError::parameter(VERB.name, id, "given", accepted));
    }
    let output = files::output(matches, context)?;
    let from: Vec<DVec3> = matches.get_many::<Vector>("from").into_iter().flatten().map(|v| v.0).collect();
    if args::flag(matches, "dry-run") {
        let values =
            Map::from_iter([("from".to_owned(), json!(from.iter().map(|p| p.to_array()).collect::<Vec<_>>()))]);
        return edit::dry_run(VERB.name, values, &input::probe(&paths, &options)?, &output, context);
    }
    let mut warnings = Vec::new();
    // The grid that the level set was read from is written as well.
    let loaded = input::load_whole(&paths, &options, &mut warnings, &context.run)?;
    let Some(input) = loaded.first() else { return Ok(()) };
    let found = input.level_set.geodesic(&from, &context.run)?;
    let field = found.reached();
    let farthest = field.range().map_or(0.0, |(_, most)| most);
    if found.unreachable > 0 {
        let how = if output.is_mesh() { "grey" } else { "left without a value" };
        warnings.push(format!("{} voxels cannot be reached along the surface: {how}", table::count(found.unreachable)));
    }
    let Written { bytes, warnings: more, details } = if output.is_mesh() {
        let mut mesh = level_set_to_mesh(&input.level_set, 0.0, &context.run)?;
        mesh.colors = Some(distance_colors(&mesh.positions, &field, farthest.into()));
        output.write_mesh(mesh, &context.run)?
    } else {
        let to_write = volume::FieldToWrite { field: &field, name: GRID };
        let volume = input.from().map(|(volume, _)| volume);
        let (bytes, warnings) = volume::write_field(&output.path, &input.level_set, to_write, volume)?;
        Written { bytes: Some(bytes), warnings, ..Written::default() }
    };
    warnings.extend(more);
    for warning in &warnings {
        context.reporter.warn(warning);
    }
    let seconds = began.elapsed().as_secs_f64();
    let path = output.path.display().to_string();
    let mut value = json!({
        "operation": VERB.name, "inputs": [input.path.display().to_string()], "output": path, "grid": GRID,
        "bytes": bytes, "seconds": seconds, "voxels": field.grid().active_voxels(),
        "unreachable_voxels": found.unreachable, "farthest": farthest, "warnings": warnings,
    });
    if let Some(object) = value.as_object_mut() {
        object.extend(details);
    }
    let text = || format!("{path}: {GRID} in {seconds:.2} s, farthest {}\n", table::number(farthest.into()));
    if output.is_pipe() {
        context.reporter.result_beside_output(text);
        return Ok(());
    }
    context.reporter.result(&value, text)
}
