//! Output to stdout, stderr and new files; either stream may be closed or broken.

use super::{Failure, Result, STOPPED, finish_with};
use crate::text::{is_unprintable, wrapped};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use serde::Serialize;
use serde_json::{Value, json};
use std::fmt::Display;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Write};
use std::os::fd::AsFd;
use std::path::Path;

/// Writes `text`, made [`plain`], and a line end to stdout. A closed pipe (`run --json | true`) is no
/// failure: the reader has read all that it wanted. Nor is a closed terminal, which has no reader.
pub(super) fn print_stdout(text: impl Display) -> Result<()> {
    let mut stdout = io::stdout().lock();
    match writeln!(stdout, "{}", plain(text, "\n\t")).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe && !has_no_reader(&stdout) => {
            Err(Failure::environment(format_args!("stdout: {error}")))
        }
        _ => Ok(()),
    }
}

/// Whether `stream` is a pipe or a terminal whose other end is closed. A command that runs until Ctrl-C
/// then ends.
pub(super) fn has_no_reader(stream: &impl AsFd) -> bool {
    let mut fds = [PollFd::new(stream.as_fd(), PollFlags::empty())];
    let is_polled = poll(&mut fds, PollTimeout::ZERO).is_ok();
    is_polled && fds[0].revents().is_some_and(|events| events.contains(PollFlags::POLLERR))
}

/// Writes a result to stdout: the object if `json`, else the text.
pub(super) fn print_result(
    json: bool,
    object: &impl Serialize,
    text: impl FnOnce() -> Result<String, minijinja::Error>,
) -> Result<()> {
    match json {
        true => print_stdout(serde_json::to_value(object).map_err(Failure::environment)?),
        false => print_wrapped(text().map_err(Failure::environment)?),
    }
}

/// Like [`print_result`], after a step that may have failed: prints the result in any case, and the failure in it and
/// on stderr.
pub(super) fn print_result_despite(
    failed: Result<()>,
    json: bool,
    object: &impl Serialize,
    text: impl FnOnce() -> Result<String, minijinja::Error>,
) -> Result<()> {
    let Err(Failure { message: Some(message), status }) = failed else {
        print_result(json, object, text)?;
        return failed;
    };
    let object = serde_json::to_value(object).map_err(Failure::environment)?;
    let (key, ended) = match status {
        STOPPED => ("stop_reason", "stopped"),
        _ => ("error", "error"),
    };
    print_result(json, &merged(object, &json!({ key: message })), text)?;
    print_stderr(format_args!("{ended}: {message}"));
    finish_with(status)
}

/// `object` with the fields of `more`.
pub(super) fn merged(mut object: Value, more: &Value) -> Value {
    for (key, value) in more.as_object().into_iter().flatten() {
        object[key] = value.clone();
    }
    object
}

/// Writes text for an operator to stdout, its long lines broken.
pub(super) fn print_wrapped(text: impl Display) -> Result<()> {
    print_stdout(wrapped(&text.to_string()))
}

/// Writes a new file. A file that exists is not overwritten, and none is left that holds only a part of `text`.
pub(super) fn write_new(path: &Path, text: &str) -> Result<()> {
    let written = File::create_new(path).map(|mut file| file.write_all(text.as_bytes()));
    let written = written.and_then(|written| {
        written.inspect_err(|_| {
            let _ = fs::remove_file(path);
        })
    });
    written.map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => Failure::bad_input(
            path,
            "exists, and is not overwritten; name another file, or remove it",
        ),
        _ => Failure::io(path, format_args!("cannot be written: {error}")),
    })
}

/// Refuses a file that exists, or that cannot be written, before there is anything to write.
pub(super) fn refuse_unwritable(path: Option<&Path>) -> Result<()> {
    let Some(path) = path else { return Ok(()) };
    write_new(path, "")?;
    fs::remove_file(path).map_err(|error| Failure::io(path, error))
}

/// Writes `text`, made [`plain`], its long lines broken, and a line end to stderr; errors are ignored.
pub(super) fn print_stderr(text: impl Display) {
    let _ = writeln!(io::stderr().lock(), "{}", wrapped(&plain(text, "\n\t")));
}

/// Escapes the characters of `text` that would control a terminal, as `\u001b`, except those in `kept`.
/// Text from peers is escaped when it is received; text from files is escaped here. The form is JSON's
/// own, so that the output of `--json` stays valid.
pub(super) fn plain(text: impl Display, kept: &str) -> String {
    let text = text.to_string();
    let is_acted_upon = |c: char| is_unprintable(c) && !kept.contains(c);
    if !text.contains(is_acted_upon) {
        return text;
    }
    let shown = text.chars().map(|c| match is_acted_upon(c) {
        true => format!("\\u{:04x}", u32::from(c)),
        false => c.to_string(),
    });
    shown.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pipe_or_a_terminal_without_a_reader_is_recognised() {
        let (reader, writer) = nix::unistd::pipe().unwrap();
        assert!(!has_no_reader(&writer));
        drop(reader);
        assert!(has_no_reader(&writer));
        assert!(!has_no_reader(&File::open("/dev/null").unwrap()));
        let terminal = nix::pty::openpty(None, None).unwrap();
        assert!(!has_no_reader(&terminal.slave));
        drop(terminal.master);
        assert!(has_no_reader(&terminal.slave));
    }

    #[test]
    fn control_characters_are_escaped() {
        let text = "a\u{1b}[2J\r\u{9b}1m\u{7f}\u{202e}b\n\tc";
        assert_eq!(plain(text, "\n\t"), "a\\u001b[2J\\u000d\\u009b1m\\u007f\\u202eb\n\tc");
        assert_eq!(plain("a\nb", ""), "a\\u000ab", "a line end in an event");
        let object = json!({ "tool": text });
        let read: Value = serde_json::from_str(&plain(&object, "\n\t")).unwrap();
        assert_eq!(read, object, "it is still the same object");
    }
}
