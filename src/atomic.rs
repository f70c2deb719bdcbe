//! Files that appear whole or not at all.
//!
//! The new content goes to a temporary file in the target's folder, is flushed to the disk and then renamed over the
//! target, which POSIX and Windows do atomically. Whatever fails before the rename leaves the old file as it was and
//! the temporary file is removed. A target that is a symbolic link is followed, so the link stays and the file behind
//! it is replaced.
//!
//! A process that is killed leaves its temporary file behind. It held a lock on it, which ended with it: the next one that writes
//! into the folder removes temporary files that nobody holds.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tempfile::NamedTempFile;

use crate::{EditError, Result};

/// As many links as Linux follows before it calls them a loop.
const MAX_LINKS: usize = 40;

/// How the names of temporary files begin.
const PREFIX: &str = ".vdb-edit-";

/// Age from which a temporary file without a lock counts as abandoned: a new one is locked only after it was made.
const ABANDONED: Duration = Duration::from_secs(60);

/// Replaces `path` by what `write` produces, or leaves it alone.
///
/// The writer is buffered. An [`EditError`] that `write` wraps by [`io::Error::other`] (a cancellation, say) comes back
/// as it was; every other failure is an [`EditError::Output`]. Devices and pipes cannot be renamed over: they are
/// written to directly.
pub fn write_atomically(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<()> {
    // Asked of the path as given: links like /dev/stdout may lead to names that only the kernel can follow.
    if fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir()) {
        let device = File::options().write(true).open(path).map_err(|e| failed(path, e))?;
        let mut buffered = BufWriter::new(device);
        return write(&mut buffered).and_then(|()| buffered.flush()).map_err(|e| failed(path, e));
    }
    replace(path, &final_target(path)?, |file| {
        let mut buffered = BufWriter::with_capacity(1 << 16, file.as_file_mut());
        write(&mut buffered).and_then(|()| buffered.flush()).map_err(|e| failed(path, e))
    })
}

/// Replaces `path` by the file that `produce` fills, for libraries that want a path and not a writer.
///
/// `produce` gets the path of an empty temporary file, in the target's folder and with its extension. It may read the
/// file back before it returns: only then is it renamed.
pub fn replace_atomically(path: &Path, produce: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
    let target = final_target(path)?;
    replace(path, &target, |file| produce(file.path()))
}

/// Files that appear together: each is written beside its place first, and [`commit`](Self::commit) renames them all. Without it
/// nothing is left of them.
#[derive(Default)]
pub struct Staging(Vec<Pending>);

impl Staging {
    /// Where the file that is to be at `path` is written until then: in the same folder, with the same extension. Devices and
    /// pipes are themselves.
    pub fn place(&mut self, path: &Path) -> Result<PathBuf> {
        if fs::metadata(path).is_ok_and(|m| !m.is_file() && !m.is_dir()) {
            return Ok(path.into());
        }
        let pending = Pending::new(path, &final_target(path)?)?;
        let place = pending.file.path().to_path_buf();
        self.0.push(pending);
        Ok(place)
    }

    /// Renames all of them, in the order in which they were asked for.
    pub fn commit(self) -> Result<()> {
        self.0.into_iter().try_for_each(Pending::finish)
    }
}

/// The steps that the faces share: refuse early, create, fill, flush, rename.
fn replace(path: &Path, target: &Path, fill: impl FnOnce(&mut NamedTempFile) -> Result<()>) -> Result<()> {
    let mut pending = Pending::new(path, target)?;
    fill(&mut pending.file)?;
    pending.finish()
}

/// A file on its way to its place.
struct Pending {
    /// As it was asked for.
    path: PathBuf,
    target: PathBuf,
    file: NamedTempFile,
    /// Of the file that it replaces.
    permissions: Option<fs::Permissions>,
    _unfinished: Unfinished,
}

impl Pending {
    fn new(path: &Path, target: &Path) -> Result<Self> {
        let permissions = match fs::metadata(target) {
            Ok(metadata) if metadata.is_dir() => return Err(EditError::output(path, "it is a folder, not a file")),
            Ok(metadata) if !metadata.is_file() => {
                return Err(EditError::output(path, "it is a device or a pipe; a regular file would work"));
            }
            Ok(metadata) if metadata.permissions().readonly() => {
                return Err(EditError::output(path, "the existing file is read-only"));
            }
            Ok(metadata) => Some(metadata.permissions()),
            Err(_) => None,
        };
        let suffix = target.extension().map(|e| format!(".{}", e.to_string_lossy())).unwrap_or_default();
        let (_unfinished, file) = temporary_in(folder_of(target), &suffix).map_err(|e| failed(path, e))?;
        Ok(Self { path: path.into(), target: target.into(), file, permissions, _unfinished })
    }

    fn finish(self) -> Result<()> {
        let Self { path, target, file, permissions, _unfinished } = self;
        // Reopened by name: whoever filled it may have replaced the file by another one.
        let flushed = File::open(file.path()).and_then(|f| f.sync_all());
        flushed.map_err(|e| failed(&path, e))?;
        if let Some(permissions) = permissions {
            fs::set_permissions(file.path(), permissions).map_err(|e| failed(&path, e))?;
        }
        file.persist(&target).map_err(|e| failed(&path, e.error))?;
        // The rename itself is durable once the folder is; not every file system lets a folder be synchronised.
        #[cfg(unix)]
        if let Ok(folder) = File::open(folder_of(&target)) {
            let _ = folder.sync_all();
        }
        Ok(())
    }
}

/// A new temporary file in a folder, and what notes it for [`remove_unfinished`] and is to outlive it.
pub(crate) fn temporary_in(folder: &Path, suffix: &str) -> io::Result<(Unfinished, NamedTempFile)> {
    remove_abandoned(folder);
    let mut builder = tempfile::Builder::new();
    builder.prefix(PREFIX).suffix(suffix);
    // Temporary files are private (0600) by default; a result should be as readable as any file the user creates.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    // Made and noted at once: a process that ends in between would leave it.
    let mut unfinished = UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner);
    let file = builder.tempfile_in(folder)?;
    unfinished.push(file.path().into());
    // Where files cannot be locked, abandoned ones stay.
    let _ = file.as_file().try_lock();
    Ok((Unfinished(file.path().into()), file))
}

/// Removes the temporary files of a folder that processes left when they were killed. What cannot be removed stays.
fn remove_abandoned(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    let is_ours = |entry: &fs::DirEntry| entry.file_name().to_string_lossy().starts_with(PREFIX);
    for entry in entries.flatten().filter(is_ours) {
        let age = entry.metadata().and_then(|m| m.modified()).map(|time| time.elapsed().unwrap_or_default());
        let path = entry.path();
        if age.is_ok_and(|age| age > ABANDONED) && File::open(&path).is_ok_and(|file| file.try_lock().is_ok()) {
            let _ = fs::remove_file(path);
        }
    }
}

/// Temporary files that are being filled.
static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// That a temporary file is noted for [`remove_unfinished`].
pub(crate) struct Unfinished(PathBuf);

impl Drop for Unfinished {
    fn drop(&mut self) {
        UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner).retain(|path| *path != self.0);
    }
}

/// Removes all temporary files that are being filled: for a process that is about to end without unwinding. Nobody can make one afterwards.
pub fn remove_unfinished() {
    let mut unfinished = UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner);
    for path in unfinished.drain(..) {
        // One that has just been renamed is no longer there, and its target is complete.
        let _ = fs::remove_file(path);
    }
    std::mem::forget(unfinished);
}

fn folder_of(target: &Path) -> &Path {
    match target.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// The file behind a chain of symbolic links; it need not exist yet.
pub(crate) fn final_target(path: &Path) -> Result<PathBuf> {
    if path.file_name().is_none() {
        return Err(EditError::output(path, "it is a folder, not a file"));
    }
    let mut target = path.to_path_buf();
    for _ in 0..MAX_LINKS {
        match fs::symlink_metadata(&target) {
            Ok(metadata) if metadata.is_symlink() => {
                let link = fs::read_link(&target).map_err(|e| failed(path, e))?;
                target = folder_of(&target).join(link);
            }
            _ => return Ok(target),
        }
    }
    Err(EditError::output(path, "its symbolic links form a loop"))
}

fn failed(path: &Path, error: io::Error) -> EditError {
    error.downcast::<EditError>().unwrap_or_else(|e| EditError::output(path, e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn abandoned_files_are_removed_and_no_others() {
        let folder = tempfile::tempdir().unwrap();
        let long_ago = std::time::SystemTime::now() - 2 * ABANDONED;
        let make = |name: &str, time| {
            let file = File::create(folder.path().join(name)).unwrap();
            file.set_modified(time).unwrap();
            file
        };
        drop(make(".vdb-edit-dead.vdb", long_ago));
        drop(make(".vdb-edit-new.vdb", std::time::SystemTime::now()));
        drop(make("mine.vdb", long_ago));
        let held = make(".vdb-edit-held.vdb", long_ago);
        held.try_lock().unwrap();
        write_atomically(&folder.path().join("out"), |w| w.write_all(b"new")).unwrap();
        assert_eq!(names(folder.path()), [".vdb-edit-held.vdb", ".vdb-edit-new.vdb", "mine.vdb", "out"]);
    }

    #[test]
    fn replaces_the_whole_content() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        fs::write(&path, "a much longer old content").unwrap();
        write_atomically(&path, |w| w.write_all(b"new")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        replace_atomically(&path, |temporary| {
            assert_eq!(temporary.extension(), path.extension());
            fs::write(temporary, "newer").map_err(|e| EditError::output(temporary, e.to_string()))
        })
        .unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"newer");
        assert_eq!(names(folder.path()), ["a.txt"]);
    }

    #[test]
    fn a_failure_half_way_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        fs::write(&path, "old").unwrap();
        let error = write_atomically(&path, |w| {
            w.write_all(&[0; 1 << 20])?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        })
        .unwrap_err();
        assert!(matches!(error, EditError::Output { .. }), "{error}");
        let cancelled = EditError::Cancelled { operation: "write".into() };
        let error = write_atomically(&path, |_| Err(io::Error::other(cancelled))).unwrap_err();
        assert!(matches!(error, EditError::Cancelled { .. }), "{error}");
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(names(folder.path()), ["a.txt"]);
    }

    #[test]
    fn staged_files_appear_together_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::write(path("a.txt"), "old").unwrap();
        let stage = |staging: &mut Staging| {
            for name in ["a.txt", "b.txt"] {
                let place = staging.place(&path(name)).unwrap();
                write_atomically(&place, |w| w.write_all(b"new")).unwrap();
            }
        };
        let mut staging = Staging::default();
        stage(&mut staging);
        drop(staging);
        assert_eq!(fs::read(path("a.txt")).unwrap(), b"old");
        assert_eq!(names(folder.path()), ["a.txt"]);
        let mut staging = Staging::default();
        stage(&mut staging);
        staging.commit().unwrap();
        assert_eq!(fs::read(path("a.txt")).unwrap(), b"new");
        assert_eq!(names(folder.path()), ["a.txt", "b.txt"]);
    }

    #[test]
    fn folders_and_missing_folders_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        for path in [folder.path().to_path_buf(), folder.path().join("missing/a.txt"), PathBuf::from("/")] {
            let error = write_atomically(&path, |_| Ok(())).unwrap_err();
            assert!(matches!(error, EditError::Output { .. }), "{error}");
        }
        assert_eq!(names(folder.path()), Vec::<String>::new());
    }

    #[cfg(unix)]
    #[test]
    fn permissions_of_the_old_file_are_kept_and_new_files_are_not_private() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        let (new, plain) = (folder.path().join("new"), folder.path().join("plain"));
        write_atomically(&new, |_| Ok(())).unwrap();
        fs::write(&plain, "").unwrap();
        assert_eq!(mode(&new), mode(&plain));
        fs::set_permissions(&new, fs::Permissions::from_mode(0o640)).unwrap();
        write_atomically(&new, |_| Ok(())).unwrap();
        assert_eq!(mode(&new), 0o640);
        fs::set_permissions(&new, fs::Permissions::from_mode(0o444)).unwrap();
        assert!(write_atomically(&new, |_| Ok(())).unwrap_err().to_string().contains("read-only"));
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_stay_links() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().unwrap();
        let (link, file) = (folder.path().join("link"), folder.path().join("file"));
        symlink("file", &link).unwrap();
        write_atomically(&link, |w| w.write_all(b"first")).unwrap();
        write_atomically(&link, |w| w.write_all(b"second")).unwrap();
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(fs::read(&file).unwrap(), b"second");
        symlink("loop", folder.path().join("loop")).unwrap();
        let error = write_atomically(&folder.path().join("loop"), |_| Ok(())).unwrap_err();
        assert!(error.to_string().contains("loop"), "{error}");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn devices_are_written_to_and_what_cannot_be_written_is_an_output_error() {
        write_atomically(Path::new("/dev/null"), |w| w.write_all(b"x")).unwrap();
        let error = write_atomically(Path::new("/proc/not-here.ply"), |w| w.write_all(b"x")).unwrap_err();
        assert_eq!(error.exit_code(), 4, "{error}");
        let error = write_atomically(Path::new("/dev/full"), |w| w.write_all(b"x")).unwrap_err();
        assert_eq!(error.exit_code(), 4, "{error}");
    }
}
