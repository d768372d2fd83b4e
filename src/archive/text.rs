//! Lines of a file that may have been cut.

use std::io::{self, BufRead};

/// The lines of a text file, read as they are asked for. A last line without an end, which a kill
/// leaves, is left out; bytes that are not UTF-8 are replaced.
pub struct Lines(Box<dyn BufRead>);

impl Lines {
    /// The lines of what `file` holds.
    pub fn new(file: impl BufRead + 'static) -> Self {
        Lines(Box::new(file))
    }

    /// The values that `read` makes of the lines, and the numbers, from 1, of the lines that it cannot read.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn read<T>(self, read: impl Fn(&str) -> Option<T>) -> io::Result<(Vec<T>, Vec<usize>)> {
        let (mut values, mut none) = (Vec::new(), Vec::new());
        for (line, number) in self.zip(1..) {
            match read(&line?) {
                Some(value) => values.push(value),
                None => none.push(number),
            }
        }
        Ok((values, none))
    }
}

impl Iterator for Lines {
    type Item = io::Result<String>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut line = Vec::new();
        if let Err(error) = self.0.read_until(b'\n', &mut line) {
            return Some(Err(error));
        }
        line.pop_if(|last| *last == b'\n')?;
        Some(Ok(String::from_utf8_lossy(&line).into_owned()))
    }
}

/// `text` up to the end of its last whole line: a record that was cut off ends within a line.
pub(super) fn whole(text: &str) -> &str {
    text.rsplit_once('\n').map_or("", |(whole, _)| whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_without_its_end_is_left_out() {
        let lines =
            |bytes: &'static [u8]| Lines::new(bytes).map(Result::unwrap).collect::<Vec<_>>();
        assert_eq!(lines(b"a\n\nb\nc"), ["a", "", "b"]);
        assert_eq!(lines(b"\xFF\nb\n"), ["\u{FFFD}", "b"]);
        assert!(lines(b"a").is_empty());
        assert_eq!((whole("a\nb\nc"), whole("a")), ("a\nb", ""));
    }
}
