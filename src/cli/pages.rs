//! `man --markdown`: a page an operator, from what its help is made of. Those of `docs/operators` are made so.

use std::fmt::Write;
use std::path::Path;

use super::examples::Example;
use super::options;
use crate::error::{EditError, Result};
use crate::ops::{Entry, Parameter, REGISTRY};

/// The list of all pages.
const INDEX: &str = "README.md";

/// Writes all pages into a folder.
pub fn write(folder: &Path) -> Result<()> {
    let failed = |e: std::io::Error| EditError::output(folder, e.to_string());
    std::fs::create_dir_all(folder).map_err(failed)?;
    all().into_iter().try_for_each(|(name, text)| std::fs::write(folder.join(name), text).map_err(failed))
}

/// The pages by the names of their files.
fn all() -> Vec<(String, String)> {
    let mut index = String::from(
        "# Operators\n\nMade by `make pages` from the comments that the help is made of. What all commands have in common is in the [README](../../README.md).\n\n",
    );
    let mut pages = Vec::new();
    for entry in REGISTRY {
        let name = options::kebab(entry.name);
        let about = entry.help().split("\n\n").next().unwrap_or_default().replace('\n', " ");
        let _ = writeln!(index, "- [{name}]({name}.md): {about}");
        pages.push((format!("{name}.md"), page(entry, &name)));
    }
    pages.push((INDEX.into(), index));
    pages
}

fn page(entry: &Entry, name: &str) -> String {
    let mut text = format!("# {name}\n\n{}\n", entry.help());
    if let Some(example) = Example::of(entry.name) {
        let commands = example.commands.join("\n");
        let _ = match example.shows {
            // Its inputs are not part of the project.
            "" => write!(text, "\n```text\n{commands}\n```\n"),
            shows => write!(text, "\n![{shows}](images/{name}.png)\n\n{shows}\n\n```sh\n{commands}\n```\n"),
        };
    }
    text += "\nAs keys of a recipe the parameters are written with `_` for `-` and without the dashes before them.\n\n";
    text += "| parameter | value | default | |\n|---|---|---|---|\n";
    for parameter in entry.parameters() {
        match parameter.sequence() {
            Some(sequence) => {
                for option in sequence.options {
                    let help = option.help.unwrap_or(&parameter.help);
                    row(&mut text, &format!("`--{}`", options::kebab(option.name)), option.value_name, "", help);
                }
            }
            None => {
                let (value, default) = (value_of(&parameter), options::default_of(&parameter).unwrap_or_default());
                row(&mut text, &options::written(entry, &parameter), &value, &default, &parameter.help);
            }
        }
    }
    text
}

fn row(text: &mut String, name: &str, value: &str, default: &str, help: &str) {
    let cell = |words: &str| words.replace('\n', " ").replace('|', "\\|");
    let default = if default.is_empty() { String::new() } else { format!("`{}`", cell(default)) };
    let _ = writeln!(text, "| {name} | {} | {default} | {} |", cell(value), cell(help));
}

/// What a value looks like, and its unit.
fn value_of(parameter: &Parameter) -> String {
    match parameter.kind.as_str() {
        _ if parameter.is_flag => String::new(),
        "string" => "text".into(),
        kind => kind.replace('|', ", "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Largest picture of a page, in bytes.
    const LARGEST: u64 = 60 << 10;

    #[test]
    fn the_pages_of_the_project_are_up_to_date() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/operators");
        let pages = all();
        for (name, text) in &pages {
            let there = std::fs::read_to_string(folder.join(name)).unwrap_or_default();
            assert!(there == *text, "docs/operators/{name} is not what `make pages` writes");
        }
        let files = std::fs::read_dir(&folder).unwrap().flatten().filter(|e| e.path().is_file());
        assert_eq!(files.count(), pages.len());
        for entry in REGISTRY {
            let example = Example::of(entry.name).unwrap_or_else(|| panic!("{} has no example", entry.name));
            let picture = folder.join(format!("images/{}.png", options::kebab(entry.name)));
            let bytes = picture.metadata().map(|facts| facts.len());
            assert_eq!(bytes.is_ok(), !example.shows.is_empty(), "{}", entry.name);
            assert!(bytes.unwrap_or(0) <= LARGEST, "{}", entry.name);
        }
    }
}
