//! `convert`: meshes to level sets, level sets to meshes, and either to another file of its kind.

use std::path::PathBuf;
use std::time::Instant;

use clap::builder::ValueParser;
use clap::{Arg, ArgAction, ArgMatches, Command};
use serde_json::{Map, Value, json};

use super::context::Context;
use super::edit::{self, Edit};
use super::preview::Preview;
use super::{Verb, args, files, options};
use crate::error::{EditError, Result};
use crate::files::input;
use crate::files::mesh_output::attributes_of;
use crate::files::output::{Output, Written};
use crate::mesh::{MeshFormat, Rebuild, rebuild};
use crate::ops::{Summary, WorldLength};
use crate::scan::Inside;

/// The command.
pub const VERB: Verb = Verb { name: "convert", build, run };

fn build(command: Command) -> Command {
    let command = command
        .about("Turn meshes into level sets, level sets into meshes, and either into another file of its kind")
        .long_about(
            "Turn meshes into level sets, level sets into meshes, and either into another file of its kind.\n\n\
             A mesh becomes a mesh directly, unless a voxel size or resolution is given or an option needs a level set \
             (--iso, --adaptivity, --quads): then by way of one.",
        )
        .arg(args::path("input").value_name("IN").required(true).help("A .vdb, a mesh, a scan (.nrrd, .nhdr, .nii, .nii.gz; with --iso), or `-`"))
        .arg(
            Arg::new("iso")
                .long("iso")
                .value_name("LENGTH")
                .allow_hyphen_values(true)
                .value_parser(ValueParser::new(options::length))
                .help(
                    "The surface at this distance, positive outside, in world units (or `1vx`) [default: 0]; of a volume or scan that is no level set: at this value, inside is above (densities)",
                ),
        )
        .arg(
            Arg::new("invert")
                .long("invert")
                .action(ArgAction::SetTrue)
                .requires("iso")
                .help("Of a volume that is no level set: inside is where its values are below --iso, not above"),
        )
        .arg(
            Arg::new("simplify")
                .long("simplify")
                .value_name("RATIO")
                .value_parser(ValueParser::new(ratio))
                .help("To meshes: keep this part of the triangles, above 0 up to 1, where the surface bends most"),
        )
        .arg(
            Arg::new("adaptivity")
                .long("adaptivity")
                .value_name("A")
                .value_parser(ValueParser::new(adaptivity))
                .conflicts_with("simplify")
                .help("To meshes: larger triangles where it is flat; none of the vertices left out is farther than A voxels, 0..1, from the result [default: 0]"),
        )
        .arg(
            Arg::new("quads")
                .long("quads")
                .action(ArgAction::SetTrue)
                .conflicts_with_all(["simplify", "adaptivity"])
                .help("To meshes: quads (.obj, .ply, .off) instead of triangles"),
        );
    args::output(args::conversion(args::grids(command), |_| false))
}

fn ratio(text: &str) -> Result<f64, String> {
    let value: Option<f64> = text.trim().parse().ok();
    value.filter(|r| *r > 0.0 && *r <= 1.0).ok_or_else(|| "a part above 0, up to 1, is wanted".into())
}

fn adaptivity(text: &str) -> Result<f64, String> {
    let value: Option<f64> = text.trim().parse().ok();
    value.filter(|a| (0.0..=1.0).contains(a)).ok_or_else(|| "a number of voxels from 0 to 1 is wanted".into())
}

fn run(matches: &ArgMatches, context: &Context) -> Result<()> {
    let began = Instant::now();
    let paths: Vec<PathBuf> = args::paths(matches, "input");
    let Some(path) = paths.first() else { return Ok(()) };
    let input_options = files::input_options(matches)?;
    let output = files::output(matches, context)?;
    let preview = Preview::plan(matches)?;
    let iso = matches.get_one::<Value>("iso").cloned();
    if args::flag(matches, "dry-run") {
        let lines = match input::probe(&paths, &input_options) {
            // A volume that is no level set is what --iso is for.
            Err(_) if iso.is_some() && path.exists() => vec![format!("{}: a volume", path.display())],
            lines => lines?,
        };
        return edit::dry_run("convert", Map::new(), &lines, &output, context);
    }
    let needs_level_set = input_options.has_size() || iso.is_some() || output.mesh().needs_level_set();
    if MeshFormat::of(path).is_some() && output.is_mesh() && !needs_level_set {
        return mesh_to_mesh(path, &output, began, context);
    }
    let mut warnings = Vec::new();
    let of_volume = match iso.as_ref().and_then(Value::as_f64) {
        Some(iso) => {
            let inside = if args::flag(matches, "invert") { Inside::Below } else { Inside::Above };
            input::load_iso(path, &input_options, iso as f32, inside, &mut warnings, &context.run)?
        }
        None => None,
    };
    let is_volume = of_volume.is_some();
    if args::flag(matches, "invert") && !is_volume {
        let accepted = "a volume that is no level set; `--iso` of a level set is a distance, which has one inside";
        return Err(EditError::parameter("convert", "invert", "true", accepted));
    }
    let inputs = match of_volume {
        Some(input) => vec![input],
        None => input::load(&paths, &input_options, &mut warnings, &context.run)?,
    };
    let Some(mut level_set) = inputs.first().map(|input| input.level_set.clone()) else { return Ok(()) };
    let mut at = match iso.map(serde_json::from_value::<WorldLength>) {
        Some(Ok(length)) if !is_volume => length.world(level_set.voxel_size()) as f32,
        _ => 0.0,
    };
    if at != 0.0 && !output.is_mesh() {
        let what = Rebuild { iso: at, ..Rebuild::band(level_set.half_width()) };
        level_set = rebuild(&level_set, &what, &context.run)?;
        at = 0.0;
    }
    let summary = Summary { warnings, ..Summary::default() };
    let edit = Edit { operation: "convert", inputs, measured_before: None, level_set, summary, iso: at, began };
    edit.finish(&output, &preview, args::flag(matches, "check"), context)
}

/// The same mesh in another format.
fn mesh_to_mesh(path: &std::path::Path, output: &Output, began: Instant, context: &Context) -> Result<()> {
    let mut warnings = Vec::new();
    let mesh = input::read_mesh(path, &mut warnings)?;
    // Attributes go with the vertices, unless the format has no room for them.
    let is_kept = MeshFormat::of(&output.path).is_some_and(MeshFormat::has_attributes);
    let lost = attributes_of(&mesh).filter(|_| !is_kept);
    warnings.extend(lost.and_then(|attributes| output.mesh().loss(path, attributes, &output.path)));
    let written = output.write_mesh(mesh, &context.run).map_err(|error| input::naming(path, error))?;
    let Written { bytes, details, warnings: more } = written;
    warnings.extend(more);
    for warning in &warnings {
        context.reporter.warn(warning);
    }
    let seconds = began.elapsed().as_secs_f64();
    let mut value = json!({
        "operation": "convert", "inputs": [path.display().to_string()], "output": output.path.display().to_string(),
        "bytes": bytes, "seconds": seconds, "warnings": warnings,
    });
    if let Some(object) = value.as_object_mut() {
        object.extend(details.clone());
    }
    context.reporter.result(&value, || {
        let details: Vec<String> =
            details.iter().map(|(name, value)| format!("{} {value}", name.replace('_', " "))).collect();
        format!("{}: {} in {seconds:.2} s\n", output.path.display(), details.join(", "))
    })
}
