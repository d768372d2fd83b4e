//! A recorded stream, replayed at its own pace.

use super::event::Event;
use crate::units::Time;
use std::collections::VecDeque;
use std::time::Duration;

/// Gives the events of a recording as if they came now, at the pace they were recorded with: poll
/// at or after [`StreamReplay::deadline`], until `None`.
#[derive(Debug, Clone)]
pub struct StreamReplay {
    /// The events, each with its time after the start.
    events: VecDeque<(Duration, Event)>,
    start: Time,
}

impl StreamReplay {
    /// A replay of the recording `name`, its first event at `start`. The recording's times are its
    /// own and do not go back. The replay begins with [`Event::Connected`] and ends with
    /// [`Event::Disconnected`].
    pub fn new(name: &str, recording: Vec<(Time, Event)>, start: Time) -> Self {
        let first = recording.first().map_or(Time::ZERO, |(time, _)| *time);
        let end = recording.last().map_or(Duration::ZERO, |(time, _)| time.since(first));
        let is_sample = |(_, event): &&(Time, Event)| matches!(event, Event::Sample(_));
        let samples = recording.iter().filter(is_sample).count();
        let reason = format!("tracker: the recording ended after {samples} samples: {name}");
        let connected = (Duration::ZERO, Event::Connected { peer: name.to_owned() });
        let recorded = recording.into_iter().map(|(time, event)| (time.since(first), event));
        let disconnected = (end, Event::Disconnected { reason });
        let events = [connected].into_iter().chain(recorded).chain([disconnected]).collect();
        StreamReplay { events, start }
    }

    /// The next event that is due by `now`. A sample is received when it is due.
    pub fn poll(&mut self, now: Time) -> Option<Event> {
        let due = self.deadline();
        if now < due {
            return None;
        }
        let (_, mut event) = self.events.pop_front()?;
        if let Event::Sample(sample) = &mut event {
            sample.receive_time = due;
        }
        Some(event)
    }

    /// When the next event is due; [`Time::NEVER`] after the last.
    pub fn deadline(&self) -> Time {
        self.events.front().map_or(Time::NEVER, |(after, _)| self.start + *after)
    }
}

#[cfg(test)]
mod tests {
    use super::super::sample::Sample;
    use super::*;
    use nalgebra::Vector3;

    fn sample(ms: i64) -> (Time, Event) {
        let receive_time = Time::from_nanos(1_666_034_108_000_000_000 + ms * 1_000_000);
        let sample = Sample {
            receive_time,
            source_unix_ns: Some(receive_time.as_nanos()),
            ..Sample::valid("Tip", Vector3::x() * ms as f64)
        };
        (receive_time, Event::Sample(sample))
    }

    #[test]
    fn events_come_when_they_are_due() {
        let start = Time::from_secs_f64(2.0);
        let mut replay =
            StreamReplay::new("tip.csv", vec![sample(100), sample(125), sample(225)], start);
        let mut events = Vec::new();
        while replay.deadline() < Time::NEVER {
            let now = replay.deadline();
            assert_eq!(replay.poll(now - Duration::from_nanos(1)), None);
            events.extend(replay.poll(now).map(|event| match event {
                Event::Sample(sample) => {
                    assert_eq!(sample.receive_time, now, "it is received when it is due");
                    format!("{:.3} {}", now.as_secs_f64(), sample.position_mm.x)
                }
                Event::Connected { peer } => format!("connected to {peer}"),
                Event::Disconnected { reason } => reason,
                other => panic!("{other:?}"),
            }));
        }
        assert_eq!(
            events,
            [
                "connected to tip.csv",
                "2.000 100",
                "2.025 125",
                "2.125 225",
                "tracker: the recording ended after 3 samples: tip.csv",
            ]
        );
        assert_eq!(replay.poll(Time::NEVER), None);
    }

    #[test]
    fn a_late_sample_has_the_time_at_which_it_was_due() {
        let mut replay = StreamReplay::new("tip.csv", vec![sample(0), sample(10)], Time::ZERO);
        let late = Time::from_secs_f64(1.0);
        let due: Vec<Time> = std::iter::from_fn(|| replay.poll(late))
            .filter_map(|event| match event {
                Event::Sample(sample) => Some(sample.receive_time),
                _ => None,
            })
            .collect();
        assert_eq!(due, [Time::ZERO, Time::from_secs_f64(0.01)]);
    }
}
