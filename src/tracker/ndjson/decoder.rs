//! Splits a stream of bytes into lines.

use super::{LINE_LIMIT, Line, line_error};

/// Turns the chunks of a connection into lines, wherever the chunks were cut. It skips blank lines.
///
/// Memory stays below [`LINE_LIMIT`] and one chunk when every push is followed by polls.
#[derive(Debug, Default)]
pub(in crate::tracker) struct LineDecoder {
    buffer: Vec<u8>,
    /// Bytes of `buffer` already used.
    used: usize,
    /// Lines so far, including one that is being skipped.
    lines: u64,
    /// True inside a line that is too long.
    skipping: bool,
}

impl LineDecoder {
    pub(in crate::tracker) fn push(&mut self, chunk: &[u8]) {
        self.buffer.drain(..self.used);
        self.used = 0;
        self.buffer.extend_from_slice(chunk);
    }

    /// The next line, or `None` until more bytes are pushed.
    ///
    /// # Errors
    /// What is wrong with one line. Keep polling for the next lines.
    pub(in crate::tracker) fn poll(&mut self) -> Result<Option<Line>, String> {
        loop {
            let unread = self.buffer.get(self.used..).unwrap_or_default();
            let end = unread.iter().position(|byte| *byte == b'\n');
            let text = &unread[..end.unwrap_or(unread.len())];
            let is_too_long = text.len() > LINE_LIMIT;
            // Bytes of a line that is too long are used at once, so that they are not kept.
            let is_skipped = is_too_long || self.skipping;
            if end.is_none() && (text.is_empty() || !is_skipped) {
                return Ok(None);
            }
            self.used += text.len() + usize::from(end.is_some());
            if std::mem::replace(&mut self.skipping, end.is_none()) {
                continue;
            }
            self.lines += 1;
            let text = if self.lines == 1 { without_mark(text) } else { text };
            if is_too_long {
                return Err(line_error(self.lines, format_args!("longer than {LINE_LIMIT} bytes")));
            }
            if !text.trim_ascii().is_empty() {
                return Ok(Some(Line::parse(self.lines, text)?.printable()));
            }
        }
    }

    /// Ends the stream: what follows the last end of line is a line too. Poll for it.
    pub(in crate::tracker) fn finish(&mut self) {
        self.push(b"\n");
    }
}

/// `text` without a byte order mark.
fn without_mark(text: &[u8]) -> &[u8] {
    text.strip_prefix("\u{feff}".as_bytes()).unwrap_or(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_without_end_is_refused_once_and_not_kept() {
        let mut decoder = LineDecoder::default();
        let mut refused = Vec::new();
        for _ in 0..100 {
            decoder.push(&[b'x'; 4096]);
            while let Err(error) = decoder.poll() {
                refused.push(error);
            }
            assert!(decoder.buffer.len() <= LINE_LIMIT + 4096);
        }
        assert_eq!(refused, ["ndjson: line 1: longer than 16384 bytes"]);
        decoder.push(b"x\n{\"tool\":\"N\",\"position_tracker_mm\":[1,2,3]}\n{\"to");
        assert!(matches!(decoder.poll(), Ok(Some(_))));
        assert!(matches!(decoder.poll(), Ok(None)));
        decoder.finish();
        let unfinished = "ndjson: line 3: EOF while parsing a string (column 4)";
        assert_eq!(decoder.poll().err(), Some(unfinished.to_owned()));
        assert!(matches!(decoder.poll(), Ok(None)));
    }

    #[test]
    fn a_byte_order_mark_and_a_missing_last_end_of_line_cost_no_line() {
        let mut decoder = LineDecoder::default();
        let line = r#"{"tool":"N","position_tracker_mm":[1,2,3]}"#;
        decoder.push(format!("\u{feff}{line}\n{line}").as_bytes());
        assert!(matches!(decoder.poll(), Ok(Some(_))));
        assert!(matches!(decoder.poll(), Ok(None)));
        decoder.finish();
        assert!(matches!(decoder.poll(), Ok(Some(_))));
        assert!(matches!(decoder.poll(), Ok(None)));
    }
}
