//! A recording of lines, with the times at which they were received.

use super::{Line, LineError, LineProblem};
use crate::tracker::event::Event;
use crate::tracker::sample::Sample;
use crate::units::Time;
use thiserror::Error;

/// Why a recording was refused.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum RecordingError {
    /// It has no lines.
    #[error("no line")]
    Empty,
    /// None of its lines is a sample.
    #[error("no line is a sample; the first: {0}")]
    NoSample(LineError),
}

/// Reads all events of a recording, each with its time on the recording's own time line. A refused
/// line is an event at the time of the line before it.
///
/// # Errors
/// Nothing in it is a sample.
pub fn recording(text: &str) -> Result<Vec<(Time, Event)>, RecordingError> {
    let mut newest: Option<Time> = None;
    let mut first_error = None;
    let mut events: Vec<(Option<Time>, Event)> = Vec::new();
    let lines = text.lines().zip(1u64..).filter(|(line, _)| !line.trim().is_empty());
    for (text, line) in lines {
        match timed_sample(line, text, newest) {
            Ok(sample) => {
                newest = Some(sample.receive_time);
                events.push((newest, Event::Sample(sample)));
            }
            Err(error) => {
                events.push((newest, Event::Malformed(error.to_string())));
                first_error.get_or_insert(error);
            }
        }
    }
    let Some(first) = events.iter().find_map(|(time, _)| *time) else {
        return Err(first_error.map_or(RecordingError::Empty, RecordingError::NoSample));
    };
    Ok(events.into_iter().map(|(time, event)| (time.unwrap_or(first), event)).collect())
}

/// The sample in line `line` of the bench's own record, exactly as it was, even with a stamp of 0.
///
/// # Errors
/// [`LineError`]: the line is not a sample, or has no time of receipt.
pub fn recorded(line: u64, text: &str) -> Result<Sample, LineError> {
    let (read, time) = timed_line(line, text)?;
    let source_unix_ns = read.source_unix_ns;
    Ok(Sample { source_unix_ns, ..read.into_sample(time) })
}

fn timed_line(line: u64, text: &str) -> Result<(Line, Time), LineError> {
    let read = Line::parse(line, text.as_bytes())?;
    let time_ns = read.receive_time_ns.ok_or(LineError { line, problem: LineProblem::NoTime })?;
    Ok((read, Time::from_nanos(time_ns)))
}

fn timed_sample(line: u64, text: &str, newest: Option<Time>) -> Result<Sample, LineError> {
    let (read, time) = timed_line(line, text)?;
    let back_ns = newest.map_or(0, |newest| newest.as_nanos().saturating_sub(time.as_nanos()));
    if back_ns > 0 {
        return Err(LineError { line, problem: LineProblem::Backwards(back_ns) });
    }
    Ok(read.printable().into_sample(time))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_keeps_its_times_and_tells_of_its_bad_lines() {
        let good = |ns: i64| {
            format!(r#"{{"tool":"N","position_tracker_mm":[{ns},0,0],"receive_time_ns":{ns}}}"#)
        };
        let text = [
            "bad".to_owned(),
            good(50),
            r#"{"tool":"N","position_tracker_mm":[1,2,3]}"#.to_owned(),
            String::new(),
            good(70),
            good(60),
            good(70),
        ]
        .join("\n");
        let summary: Vec<String> = (recording(&text).unwrap().iter())
            .map(|(time, event)| match event {
                Event::Sample(sample) => format!("{} {}", time.as_nanos(), sample.position_mm.x),
                Event::Malformed(error) => format!("{} {error}", time.as_nanos()),
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(
            summary,
            [
                "50 ndjson: line 1: expected value (column 1)",
                "50 50",
                "50 ndjson: line 3: no receive_time_ns: a replay needs it to keep the pace of the \
                 recording",
                "70 70",
                "70 ndjson: line 6: receive_time_ns goes back by 10 ns",
                "70 70",
            ]
        );
    }

    #[test]
    fn the_benchs_own_record_is_read_exactly() {
        let line = r#"{"receive_time_ns":0,"source_unix_ns":0,"tool":"N","position_tracker_mm":[0.1,-0.0,"NaN"],"orientation_tracker_wxyz":null,"status":"OK"}"#;
        let sample = recorded(1, line).unwrap();
        assert_eq!((sample.receive_time, sample.source_unix_ns), (Time::ZERO, Some(0)));
        assert_eq!(sample.position_mm.y.to_bits(), (-0.0f64).to_bits());
        let given = recording(line).unwrap();
        let Event::Sample(sample) = &given[0].1 else { panic!("{given:?}") };
        assert_eq!(sample.source_unix_ns, None, "to a stream 0 is none");
    }

    #[test]
    fn a_file_of_something_else_is_refused() {
        assert_eq!(recording("\n"), Err(RecordingError::Empty));
        assert_eq!(
            recording("step,time_s\n0,1.5\n").unwrap_err().to_string(),
            "no line is a sample; the first: ndjson: line 1: expected value (column 1)"
        );
    }
}
