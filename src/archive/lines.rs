//! Lines of a text file that may end in a partial line.

use std::io::{self, BufRead};

/// The lines of a text file, read one by one. A partial last line, which a killed bench leaves behind, is
/// omitted; bytes that are not UTF-8 are replaced. A read error is the last item.
pub struct Lines(Option<Box<dyn BufRead>>);

impl Lines {
    /// The lines of `file`.
    pub fn new(file: impl BufRead + 'static) -> Self {
        Lines(Some(Box::new(file)))
    }

    /// The lines parsed by `parse`, and the numbers, from 1, of the lines for which it returns `None`.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn parse<T>(self, parse: impl Fn(&str) -> Option<T>) -> io::Result<(Vec<T>, Vec<usize>)> {
        let (mut values, mut unparsable) = (Vec::new(), Vec::new());
        for (line, number) in self.zip(1..) {
            match parse(&line?) {
                Some(value) => values.push(value),
                None => unparsable.push(number),
            }
        }
        Ok((values, unparsable))
    }
}

impl Iterator for Lines {
    type Item = io::Result<String>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut line = Vec::new();
        if let Err(error) = self.0.as_mut()?.read_until(b'\n', &mut line) {
            self.0 = None;
            return Some(Err(error));
        }
        line.pop_if(|last| *last == b'\n')?;
        Some(Ok(String::from_utf8_lossy(&line).into_owned()))
    }
}

/// `text` without a partial last line.
pub(super) fn without_partial_line(text: &str) -> &str {
    text.rsplit_once('\n').map_or("", |(whole, _)| whole)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read as _;

    #[test]
    fn a_line_without_its_end_is_left_out() {
        let lines =
            |bytes: &'static [u8]| Lines::new(bytes).map(Result::unwrap).collect::<Vec<_>>();
        assert_eq!(lines(b"a\n\nb\nc"), ["a", "", "b"]);
        assert_eq!(lines(b"\xFF\nb\n"), ["\u{FFFD}", "b"]);
        assert!(lines(b"a").is_empty());
        assert_eq!(without_partial_line("a\nb\nc"), "a\nb");
        assert_eq!(without_partial_line("a"), "");
    }

    /// Otherwise a disk that keeps failing would block the reader for ever.
    #[test]
    fn a_read_error_is_the_last_item() {
        struct BrokenDisk;
        impl io::Read for BrokenDisk {
            fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
                Err(io::Error::other("Input/output error"))
            }
        }
        let file = io::Cursor::new("a\n").chain(io::BufReader::new(BrokenDisk));
        let lines: Vec<_> = Lines::new(file).take(9).map(|line| line.ok()).collect();
        assert_eq!(lines, [Some("a".to_owned()), None]);
    }
}
