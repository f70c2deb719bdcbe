//! Progress of long work: a bar on a terminal, a line a step elsewhere, JSON lines for programs.

use std::io::{IsTerminal, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use clap::ValueEnum;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::json;

use super::report::Format;
use crate::run::Progress;

/// When progress is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum When {
    /// A bar on a terminal, else a line a step.
    Auto,
    /// As `auto`, even with `--quiet`.
    Always,
    /// Not at all.
    Never,
}

/// Shortest time between two JSON lines of one task.
const LINE_INTERVAL: Duration = Duration::from_millis(250);

/// Tasks shorter than this get no line of their own.
const WORTH_A_LINE: Duration = Duration::from_millis(100);

/// How progress is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Style {
    Bar,
    Lines,
    Json,
}

/// The display, or `None` where nothing is to be shown.
pub fn display(when: When, quiet: bool, format: Format) -> Option<Arc<Display>> {
    if when == When::Never || (quiet && when == When::Auto) {
        return None;
    }
    let style = match format {
        Format::Json => Style::Json,
        Format::Text if std::io::stderr().is_terminal() => Style::Bar,
        Format::Text => Style::Lines,
    };
    Some(Arc::new(Display { style, tasks: Mutex::default() }))
}

/// Shows the outermost task; tasks within it count as part of it.
pub struct Display {
    style: Style,
    tasks: Mutex<Tasks>,
}

#[derive(Default)]
struct Tasks {
    /// How many tasks are open.
    depth: usize,
    shown: Option<Shown>,
}

struct Shown {
    name: String,
    total: u64,
    done: u64,
    began: Instant,
    said: Instant,
    bar: Option<ProgressBar>,
}

impl Display {
    fn tasks(&self) -> MutexGuard<'_, Tasks> {
        self.tasks.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes away what is shown.
    pub fn finish(&self) {
        if let Some(bar) = self.tasks().shown.take().and_then(|shown| shown.bar) {
            bar.finish_and_clear();
        }
    }

    /// Runs `say` with no bar in its way.
    pub fn suspended(&self, say: impl FnOnce()) {
        match self.tasks().shown.as_ref().and_then(|shown| shown.bar.as_ref()) {
            Some(bar) => bar.suspend(say),
            None => say(),
        }
    }

    fn line(&self, shown: &Shown, progress: f64) {
        let seconds = shown.began.elapsed().as_secs_f64();
        let mut stderr = std::io::stderr().lock();
        // Nobody is left to be told if standard error is closed.
        let _ = match self.style {
            Style::Bar => Ok(()),
            Style::Lines => writeln!(stderr, "{}: {:.0} % ({seconds:.1} s)", shown.name, progress * 100.0),
            Style::Json => {
                // At the rate so far; unknown before anything is done.
                let left = (progress > 0.0).then(|| seconds * (1.0 - progress) / progress);
                let event = json!({
                    "event": "progress",
                    "task": shown.name,
                    "progress": progress,
                    "seconds": seconds,
                    "seconds_left": left,
                });
                writeln!(stderr, "{event}")
            }
        };
    }
}

impl Shown {
    fn progress(&self) -> f64 {
        if self.total == 0 { 0.0 } else { (self.done as f64 / self.total as f64).min(1.0) }
    }
}

impl Progress for Display {
    fn begin(&self, task: &str, total: u64) {
        let mut tasks = self.tasks();
        tasks.depth += 1;
        if tasks.depth > 1 {
            return;
        }
        let bar = (self.style == Style::Bar).then(|| {
            let (bar, template) = match total {
                0 => (ProgressBar::no_length(), "{msg} {spinner}"),
                _ => (ProgressBar::new(total), "{msg} {wide_bar} {percent:>3} % at {per_sec}, {eta} left"),
            };
            bar.set_draw_target(ProgressDrawTarget::stderr_with_hz(10));
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style);
            }
            bar.with_message(task.to_owned())
        });
        let now = Instant::now();
        let shown = Shown { name: task.to_owned(), total, done: 0, began: now, said: now, bar };
        if self.style == Style::Json {
            self.line(&shown, 0.0);
        }
        tasks.shown = Some(shown);
    }

    fn advance(&self, done: u64) {
        let mut tasks = self.tasks();
        if tasks.depth != 1 {
            return;
        }
        let Some(shown) = &mut tasks.shown else { return };
        shown.done += done;
        if let Some(bar) = &shown.bar {
            bar.set_position(shown.done);
        }
        if self.style == Style::Json && shown.said.elapsed() >= LINE_INTERVAL {
            shown.said = Instant::now();
            self.line(shown, shown.progress());
        }
    }

    fn end(&self) {
        let mut tasks = self.tasks();
        tasks.depth = tasks.depth.saturating_sub(1);
        if tasks.depth > 0 {
            return;
        }
        let Some(shown) = tasks.shown.take() else { return };
        if let Some(bar) = &shown.bar {
            bar.finish_and_clear();
        }
        // A cancelled task ends early: its line says how far it came.
        let progress = if shown.total == 0 { 1.0 } else { shown.progress() };
        if self.style == Style::Json || shown.began.elapsed() >= WORTH_A_LINE {
            self.line(&shown, progress);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tasks_within_a_task_do_not_count() {
        let display = Display { style: Style::Lines, tasks: Mutex::default() };
        display.begin("outer", 4);
        display.advance(1);
        display.begin("inner", 100);
        display.advance(50);
        display.end();
        display.advance(1);
        assert_eq!(display.tasks().shown.as_ref().map(Shown::progress), Some(0.5));
        display.end();
        assert!(display.tasks().shown.is_none());
    }

    #[test]
    fn quiet_and_never_show_nothing() {
        assert!(display(When::Auto, true, Format::Text).is_none());
        assert!(display(When::Never, false, Format::Json).is_none());
        assert!(display(When::Always, true, Format::Json).is_some());
    }
}
