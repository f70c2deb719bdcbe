//! Input for parsers that read files: the first byte of the data names the kind, the rest is the file.

use std::path::Path;
use std::sync::LazyLock;

use tempfile::TempDir;
use vdb_edit::run::RunOptions;

/// In memory where that is mounted: a file a run.
static FOLDER: LazyLock<TempDir> = LazyLock::new(|| {
    tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a folder for temporary files")
});

/// Writes what follows the first byte to a file whose extension that byte chooses (`a` the first, `b` the second), and hands it on.
pub fn with_file(data: &[u8], extensions: &[&str], read: impl FnOnce(&Path, &str)) {
    let Some((kind, content)) = data.split_first() else { return };
    let extension = extensions[usize::from(kind.wrapping_sub(b'a')) % extensions.len()];
    let path = FOLDER.path().join("input").with_extension(extension);
    std::fs::write(&path, content).expect("the folder can be written");
    read(&path, extension);
}

/// Options of a run that may not take much memory.
pub fn run() -> RunOptions {
    let mut run = RunOptions::default();
    run.memory_limit = Some(1 << 30);
    run
}
