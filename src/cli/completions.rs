//! `completions` and `man`: what shells and manual readers need, made from the tree of commands.

use std::path::PathBuf;

use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use clap_complete::Shell;

use super::context::Context;
use super::{Verb, app, args, pages, report};
use crate::error::{EditError, Result};

/// Shell completions.
pub const COMPLETIONS: Verb = Verb { name: "completions", build: build_completions, run: completions };

/// Manual pages.
pub const MAN: Verb = Verb { name: "man", build: build_man, run: man };

fn build_completions(command: Command) -> Command {
    let shell = Arg::new("shell").required(true).value_parser(value_parser!(Shell)).help("The shell");
    command.about("Print completions for a shell").arg(shell)
}

fn completions(matches: &ArgMatches, _: &Context) -> Result<()> {
    let Some(shell) = matches.get_one::<Shell>("shell").copied() else { return Ok(()) };
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut app::command(), "vdb-edit", &mut script);
    report::print_bytes(&script)
}

fn build_man(command: Command) -> Command {
    let of = Arg::new("command").value_name("COMMAND").help("Of this command alone");
    let folder =
        args::path("output").long("output").short('o').value_name("FOLDER").help("Write all pages into a folder");
    let markdown = Arg::new("markdown").long("markdown").action(ArgAction::SetTrue).requires("output");
    let markdown = markdown.help("Pages of the operators in Markdown, as in docs/operators");
    command.about("Print a manual page").arg(of.conflicts_with("output")).arg(folder).arg(markdown)
}

fn man(matches: &ArgMatches, _: &Context) -> Result<()> {
    let mut whole = app::command();
    whole.build();
    if let Some(folder) = matches.get_one::<PathBuf>("output") {
        if args::flag(matches, "markdown") {
            return pages::write(folder);
        }
        let made = std::fs::create_dir_all(folder).and_then(|()| clap_mangen::generate_to(whole, folder));
        return made.map_err(|e| EditError::output(folder, e.to_string()));
    }
    let page = match matches.get_one::<String>("command") {
        None => whole,
        Some(name) => whole.find_subcommand(name).cloned().ok_or_else(|| {
            let names = whole.get_subcommands().map(Command::get_name);
            EditError::parameter("man", "command", name, crate::spec::suggest(name, names))
        })?,
    };
    let mut text = Vec::new();
    let rendered = clap_mangen::Man::new(page).render(&mut text);
    rendered.map_err(|e| EditError::output("standard output", e.to_string()))?;
    report::print_bytes(&text)
}
