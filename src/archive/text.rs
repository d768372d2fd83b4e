//! Lines of a file that may have been cut.

/// The lines of `text` that have an end: a record that was cut off ends within a line.
pub fn whole_lines(text: &str) -> impl Iterator<Item = &str> {
    text.rsplit_once('\n').map_or("", |(whole, _)| whole).lines()
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
