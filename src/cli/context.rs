//! What every command works with: how it is run, and who is told.

use clap::ArgMatches;

use super::args::{IsaChoice, MemoryLimit};
use super::report::{Format, Reporter};
use super::{memory, size};
use crate::error::{EditError, Result};
use crate::files::volume;
use crate::run::RunOptions;
use crate::stencil::simd;

/// How the command is run, and who is told.
pub struct Context {
    /// Cancellation, progress and the memory limit.
    pub run: RunOptions,
    /// Says things to the user.
    pub reporter: Reporter,
}

impl Context {
    /// Sets the process up as the arguments ask: threads, instruction set, logs.
    pub fn new(matches: &ArgMatches, reporter: Reporter) -> Result<Self> {
        let limit = matches.get_one::<MemoryLimit>("memory-limit").map_or_else(size::default_limit, |limit| limit.0);
        let mut run = RunOptions::default().with_memory_in_use(memory::resident);
        run.memory_limit = limit;
        if let Some(display) = reporter.display() {
            run = run.with_progress(display);
        }
        // This thread is one of the pool's: handing every parallel loop over to another thread and waiting for that to wake up
        // doubled the time of short operators. 0 is the number of processors.
        let threads = matches.get_one::<u32>("threads").map_or(0, |n| *n as usize);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).use_current_thread().build_global();
        pool.map_err(|e| EditError::parameter("vdb-edit", "threads", threads, e.to_string()))?;
        if threads > 0 {
            volume::set_threads(threads)?;
        }
        if let Some(isa) = matches.get_one::<IsaChoice>("isa").and_then(|choice| choice.isa()) {
            let chosen = simd::choose(isa);
            if chosen != isa {
                reporter.warn(&format!("this machine has no {isa:?}: {chosen:?} is used"));
            }
        }
        log_to_standard_error(reporter.format());
        Ok(Self { run, reporter })
    }

    /// Takes the progress display away.
    pub fn finish(&self) {
        if let Some(display) = self.reporter.display() {
            display.finish();
        }
    }
}

/// Shows what the library logs: warnings, or what `RUST_LOG` asks for.
fn log_to_standard_error(format: Format) {
    use tracing_subscriber::EnvFilter;
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    // Fails only if a subscriber is there already, and then that one is as good.
    let _ = match format {
        Format::Text => builder.without_time().with_target(false).try_init(),
        Format::Json => builder.json().flatten_event(true).try_init(),
    };
}
