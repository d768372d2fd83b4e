//! Stdout and stderr, of which neither may be taken for granted.

use super::Failure;
use std::fmt::Display;
use std::io::{self, ErrorKind, Write};

/// Writes `text` and a line end to stdout. A reader that has left (`run --json | true`) has read
/// all that it wanted: that is no failure.
pub(super) fn say(text: impl Display) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    match writeln!(stdout, "{text}").and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::Environment(format!("stdout: {error}")))
        }
        _ => Ok(()),
    }
}

/// Writes `text` and a line end to stderr, as far as anyone takes it.
pub(super) fn tell(text: impl Display) {
    let _ = writeln!(io::stderr().lock(), "{text}");
}
