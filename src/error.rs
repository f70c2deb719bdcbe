//! What can go wrong, said so that the reader knows what to do next.
//!
//! One error type for the whole library. Each variant names the operation or file, the value that cannot work and what
//! would be accepted; [`EditError::exit_code`] is the exit status of the command (the table of the manual).

use std::fmt;
use std::path::{Path, PathBuf};

/// The library's result.
pub type Result<T, E = EditError> = std::result::Result<T, E>;

/// Everything that the library refuses or fails at.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EditError {
    /// A parameter that cannot work, refused before any work is done.
    #[error("{operation}: {field} = {value} cannot work: {accepted}")]
    Parameter {
        /// The operator or command.
        operation: String,
        /// The parameter, spelled as in the library (`voxel_size`).
        field: String,
        /// The value that was given.
        value: String,
        /// What would be accepted.
        accepted: String,
    },
    /// An input file that is missing, unreadable, malformed, truncated or of the wrong kind.
    #[error("{}: {problem}", path.display())]
    Input {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, where, and what would work.
        problem: String,
    },
    /// A grid that was asked to be a level set and is not one.
    #[error("{operation}: `{name}` is not a valid level set: {problem}")]
    NotALevelSet {
        /// The operator or command.
        operation: String,
        /// The grid or step.
        name: String,
        /// Which invariant does not hold, where, and what would work.
        problem: String,
    },
    /// An output that could not be written. Nothing was left behind.
    #[error("{}: could not be written: {problem}", path.display())]
    Output {
        /// The file.
        path: PathBuf,
        /// What failed.
        problem: String,
    },
    /// More memory than the limit, found out before it is allocated.
    #[error("{operation}: needs about {} of memory, the limit is {}; {advice}", Bytes(*needed), Bytes(*limit))]
    Memory {
        /// The operator or command.
        operation: String,
        /// Estimated need in bytes.
        needed: u64,
        /// The limit in bytes.
        limit: u64,
        /// What would need less.
        advice: String,
    },
    /// An `assert`, a `--check` or a comparison that did not hold.
    #[error("{operation}: {problem}")]
    Unmet {
        /// The operator or command.
        operation: String,
        /// What was expected and what was found.
        problem: String,
    },
    /// The run was cancelled from outside.
    #[error("cancelled during {operation}")]
    Cancelled {
        /// The operation that was interrupted.
        operation: String,
    },
}

impl EditError {
    /// A parameter that cannot work; `accepted` says what would.
    pub fn parameter(operation: &str, field: &str, value: impl fmt::Display, accepted: impl Into<String>) -> Self {
        Self::Parameter {
            operation: operation.into(),
            field: field.into(),
            value: value.to_string(),
            accepted: accepted.into(),
        }
    }

    /// An input that cannot be used.
    pub fn input(path: impl AsRef<Path>, problem: impl Into<String>) -> Self {
        Self::Input { path: path.as_ref().into(), problem: problem.into() }
    }

    /// An output that could not be written.
    pub fn output(path: impl AsRef<Path>, problem: impl Into<String>) -> Self {
        Self::Output { path: path.as_ref().into(), problem: problem.into() }
    }

    /// The same, said of a place: the line of a recipe, say.
    pub fn at(self, place: &str) -> Self {
        match self {
            Self::Parameter { field, value, accepted, .. } => {
                Self::Parameter { operation: place.into(), field, value, accepted }
            }
            Self::Input { path, problem } => Self::Input { path, problem: format!("{problem} ({place})") },
            Self::NotALevelSet { name, problem, .. } => Self::NotALevelSet { operation: place.into(), name, problem },
            Self::Output { path, problem } => Self::Output { path, problem: format!("{problem} ({place})") },
            Self::Memory { needed, limit, advice, .. } => {
                Self::Memory { operation: place.into(), needed, limit, advice }
            }
            Self::Unmet { problem, .. } => Self::Unmet { operation: place.into(), problem },
            Self::Cancelled { .. } => self,
        }
    }

    /// The exit status of the command for this error.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Unmet { .. } => 1,
            Self::Parameter { .. } => 2,
            Self::Input { .. } | Self::NotALevelSet { .. } => 3,
            Self::Output { .. } => 4,
            Self::Memory { .. } => 5,
            Self::Cancelled { .. } => 130,
        }
    }
}

/// A size in bytes, shown in the unit a person would use.
struct Bytes(u64);

impl fmt::Display for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const UNITS: [&str; 6] = ["B", "KiB", "MiB", "GiB", "TiB", "PiB"];
        let mut value = self.0 as f64;
        let mut unit = 0;
        while value >= 1024.0 && unit + 1 < UNITS.len() {
            value /= 1024.0;
            unit += 1;
        }
        if unit == 0 { write!(f, "{value} B") } else { write!(f, "{value:.1} {}", UNITS[unit]) }
    }
}
