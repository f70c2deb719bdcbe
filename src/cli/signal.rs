//! SIGINT and SIGTERM: the first cancels the run, the second ends the process at once.
//!
//! Loops of the library look at the cancel flag many times a second and clean up on their way out. Work that cannot look,
//! such as a file being read by OpenVDB, is given up after [`GRACE`]: temporary files are removed and the process ends.

use std::sync::atomic::{AtomicI32, Ordering};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use crate::atomic;
use crate::error::{EditError, Result};
use crate::run::RunOptions;

/// How long a cancelled run may take to end by itself. Users and farms are promised a second.
pub const GRACE: Duration = Duration::from_millis(800);

/// The first signal that came; 0 before.
static FIRST: AtomicI32 = AtomicI32::new(0);

/// The exit code that a received signal asks for.
pub fn exit_code() -> Option<u8> {
    match FIRST.load(Ordering::Relaxed) {
        0 => None,
        signal => Some(code_of(signal)),
    }
}

fn code_of(signal: i32) -> u8 {
    u8::try_from(128 + signal).unwrap_or(u8::MAX)
}

/// From now on signals cancel `run`.
pub fn watch(run: &RunOptions) -> Result<()> {
    let failed =
        |e: std::io::Error| EditError::Unmet { operation: "watching for signals".into(), problem: e.to_string() };
    let mut signals = Signals::new([SIGINT, SIGTERM]).map_err(failed)?;
    let cancel = run.cancel_flag();
    let work = move || {
        for signal in signals.forever() {
            if FIRST.compare_exchange(0, signal, Ordering::Relaxed, Ordering::Relaxed).is_err() {
                leave(code_of(signal));
            }
            cancel.store(true, Ordering::Relaxed);
            give_up_later(signal);
        }
    };
    std::thread::Builder::new().name("signals".into()).spawn(work).map(drop).map_err(failed)
}

fn give_up_later(signal: i32) {
    let wait = move || {
        std::thread::sleep(GRACE);
        leave(code_of(signal));
    };
    // Without a thread the run still ends by the cancel flag.
    let _ = std::thread::Builder::new().name("grace".into()).spawn(wait);
}

/// Ends the process with an exit code, without running destructors, which must not run while other threads work.
pub fn leave(code: u8) -> ! {
    atomic::remove_unfinished();
    signal_hook::low_level::exit(i32::from(code))
}
