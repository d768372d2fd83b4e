//! A recorded stream, played in real time.

use super::link::{Link, LinkSettings};
use crate::tracker::Replay;
use crate::units::Time;
use tokio::time::sleep;

impl Link {
    /// Gives the events of `replay` when they are due by `clock`. Only the tool and the queue length of
    /// `settings` matter.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn replay<C>(mut replay: Replay, settings: &LinkSettings, clock: C) -> Self
    where
        C: Fn() -> Time + Send + 'static,
    {
        Link::filled_by(settings, async move |mut outlet| {
            while replay.deadline() < Time::NEVER {
                sleep(replay.deadline().since(clock())).await;
                while let Some(event) = replay.poll(clock()) {
                    outlet.hand_on(clock(), event);
                }
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracker::{Event, ndjson};

    #[tokio::test]
    async fn a_recording_is_given_to_its_end() {
        let line = |ns: u32| {
            format!(r#"{{"tool":"N","position_tracker_mm":[{ns},0,0],"receive_time_ns":{ns}}}"#)
        };
        let recording = ndjson::recording(&[line(1_000_000), line(3_000_000)].join("\n")).unwrap();
        let start = std::time::Instant::now();
        let clock = move || Time::ZERO + start.elapsed();
        let replay = Replay::new("tip.ndjson", recording, Time::ZERO);
        let mut link = Link::replay(replay, &LinkSettings::default(), clock);
        let mut samples = Vec::new();
        while let Some(event) = link.next().await {
            if let Event::Sample(sample) = event {
                assert!(sample.receive_time <= clock(), "none comes before its time");
                samples.push(sample.receive_time.as_nanos());
            }
        }
        assert_eq!(samples, [0, 2_000_000]);
    }
}
