//! The command: words become operators, results become tables or JSON, errors become one line and an exit code.
//!
//! Operators are found in the registry and get their options from their parameters: a new one needs nothing here. The
//! verbs that are no operators (`Verb`) have a file each. What is said to the user goes through `report`, and nothing
//! below this module prints.

mod app;
mod args;
mod compare;
mod completions;
mod context;
mod convert;
#[cfg(feature = "openvdb")]
mod crosscheck;
mod edit;
mod examples;
mod files;
mod geodesic;
mod info;
mod memory;
mod morph;
mod options;
mod pages;
mod preview;
mod progress;
mod render;
mod report;
mod run;
mod signal;
mod size;
mod table;

use std::process::ExitCode;

use clap::{ArgMatches, Command};

use crate::error::{EditError, Result};
use crate::ops;
use context::Context;
use report::{Format, Reporter};

/// A subcommand that is no operator.
struct Verb {
    name: &'static str,
    /// Its arguments, without the ones that every command has.
    build: fn(Command) -> Command,
    run: fn(&ArgMatches, &Context) -> Result<()>,
}

/// All of them, in the order of the help.
const VERBS: &[Verb] = &[
    info::VERB,
    convert::VERB,
    compare::VERB,
    geodesic::VERB,
    morph::VERB,
    render::VERB,
    #[cfg(feature = "openvdb")]
    crosscheck::VERB,
    run::VERB,
    run::SCHEMA,
    completions::COMPLETIONS,
    completions::MAN,
];

/// Runs the command with the arguments of the process.
pub fn main() -> ExitCode {
    report::no_backtraces();
    let arguments = args::with_repeated_points(std::env::args_os());
    let matches = match app::command().try_get_matches_from(&arguments) {
        Ok(matches) => matches,
        Err(error) => return report::usage(&error, Format::guess(&arguments)),
    };
    let Some((name, matches)) = matches.subcommand() else { return ExitCode::from(2) };
    let reporter = Reporter::new(matches);
    let result = Context::new(matches, reporter.clone()).and_then(|context| {
        signal::watch(&context.run)?;
        memory::watch(&context.run, &reporter);
        let result = dispatch(name, matches, &context);
        context.finish();
        result.map_err(|error| memory::ended(error, context.run.memory_limit))
    });
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // A cancelled run says which signal it was.
            let cancelled = matches!(error, EditError::Cancelled { .. });
            let code = signal::exit_code().filter(|_| cancelled).unwrap_or(error.exit_code());
            reporter.error(&error, code);
            ExitCode::from(code)
        }
    }
}

fn dispatch(name: &str, matches: &ArgMatches, context: &Context) -> Result<()> {
    if let Some(verb) = VERBS.iter().find(|verb| verb.name == name) {
        return (verb.run)(matches, context);
    }
    let entry = ops::REGISTRY.iter().find(|entry| options::kebab(entry.name) == name);
    match entry {
        Some(entry) => edit::run(entry, matches, context),
        None => Err(EditError::parameter("vdb-edit", "command", name, "a command of `vdb-edit --help`")),
    }
}
