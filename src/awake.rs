//! Threads kept awake through work of many short parallel parts.
//!
//! A step of a region is some fifteen parallel parts of less than half a millisecond with a little serial work between them. Rayon's threads go to
//! sleep after a few microseconds without work, and to wake one takes as long as a good part of such a part: see
//! `docs/PERFORMANCE.md`.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How long a thread looks for work before it may sleep. Beside a longer serial part, waking it takes next to nothing.
const PATIENCE: Duration = Duration::from_micros(200);

/// Most threads that are kept awake. Each is called by itself, and what that costs with many was not measured.
const MOST_THREADS: usize = 8;

/// Whether some work keeps the threads awake already.
static KEPT: AtomicBool = AtomicBool::new(false);

/// Runs `work` on the calling thread. Meanwhile the other threads of rayon's pool look for what it hands out without going to sleep.
pub fn awake<R>(work: impl FnOnce() -> R) -> R {
    if !(2..=MOST_THREADS).contains(&rayon::current_num_threads()) || KEPT.swap(true, Ordering::Relaxed) {
        return work();
    }
    // Nobody waits for the others: one that is busy with something else comes when all is done, and leaves at once.
    let done = Arc::new(AtomicBool::new(false));
    let caller = rayon::current_thread_index();
    let seen = done.clone();
    rayon::spawn_broadcast(move |thread| {
        // The caller comes by here while it waits for work that it handed out.
        if Some(thread.index()) != caller {
            look_for_work(&seen);
        }
    });
    // The search ends when the work panics, too.
    let _end = End(done);
    work()
}

/// Does what there is to do until `done`, or until there has been nothing for long.
fn look_for_work(done: &AtomicBool) {
    let mut last = Instant::now();
    while !done.load(Ordering::Relaxed) && last.elapsed() < PATIENCE {
        match rayon::yield_now() {
            Some(rayon::Yield::Executed) => last = Instant::now(),
            // Other processes may have the core.
            _ => std::thread::yield_now(),
        }
    }
}

/// Says that the work is done.
struct End(Arc<AtomicBool>);

impl Drop for End {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
        KEPT.store(false, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;

    #[test]
    fn work_within_work_and_work_that_panics_come_to_their_end() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        let sum = |n: u64| awake(|| (0..n).into_par_iter().sum::<u64>());
        for _ in 0..100 {
            let sums: Vec<u64> =
                pool.install(|| awake(|| (0..20).into_par_iter().map(|n| sum(n) + sum(1000)).collect()));
            assert!(sums.iter().zip(0u64..).all(|(sum, n)| *sum == n * n.saturating_sub(1) / 2 + 499_500));
        }
        let fails = std::panic::AssertUnwindSafe(|| awake(|| panic!("on purpose")));
        assert!(pool.install(|| std::panic::catch_unwind(fails)).is_err());
        assert_eq!(pool.install(|| sum(10)), 45);
        // From a thread that is not one of the pool.
        assert_eq!(sum(10), 45);
    }
}
