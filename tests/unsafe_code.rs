//! Where there is `unsafe`, and why: each block, function and implementation with its reason just before it, in the files that may have any.

use std::path::{Path, PathBuf};

/// The files, and how often each says the word.
const ALLOWED: [(&str, usize); 5] = [
    ("src/grid/prefetch.rs", 1),
    ("src/stencil/results.rs", 2),
    ("src/vdb/bridge.rs", 9),
    ("src/vdb/write.rs", 9),
    ("tests/steady_state.rs", 5),
];

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap().flatten() {
        let path = entry.path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

/// The code of a line, without its comment and what is in quotes.
fn code(line: &str) -> String {
    let code = line.split("//").next().unwrap_or_default();
    code.split('"').step_by(2).collect()
}

/// Whether the comment or attribute lines just before a line give a reason, or say what a caller has to see to. The foreign
/// functions of the bridge are declared as a whole, and inside an implementation of an unsafe trait its methods are what that promises.
fn has_reason(lines: &[&str], at: usize) -> bool {
    let before = lines[..at].iter().rev().take_while(|line| line.trim_start().starts_with(['/', '#']));
    let said = before.into_iter().any(|line| line.contains("SAFETY:") || line.contains("# Safety"));
    let line = code(lines[at]);
    let is_method = line.starts_with("    unsafe fn") && lines[..at].iter().any(|l| l.starts_with("unsafe impl"));
    said || is_method || line.contains("unsafe extern")
}

#[test]
fn every_unsafe_block_has_its_reason() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = vec![root.join("build.rs")];
    for folder in ["src", "tests", "benches"] {
        sources(&root.join(folder), &mut files);
    }
    let mut found: Vec<(String, usize)> = Vec::new();
    for path in files.into_iter().filter(|path| !path.ends_with("unsafe_code.rs")) {
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        let name = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
        let is_unsafe =
            |line: &str| code(line).split(|c: char| !c.is_alphanumeric() && c != '_').any(|w| w == "unsafe");
        let places: Vec<usize> = (0..lines.len()).filter(|&at| is_unsafe(lines[at])).collect();
        for &at in &places {
            println!("{name}:{}: {}", at + 1, lines[at].trim());
            assert!(has_reason(&lines, at), "{name}:{}: no `// SAFETY:` before `{}`", at + 1, lines[at].trim());
        }
        if !places.is_empty() {
            found.push((name, places.len()));
        }
    }
    found.sort();
    assert_eq!(found, ALLOWED.map(|(name, count)| (name.to_owned(), count)));
}

#[test]
fn a_block_without_a_reason_is_found() {
    let with = ["// SAFETY: nothing happens.", "unsafe {", "}"];
    let without = ["// Fast.", "unsafe {", "}"];
    assert!(has_reason(&with, 1) && !has_reason(&without, 1));
    assert_eq!(code("let a = \"unsafe\"; // unsafe"), "let a = ; ");
}
