//! The memory limit: what the process holds counts before work is begun, and is watched while it is done.
//!
//! Work is refused by estimate before it allocates ([`RunOptions::reserve`]). What no estimate foresaw is seen here: the run is cancelled as by a
//! signal when the process holds more than the limit, and ended where it does not look.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crate::error::EditError;
use crate::run::RunOptions;

use super::report::Reporter;
use super::signal;

/// How often it is looked, and how often when more than half of the limit is held. Memory is filled at 1 to 2 GB a second.
const EVERY: Duration = Duration::from_millis(5);
const OFTEN: Duration = Duration::from_millis(1);

/// Part of the limit by which a cancelled run may exceed it on its way out.
const TOLERANCE: u64 = 32;

/// What the process held when it was too much; 0 before.
static EXCEEDED: AtomicU64 = AtomicU64::new(0);

/// Whether the run has ended, in whatever way.
static ENDED: AtomicBool = AtomicBool::new(false);

/// Bytes of the machine's memory that the process holds; 0 where the system does not tell.
pub fn resident() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    kib.unwrap_or(0).saturating_mul(1024)
}

/// From now on the run is cancelled when the process holds more than `run` may, and ended when it goes on taking more.
pub fn watch(run: &RunOptions, reporter: &Reporter) {
    let Some(limit) = run.memory_limit else { return };
    let (cancel, reporter) = (run.cancel_flag(), reporter.clone());
    let work = move || {
        let held = loop {
            match resident() {
                held if held > limit => break held,
                held => std::thread::sleep(if held > limit / 2 { OFTEN } else { EVERY }),
            }
        };
        EXCEEDED.store(held, Ordering::Relaxed);
        cancel.store(true, Ordering::Relaxed);
        let began = Instant::now();
        while began.elapsed() < signal::GRACE && resident() <= limit + limit / TOLERANCE {
            std::thread::sleep(OFTEN);
        }
        if ENDED.load(Ordering::Relaxed) {
            return;
        }
        let error = blamed(EditError::Cancelled { operation: "vdb-edit".into() }, Some(limit));
        reporter.error(&error, error.exit_code());
        signal::leave(error.exit_code());
    };
    // Without a thread the estimates remain.
    let _ = std::thread::Builder::new().name("memory".into()).spawn(work);
}

/// The error of a run that has ended, cancelled perhaps since it took too much.
pub fn ended(error: EditError, limit: Option<u64>) -> EditError {
    ENDED.store(true, Ordering::Relaxed);
    blamed(error, limit)
}

fn blamed(error: EditError, limit: Option<u64>) -> EditError {
    match (error, EXCEEDED.load(Ordering::Relaxed), limit) {
        (EditError::Cancelled { operation }, needed, Some(limit)) if needed > 0 && signal::exit_code().is_none() => {
            let advice = "it was stopped on its way; take a larger voxel size or raise the limit".into();
            EditError::Memory { operation, needed, limit, advice }
        }
        (error, ..) => error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(target_os = "linux")]
    fn the_process_holds_what_it_fills() {
        let before = resident();
        let filled = vec![1u8; 64 << 20];
        let held = resident();
        assert!(before > 0 && held >= before + (60 << 20), "{before} {held} {}", filled.len());
    }
}
