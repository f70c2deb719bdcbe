//! What the user is told: results on standard output, everything else on standard error.

use std::ffi::OsString;
use std::io::{self, Write};
use std::process::ExitCode;
use std::sync::Arc;

use clap::{ArgMatches, ValueEnum};
use serde_json::{Value, json};

use super::progress::{self, Display, When};
use crate::error::{EditError, Result};

/// The form of messages on standard error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// For people.
    Text,
    /// One JSON object a line.
    Json,
}

impl Format {
    /// What the arguments ask for, before they are understood.
    pub fn guess(arguments: &[OsString]) -> Self {
        let json = arguments.windows(2).any(|pair| pair[0] == "--log-format" && pair[1] == "json")
            || arguments.iter().any(|a| a == "--log-format=json");
        if json { Self::Json } else { Self::Text }
    }
}

/// Says things to the user.
#[derive(Clone)]
pub struct Reporter {
    format: Format,
    quiet: bool,
    /// Whether the result is wanted as JSON.
    json: bool,
    display: Option<Arc<Display>>,
}

impl Reporter {
    /// As the arguments of every command ask.
    pub fn new(matches: &ArgMatches) -> Self {
        let format = matches.get_one("log-format").copied().unwrap_or(Format::Text);
        let quiet = matches.get_flag("quiet");
        let when = matches.get_one("progress").copied().unwrap_or(When::Auto);
        Self { format, quiet, json: matches.get_flag("json"), display: progress::display(when, quiet, format) }
    }

    /// The progress display, if one is wanted.
    pub fn display(&self) -> Option<Arc<Display>> {
        self.display.clone()
    }

    /// The form of messages.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Whether the result is wanted as JSON.
    pub fn wants_json(&self) -> bool {
        self.json
    }

    /// Something the user should know.
    pub fn warn(&self, message: &str) {
        self.say("warning", message, json!({}));
    }

    /// Why the command failed.
    pub fn error(&self, error: &EditError, exit_code: u8) {
        self.say("error", &error.to_string(), json!({ "exit_code": exit_code }));
    }

    fn say(&self, level: &str, message: &str, more: Value) {
        let line = line(self.format, level, message, more);
        let write = || drop(writeln!(io::stderr().lock(), "{line}"));
        match &self.display {
            Some(display) => display.suspended(write),
            None => write(),
        }
    }

    /// The result: JSON if asked for, else what `text` makes for people, unless they want quiet.
    pub fn result(&self, value: &Value, text: impl FnOnce() -> String) -> Result<()> {
        if self.json {
            print(&format!("{value:#}\n"))
        } else if self.quiet {
            Ok(())
        } else {
            print(&text())
        }
    }

    /// A part of the result that is known before the rest, for people.
    pub fn text(&self, text: impl FnOnce() -> String) {
        if !self.json && !self.quiet {
            // A reader that has gone away is told by the result.
            let write = || drop(print(&text()));
            match &self.display {
                Some(display) => display.suspended(write),
                None => write(),
            }
        }
    }

    /// As [`result`](Self::result), where standard output carries a file.
    pub fn result_beside_output(&self, text: impl FnOnce() -> String) {
        if !self.quiet && self.format == Format::Text {
            let text = text();
            let write = || drop(write!(io::stderr().lock(), "{text}"));
            write();
        }
    }
}

/// One message as one line.
fn line(format: Format, level: &str, message: &str, more: Value) -> String {
    match format {
        Format::Text => format!("{level}: {}", message.replace('\n', " ")),
        Format::Json => {
            let mut object = json!({ "level": level, "message": message });
            if let (Some(object), Value::Object(more)) = (object.as_object_mut(), more) {
                object.extend(more);
            }
            object.to_string()
        }
    }
}

/// Writes to standard output. A reader that has gone away is no error: it has what it wanted.
pub fn print(text: &str) -> Result<()> {
    print_bytes(text.as_bytes())
}

/// As [`print`], for what may not be text.
pub fn print_bytes(bytes: &[u8]) -> Result<()> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(bytes).and_then(|()| stdout.flush()) {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => Err(EditError::output("standard output", e.to_string())),
        _ => Ok(()),
    }
}

/// Says what is wrong with the arguments, or shows the help that they ask for.
pub fn usage(error: &clap::Error, format: Format) -> ExitCode {
    let code = if error.use_stderr() { 2 } else { 0 };
    if code == 2 && format == Format::Json {
        let message = error.render().to_string();
        let message = message.trim().strip_prefix("error: ").unwrap_or(&message).to_owned();
        let line = line(format, "error", &message, json!({ "exit_code": code }));
        let _ = writeln!(io::stderr().lock(), "{line}");
    } else {
        // A closed pipe is the only thing that can go wrong.
        let _ = error.print();
    }
    ExitCode::from(code)
}

/// A defect of the program is said in one line as well, whatever `RUST_BACKTRACE` says.
pub fn no_backtraces() {
    std::panic::set_hook(Box::new(|panic| {
        let payload = panic.payload();
        let message = payload.downcast_ref::<&str>().copied();
        let message = message.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message");
        let place = panic.location().map(|l| format!(" at {}:{}", l.file(), l.line())).unwrap_or_default();
        let _ = writeln!(io::stderr().lock(), "error: a defect of vdb-edit{place}: {message}");
    }));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_one_line() {
        assert_eq!(line(Format::Text, "error", "a\nb", json!({})), "error: a b");
        let json = line(Format::Json, "error", "a\nb", json!({ "exit_code": 3 }));
        assert_eq!(json, r#"{"level":"error","message":"a\nb","exit_code":3}"#);
    }

    #[test]
    fn the_format_is_known_before_the_arguments_are() {
        let guess = |words: &[&str]| Format::guess(&words.iter().map(OsString::from).collect::<Vec<_>>());
        assert_eq!(guess(&["x", "--log-format", "json"]), Format::Json);
        assert_eq!(guess(&["x", "--log-format=json"]), Format::Json);
        assert_eq!(guess(&["x", "--log-format", "text", "--json"]), Format::Text);
    }
}
