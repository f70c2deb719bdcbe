//! What several tests need: the shared data, and the command run under a time limit and watched for its memory.
#![allow(dead_code)] // not every test uses all of it

use std::ffi::OsStr;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// A folder of the shared test data, or `None` (said on standard error) where it is not at hand.
pub fn shared(folder: &str) -> Option<PathBuf> {
    let root = std::env::var_os("VDB_EDIT_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let path = root.join("data").join(folder);
    if path.is_dir() {
        return Some(path);
    }
    eprintln!("SKIPPED: {} is absent", path.display());
    None
}

/// The names of the files of a folder, sorted.
pub fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// How the command ended.
pub struct Ended {
    pub status: ExitStatus,
    pub out: String,
    pub err: String,
    /// Most memory that it was seen to hold, in bytes; 0 where the system does not tell.
    pub peak_bytes: u64,
}

impl Ended {
    /// The exit code; a signal has none.
    pub fn code(&self) -> Option<i32> {
        self.status.code()
    }

    /// Standard output as JSON.
    #[track_caller]
    pub fn json(&self) -> serde_json::Value {
        serde_json::from_str(&self.out).unwrap_or_else(|e| panic!("{e} in the output {}\n{}", self.out, self.err))
    }
}

/// Runs the command; fails if it takes longer than `limit`, panics, or ends by a signal.
#[track_caller]
pub fn vdb_edit<S: AsRef<OsStr>>(words: &[S], folder: &Path, limit: Duration) -> Ended {
    let said: Vec<_> = words.iter().map(|w| w.as_ref().to_string_lossy()).collect();
    let said = said.join(" ");
    let mut child = Command::new(env!("CARGO_BIN_EXE_vdb-edit"))
        .args(words)
        .current_dir(folder)
        .env("RUST_BACKTRACE", "1")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let (out, err) = (drain(child.stdout.take()), drain(child.stderr.take()));
    let began = Instant::now();
    let mut peak_bytes = 0;
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        peak_bytes = peak_bytes.max(peak_of(child.id()));
        if began.elapsed() > limit {
            child.kill().unwrap();
            child.wait().unwrap();
            panic!("`{said}` took longer than {limit:?}: {}", err.join().unwrap());
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    let ended = Ended { status, out: out.join().unwrap(), err: err.join().unwrap(), peak_bytes };
    assert!(ended.code().is_some_and(|code| code <= 5), "`{said}` ended with {status}: {}", ended.err);
    assert!(!ended.err.contains("panicked") && !ended.err.contains("backtrace"), "`{said}`: {}", ended.err);
    ended
}

fn drain(pipe: Option<impl Read + Send + 'static>) -> std::thread::JoinHandle<String> {
    let mut pipe = pipe.unwrap();
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        pipe.read_to_end(&mut bytes).unwrap();
        String::from_utf8_lossy(&bytes).into_owned()
    })
}

/// Peak resident memory of a running process, by `/proc`.
fn peak_of(process: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|line| line.trim().strip_suffix(" kB")?.parse::<u64>().ok());
    kilobytes.unwrap_or(0) * 1024
}
