//! The commands of the documents, run as they stand.
#![cfg(all(unix, feature = "cli", feature = "openvdb"))]

use std::path::Path;
use std::process::{Command, Stdio};

/// The blocks of a document that are marked as `sh` and hold nothing but comments and calls of the command.
fn blocks(document: &str) -> Vec<String> {
    let mut blocks = Vec::new();
    let mut block: Option<String> = None;
    for line in document.lines() {
        match (&mut block, line) {
            (None, "```sh") => block = Some(String::new()),
            (Some(_), "```") => blocks.extend(block.take()),
            (Some(text), line) => *text += &format!("{line}\n"),
            _ => {}
        }
    }
    let ours = |line: &str| line.is_empty() || line.starts_with(['#', ' ']) || line.starts_with("vdb-edit ");
    blocks.retain(|block| block.lines().all(ours));
    blocks
}

/// Runs the blocks of a document in turn, in one folder.
fn run(name: &str, least: usize) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = tempfile::tempdir().unwrap();
    for linked in ["assets", "examples"] {
        std::os::unix::fs::symlink(root.join(linked), folder.path().join(linked)).unwrap();
    }
    let tools = Path::new(env!("CARGO_BIN_EXE_vdb-edit")).parent().unwrap();
    let path = std::env::join_paths(
        std::iter::once(tools.to_path_buf())
            .chain(std::env::split_paths(&std::env::var_os("PATH").unwrap_or_default())),
    );
    let blocks = blocks(&std::fs::read_to_string(root.join(name)).unwrap());
    assert!(blocks.len() >= least, "{name} has {} blocks", blocks.len());
    for block in blocks {
        let mut shell = Command::new("sh");
        shell.args(["-e", "-c", &block]).current_dir(folder.path()).env("PATH", path.as_ref().unwrap());
        let output = shell.stdin(Stdio::null()).output().unwrap();
        assert!(output.status.success(), "{name}:\n{block}\n{}", String::from_utf8_lossy(&output.stderr));
    }
}

#[test]
fn the_tutorial_works() {
    run("docs/TUTORIAL.md", 7);
}

#[test]
fn the_how_tos_work() {
    run("docs/HOWTO.md", 5);
}

#[test]
fn the_readme_works() {
    run("README.md", 1);
}

/// The pages of two operators; all of them, with their pictures, are run by `make nightly`.
#[test]
fn pages_of_operators_work() {
    for name in ["offset", "csg"] {
        run(&format!("docs/operators/{name}.md"), 1);
    }
}

#[test]
#[ignore = "some minutes: part of make nightly"]
fn the_pages_of_all_operators_work() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/operators");
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        let name = entry.file_name().into_string().unwrap();
        // The list, and one whose inputs are not part of the project.
        if name.ends_with(".md") && !["README.md", "reconstruct.md"].contains(&name.as_str()) {
            run(&format!("docs/operators/{name}"), 1);
        }
    }
}
