//! Lines of a file that may have been cut.

/// `text` up to the end of its last whole line: a record that was cut off ends within a line.
pub(super) fn whole(text: &str) -> &str {
    text.rsplit_once('\n').map_or("", |(whole, _)| whole)
}

/// The lines of `text` that have an end.
pub fn whole_lines(text: &str) -> impl Iterator<Item = &str> {
    whole(text).lines()
}

/// What `read` makes of each whole line of `text`, and the numbers, from 1, of those of which it makes
/// nothing.
pub fn read_lines<'a, T>(
    text: &'a str,
    read: impl Fn(&'a str) -> Option<T>,
) -> (Vec<T>, Vec<usize>) {
    let (mut values, mut none) = (Vec::new(), Vec::new());
    for (line, number) in whole_lines(text).zip(1..) {
        match read(line) {
            Some(value) => values.push(value),
            None => none.push(number),
        }
    }
    (values, none)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_without_its_end_is_left_out() {
        let lines = |text| whole_lines(text).collect::<Vec<_>>();
        assert_eq!(lines("a\n\nb\nc"), ["a", "", "b"]);
        assert_eq!((lines("a\nb\n"), lines("a")), (vec!["a", "b"], vec![]));
    }
}
