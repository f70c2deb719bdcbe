//! What is read and written, from the arguments of a command.

use std::path::PathBuf;

use clap::ArgMatches;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::args;
use super::context::Context;
use crate::error::{EditError, Result};
use crate::files::input::{self, InputOptions};
use crate::files::mesh_output::MeshParams;
use crate::files::output::{Output, VolumeOptions};

/// How inputs are read, whether the options are the command's own or its operator's.
pub fn input_options(matches: &ArgMatches) -> Result<InputOptions> {
    let grids = matches.try_get_many::<String>("grid").ok().flatten();
    let options = InputOptions {
        grids: grids.map(|names| names.cloned().collect()).unwrap_or_default(),
        assume_level_set: args::flag(matches, "assume-level-set"),
        repair: args::flag(matches, "repair"),
        strict: args::flag(matches, "strict"),
        voxel_size: typed(matches, "voxel_size", "a positive length in world units, such as 0.01")?,
        resolution: typed(matches, "resolution", "a number of voxels, 1 or more, such as 256")?,
        half_width: typed(matches, "half_width", "a number of voxels, such as 3")?,
    };
    options.validate()?;
    Ok(options)
}

fn typed<T: DeserializeOwned>(matches: &ArgMatches, id: &str, accepted: &str) -> Result<Option<T>> {
    let Some(value) = matches.try_get_one::<Value>(id).ok().flatten() else { return Ok(None) };
    let read = serde_json::from_value(value.clone()).map(Some);
    read.map_err(|_| EditError::parameter("convert", id, value.to_string().trim_matches('"'), accepted))
}

/// The output of a command, refused now if it could not be written later.
pub fn output(matches: &ArgMatches, context: &Context) -> Result<Output> {
    let path = matches.get_one::<PathBuf>("output").cloned().unwrap_or_default();
    if input::is_pipe(&path) && context.reporter.wants_json() {
        let accepted = "a file: standard output takes either the .vdb or the --json result";
        return Err(EditError::parameter("vdb-edit", "output", "-", accepted));
    }
    let number = |id: &str| matches.try_get_one::<f64>(id).ok().flatten().copied();
    let mesh = MeshParams {
        simplify: number("simplify"),
        adaptivity: number("adaptivity"),
        quads: args::flag(matches, "quads"),
        attributes_from: args::paths(matches, "attributes-from").pop(),
    };
    Output::plan(path, volume_options(matches), &mesh)
}

/// How a `.vdb` is to be written.
pub fn volume_options(matches: &ArgMatches) -> VolumeOptions {
    let word = |id: &str| matches.get_one::<String>(id).cloned();
    VolumeOptions {
        half: word("precision").map(|word| word == "half"),
        compression: word("compression"),
        only_result: args::flag(matches, "only-result"),
    }
}
