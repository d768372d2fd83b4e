//! A recorded stream as CSV: a header line, then one row per sample. A [`CsvMapping`] says which
//! column holds what, and in which unit; nothing is guessed.
//!
//! The reader takes a whole file or refuses it: nothing has moved yet, and a wrong row usually means
//! a wrong mapping. A row whose three coordinates are blank has no sample. A coordinate may be `NaN`
//! or `inf`, as it was sent; the [gate](super::gate) refuses it.

use super::event::Event;
use super::orientation::Orientation;
use super::sample::{Sample, Validity};
use crate::keys::{Rule, not_blank, over, section, within};
use crate::table::{Column, Row, Table};
use crate::units::Time;
use nalgebra::Vector3;
use std::time::Duration;

const COLUMN: Rule = not_blank("the name of a column");

section! {
    /// `[tracker.csv]`: which columns of a CSV file hold what, named as in the file's header.
    pub struct CsvMapping {
        /// When each position was received: the pace of the replay. Columns of s, ms, us and ns are added.
        time: TimeColumns => "{ s = \"time_s\" }", whole;
        /// When the sender says each position was measured, since 1970.
        stamp: Option<TimeColumns>, whole;
        /// x, y and z in the tracker's frame.
        position: [String; 3] [COLUMN] = ["x_meas_mm", "y_meas_mm", "z_meas_mm"];
        /// Millimetres per unit of those columns; 1000 where they are in metres.
        position_unit_mm: f64 [over(0.0, 1e6)] = 1.0;
        /// w, x, y and z of the sensor's orientation in that frame.
        quaternion_wxyz: Option<[String; 4]> [COLUMN];
        /// How much of the beginning to leave out.
        skip as "skip_s": Duration [within(0.0, 1e6)] = 0.0;
    }
}

section! {
    /// Columns that add up to a time, each in its unit.
    #[derive(Default)]
    pub struct TimeColumns {
        /// The column of seconds.
        s: Option<String> [COLUMN];
        /// The column of milliseconds.
        ms: Option<String> [COLUMN];
        /// The column of microseconds.
        us: Option<String> [COLUMN];
        /// The column of nanoseconds.
        ns: Option<String> [COLUMN];
    }
}

impl TimeColumns {
    /// The columns that are named, each with the nanoseconds of its unit.
    pub(crate) fn named(&self) -> impl Iterator<Item = (&str, i64)> {
        let columns =
            [(&self.s, 1_000_000_000), (&self.ms, 1_000_000), (&self.us, 1000), (&self.ns, 1)];
        columns.into_iter().filter_map(|(name, unit_ns)| Some((name.as_deref()?, unit_ns)))
    }
}

/// Reads all samples of `tool` in a recording, each with its time on the recording's own time line.
///
/// # Errors
/// A missing column, a wrong row or a time that goes back, with its line; no sample.
pub fn recording(
    text: &str,
    mapping: &CsvMapping,
    tool: &str,
) -> Result<Vec<(Time, Event)>, String> {
    let table = Table::parse(text);
    let columns = Columns::find(&table, mapping)?;
    table.check_row_lengths()?;
    let (mut events, mut first, mut newest) = (Vec::new(), None, None);
    for row in table.rows() {
        let Some(sample) = columns.sample(row, mapping, tool)? else { continue };
        let time = sample.receive_time;
        let back_ns =
            newest.map_or(0, |newest: Time| newest.as_nanos().saturating_sub(time.as_nanos()));
        if back_ns > 0 {
            return Err(format!(
                "line {}: time goes back by {back_ns} ns; is that the column to pace by?",
                row.line
            ));
        }
        newest = Some(time);
        if time.since(*first.get_or_insert(time)) >= mapping.skip {
            events.push((time, Event::Sample(sample)));
        }
    }
    match (events.is_empty(), newest) {
        (false, _) => Ok(events),
        (true, Some(_)) => {
            let skip_s = mapping.skip.as_secs_f64();
            Err(format!("no sample after the first {skip_s} s, which are left out"))
        }
        (true, None) => Err("no sample below the header".to_owned()),
    }
}

/// The columns of a mapping, found in a file.
struct Columns {
    time: Vec<(Column, i64)>,
    stamp: Vec<(Column, i64)>,
    position: Vec<Column>,
    quaternion_wxyz: Vec<Column>,
}

impl Columns {
    fn find(table: &Table, mapping: &CsvMapping) -> Result<Self, String> {
        let columns = |names: &[String]| -> Result<Vec<Column>, String> {
            names.iter().map(|name| table.column(name)).collect()
        };
        let times = |columns: &TimeColumns| -> Result<Vec<(Column, i64)>, String> {
            columns.named().map(|(name, unit_ns)| Ok((table.column(name)?, unit_ns))).collect()
        };
        Ok(Columns {
            time: times(&mapping.time)?,
            stamp: mapping.stamp.as_ref().map(times).transpose()?.unwrap_or_default(),
            position: columns(&mapping.position)?,
            quaternion_wxyz: columns(
                mapping.quaternion_wxyz.as_ref().map_or(&[], |names| &names[..]),
            )?,
        })
    }

    /// The sample in a row; `None` if its coordinates are blank.
    fn sample(
        &self,
        row: &Row,
        mapping: &CsvMapping,
        tool: &str,
    ) -> Result<Option<Sample>, String> {
        let is_blank =
            |columns: &[Column]| columns.iter().all(|column| row.text(column).is_empty());
        if is_blank(&self.position) {
            return Ok(None);
        }
        let numbers = |columns: &[Column]| -> Result<Vec<f64>, String> {
            columns.iter().map(|column| row.number(column)).collect()
        };
        let position_mm = Vector3::from_vec(numbers(&self.position)?) * mapping.position_unit_mm;
        let orientation = match is_blank(&self.quaternion_wxyz) {
            // This also applies if the mapping has no such columns.
            true => Orientation::Absent,
            false => match numbers(&self.quaternion_wxyz)?[..] {
                [w, x, y, z] => Orientation::of_quaternion([w, x, y, z]),
                _ => Orientation::Absent,
            },
        };
        let stamp_ns = sum_ns(row, &self.stamp)?;
        let sample = Sample {
            tool: tool.to_owned(),
            receive_time: Time::from_nanos(sum_ns(row, &self.time)?),
            source_unix_ns: Some(stamp_ns).filter(|&unix_ns| unix_ns != 0),
            position_mm,
            orientation: None,
            validity: Validity::Valid,
        };
        Ok(Some(sample.with_orientation(orientation)))
    }
}

/// The sum of `columns`, each in its unit, ns; 0 of none. Whole numbers stay exact.
fn sum_ns(row: &Row, columns: &[(Column, i64)]) -> Result<i64, String> {
    columns.iter().try_fold(0i64, |sum, (column, unit_ns)| {
        nanoseconds(row.text(column), *unit_ns)
            .and_then(|ns| sum.checked_add(ns))
            .ok_or_else(|| row.error(column, "time within 292 years of 0"))
    })
}

fn nanoseconds(text: &str, unit_ns: i64) -> Option<i64> {
    if let Ok(whole) = text.parse::<i64>() {
        return whole.checked_mul(unit_ns);
    }
    let ns = (text.parse::<f64>().ok()? * unit_ns as f64).round();
    // i64::MAX is not a float; every float below it converts exactly.
    (ns.abs() < i64::MAX as f64).then_some(ns as i64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts<const N: usize>(names: [&str; N]) -> [String; N] {
        names.map(str::to_owned)
    }

    fn mapping() -> CsvMapping {
        CsvMapping {
            time: TimeColumns {
                s: Some("sec".to_owned()),
                ns: Some("nanosec".to_owned()),
                ..TimeColumns::default()
            },
            stamp: None,
            position: texts(["x", "y", "z"]),
            position_unit_mm: 1.0,
            quaternion_wxyz: None,
            skip: Duration::ZERO,
        }
    }

    fn samples(text: &str, mapping: &CsvMapping) -> Vec<Sample> {
        let events = recording(text, mapping, "Tip").unwrap_or_else(|error| panic!("{error}"));
        let sample = |(time, event)| match event {
            Event::Sample(sample) => {
                assert_eq!(sample.receive_time, time);
                sample
            }
            other => panic!("{other:?}"),
        };
        events.into_iter().map(sample).collect()
    }

    #[test]
    fn columns_are_found_by_name_in_their_units() {
        let mapping = CsvMapping {
            stamp: Some(TimeColumns { ms: Some("stamp_ms".to_owned()), ..TimeColumns::default() }),
            position_unit_mm: 1000.0,
            quaternion_wxyz: Some(texts(["qw", "qx", "qy", "qz"])),
            ..mapping()
        };
        let text = "\u{feff}z, y,x,qx,qy,qz,qw,nanosec,sec,stamp_ms\r\n\
                    0.003,0.002,0.001,0,0,0,1,801948764,1666034108,1.5\r\n\
                    ,,,,,,,,,\n\
                    \n\
                    0.006,0.005,NaN,0,0,0,0,801948764,1666034108,0\n";
        let samples = samples(text, &mapping);
        assert_eq!(samples.len(), 2, "a blank row has no sample");
        let first = &samples[0];
        assert!((first.position_mm - Vector3::new(1.0, 2.0, 3.0)).norm() < 1e-12);
        assert_eq!(first.receive_time, Time::from_nanos(1_666_034_108_801_948_764), "exactly");
        assert_eq!((first.tool.as_str(), first.source_unix_ns), ("Tip", Some(1_500_000)));
        assert_eq!(first.orientation, Some(nalgebra::UnitQuaternion::identity()));
        let second = &samples[1];
        assert!(second.position_mm.x.is_nan(), "it was sent; the gate refuses it");
        assert_eq!((second.source_unix_ns, &second.validity), (None, &Validity::NotARotation));
    }

    #[test]
    fn skip_leaves_out_the_beginning_of_a_recording() {
        let text = "sec,nanosec,x,y,z\n10,0,1,0,0\n10,500000000,2,0,0\n11,0,3,0,0\n";
        let skip = Duration::from_millis(500);
        let samples = samples(text, &CsvMapping { skip, ..mapping() });
        assert_eq!(samples.iter().map(|s| s.position_mm.x).collect::<Vec<_>>(), [2.0, 3.0]);
    }

    #[test]
    fn a_bad_recording_is_refused_with_line_and_column() {
        let header = "sec,nanosec,x,y,z\n";
        let refusal = |text: &str, mapping: &CsvMapping| {
            recording(text, mapping, "Tip").expect_err("refused")
        };
        let row = |row: &str| refusal(&format!("{header}1,0,1,2,3\n{row}\n"), &mapping());
        assert_eq!(row("1,0,1,2"), "line 3: 4 fields where the header has 5");
        assert_eq!(row("1,0,1,,3"), "line 3: y is \"\", expected a number");
        assert_eq!(row("1,0,1,2 mm,3"), "line 3: y is \"2 mm\", expected a number");
        assert_eq!(row(",0,1,2,3"), "line 3: sec is \"\", expected a time within 292 years of 0");
        for field in ["1e300", "NaN", "9223372036854775807"] {
            let error = row(&format!("{field},0,1,2,3"));
            assert!(error.starts_with("line 3: sec is "), "{error}");
        }
        assert_eq!(
            row("0,999999999,1,2,3"),
            "line 3: time goes back by 1 ns; is that the column to pace by?"
        );
        assert_eq!(
            refusal("sec,x,y,z\n", &mapping()),
            "line 1: no column \"nanosec\"; there are sec, x, y, z"
        );
        assert_eq!(refusal(header, &mapping()), "no sample below the header");
        let skip = CsvMapping { skip: Duration::from_secs(2), ..mapping() };
        assert_eq!(
            refusal(&format!("{header}1,0,1,2,3\n"), &skip),
            "no sample after the first 2 s, which are left out"
        );
    }
}
