//! The command `vdb-edit`.

use std::process::ExitCode;

fn main() -> ExitCode {
    vdb_edit::cli::main()
}
