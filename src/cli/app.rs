//! The tree of commands: verbs, and one subcommand for each operator of the registry.

use clap::Command;
use clap::builder::styling::{AnsiColor, Styles};

use super::{VERBS, args, examples, options};
use crate::ops::{Arity, Entry, REGISTRY};

const ABOUT: &str = "Edit surfaces stored as narrow-band level sets in OpenVDB files";

const AFTER_HELP: &str = "\
Meshes are converted on the way in and out, `-` is a .vdb on standard input or output.
Lengths are in world units or voxels as the help says; `3vx` and `0.5wu` say it themselves.
Exit codes: 0 done, 1 a check or comparison failed, 2 usage, 3 input, 4 output, 5 memory, 130/143 cancelled.";

/// The whole command line.
pub fn command() -> Command {
    let styles = Styles::styled()
        .header(AnsiColor::Green.on_default().bold())
        .usage(AnsiColor::Green.on_default().bold())
        .literal(AnsiColor::Cyan.on_default());
    let command = Command::new("vdb-edit")
        .version(env!("CARGO_PKG_VERSION"))
        .about(ABOUT)
        .after_help(AFTER_HELP)
        .subcommand_required(true)
        .arg_required_else_help(true)
        .disable_help_subcommand(false)
        .styles(styles);
    let verbs = VERBS.iter().map(|verb| (verb.build)(Command::new(verb.name)));
    // Operators with a verb of their own have no second command.
    let own = REGISTRY.iter().filter(|entry| VERBS.iter().all(|verb| verb.name != entry.name));
    args::running(command).subcommands(verbs.map(with_example)).subcommands(own.map(operator).map(with_example))
}

/// A subcommand with an example at the end of its help.
fn with_example(command: Command) -> Command {
    match examples::command_of(command.get_name()) {
        Some(example) => command.after_help(format!("Example:\n  {example}")),
        None => command,
    }
}

/// The subcommand of an operator.
fn operator(entry: &Entry) -> Command {
    let help = entry.help();
    let about = help.split("\n\n").next().unwrap_or_default().replace('\n', " ");
    let command = Command::new(options::kebab(entry.name)).about(about).long_about(help);
    let command = options::add(command, entry);
    let own: Vec<String> = entry.parameters().into_iter().map(|p| p.name).collect();
    let own = |id: &str| own.iter().any(|name| name == id);
    let inputs = args::path("input").required(true);
    let command = match entry.arity {
        Arity::Source => command,
        Arity::One => command.arg(inputs.value_name("IN").help("A .vdb, a mesh, or `-`")),
        Arity::Many => {
            command.arg(inputs.value_name("IN").num_args(2..).help("Two or more: each a .vdb, a mesh, or `-`"))
        }
        Arity::BaseAndSolid => {
            let help = "The base, then the texture: each a .vdb, a mesh, or `-`; a mesh as texture gets 256 voxels along its longest axis";
            command.arg(inputs.value_names(["BASE", "TEXTURE"]).num_args(2).help(help))
        }
    };
    let command = match entry.arity {
        Arity::Source => command,
        Arity::One | Arity::Many | Arity::BaseAndSolid => args::conversion(args::grids(command), own),
    };
    args::output(command)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tree_is_consistent() {
        command().debug_assert();
    }

    #[test]
    fn every_command_and_option_has_help() {
        for sub in command().get_subcommands() {
            assert!(sub.get_about().is_some(), "{}", sub.get_name());
            let example =
                sub.get_after_help().unwrap_or_else(|| panic!("{} has no example", sub.get_name())).to_string();
            assert!(example.contains(&format!("vdb-edit {} ", sub.get_name())), "{example}");
            for arg in sub.get_arguments() {
                assert!(
                    arg.get_help().is_some_and(|h| !h.to_string().is_empty()),
                    "{} {}",
                    sub.get_name(),
                    arg.get_id()
                );
            }
        }
    }
}
