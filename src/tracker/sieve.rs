//! Keeps samples of other tools, and floods of other messages, away from the session.

use super::event::{Event, NDJSON, has_positions};
use super::gate::is_same_tool;
use super::reader::Reader;
use crate::units::Time;
use std::collections::BTreeSet;
use std::time::Duration;

/// Passes what a session needs: the samples of its tools, the name of every other tool once, and
/// statuses and refused messages (notices) at a rate bounded by a token bucket. It counts what it does
/// not pass.
#[derive(Debug, Clone)]
pub struct Sieve {
    tools: Vec<String>,
    /// Names reported on this connection.
    names: BTreeSet<String>,
    /// Notices that may still pass.
    tokens: u32,
    refilled: Time,
    passed_over: u64,
}

impl Sieve {
    /// At most this many notices pass at once.
    pub const NOTICES_MAX: u32 = 100;
    /// One more may pass after each such period.
    pub const NOTICE_PERIOD: Duration = Duration::from_millis(50);

    /// A sieve for samples of `tools`; of every tool where none is named.
    pub fn new(tools: &[String]) -> Self {
        Sieve {
            tools: tools.to_vec(),
            names: BTreeSet::new(),
            tokens: Self::NOTICES_MAX,
            refilled: Time::ZERO,
            passed_over: 0,
        }
    }

    /// Returns the event to pass on for `event`, received at `now`; `None` for nothing. The first sample of another
    /// tool becomes [`Event::SawTool`], unless its name was reported before.
    pub fn pass(&mut self, now: Time, event: Event) -> Option<Event> {
        match event {
            Event::Connected { .. } => self.names.clear(),
            Event::SawTool { ref tool, ref message_type } if has_positions(message_type) => {
                self.names.insert(tool.clone());
            }
            Event::Sample(sample) if !self.is_own(&sample.tool) => {
                self.passed_over += 1;
                let is_new =
                    self.names.len() < Reader::NAMES_MAX && !self.names.contains(&sample.tool);
                return is_new.then(|| {
                    self.names.insert(sample.tool.clone());
                    Event::SawTool { tool: sample.tool, message_type: NDJSON.to_owned() }
                });
            }
            Event::Status { .. } | Event::Malformed(_) if !self.take_token(now) => {
                self.passed_over += 1;
                return None;
            }
            _ => {}
        }
        Some(event)
    }

    /// Samples of other tools, statuses and refused messages that did not pass.
    pub fn passed_over(&self) -> u64 {
        self.passed_over
    }

    fn is_own(&self, sent: &str) -> bool {
        self.tools.is_empty() || self.tools.iter().any(|tool| is_same_tool(sent, tool))
    }

    /// Takes the token for one notice at `now`; false if none is left.
    fn take_token(&mut self, now: Time) -> bool {
        let due = now.since(self.refilled).as_nanos() / Self::NOTICE_PERIOD.as_nanos();
        if due > 0 {
            let due = u32::try_from(due).unwrap_or(u32::MAX);
            self.tokens = self.tokens.saturating_add(due).min(Self::NOTICES_MAX);
            self.refilled = now;
        }
        let has_token = self.tokens > 0;
        self.tokens = self.tokens.saturating_sub(1);
        has_token
    }
}

#[cfg(test)]
mod tests {
    use super::super::sample::Sample;
    use super::*;
    use nalgebra::Vector3;

    fn sample(tool: &str) -> Event {
        Event::Sample(Sample::valid(tool, Vector3::zeros()))
    }

    #[test]
    fn other_tools_are_reported_once_and_counted() {
        let mut sieve = Sieve::new(&["Needle".to_owned(), "Target".to_owned()]);
        let mut pass = |event| sieve.pass(Time::ZERO, event);
        let saw = |tool: &str, message_type: &str| Event::SawTool {
            tool: tool.to_owned(),
            message_type: message_type.to_owned(),
        };
        assert_eq!(pass(saw("Stylus", "TRANSFORM")), Some(saw("Stylus", "TRANSFORM")));
        for _ in 0..5 {
            assert_eq!(pass(sample("Stylus")), None);
        }
        assert_eq!(pass(saw("Probe", "STATUS")), Some(saw("Probe", "STATUS")));
        assert_eq!(pass(sample("Probe")), Some(saw("Probe", "NDJSON")), "now it is a tool");
        assert_eq!(pass(sample("Probe")), None);
        assert_eq!(pass(sample("Needle")), Some(sample("Needle")));
        assert_eq!(pass(sample("Target")), Some(sample("Target")));
        assert_eq!(sieve.passed_over(), 7);
        assert_eq!(Sieve::new(&[]).pass(Time::ZERO, sample("Any")), Some(sample("Any")));
    }

    #[test]
    fn notices_pass_at_a_bounded_rate() {
        let mut sieve = Sieve::new(&[]);
        let mut at = |ms: i64| {
            let refused = Event::Malformed("no sample".to_owned());
            let now = Time::from_nanos(ms * 1_000_000);
            (0..1000).filter(|_| sieve.pass(now, refused.clone()).is_some()).count()
        };
        assert_eq!([at(0), at(20), at(50), at(1050), at(60_000)], [100, 0, 1, 20, 100]);
        assert_eq!(sieve.passed_over(), 5000 - 221);
    }

    #[test]
    fn a_peer_of_many_names_does_not_fill_the_memory() {
        let mut sieve = Sieve::new(&["Needle".to_owned()]);
        let names = (0..1000).filter_map(|n| sieve.pass(Time::ZERO, sample(&format!("tool {n}"))));
        assert_eq!(names.count(), Reader::NAMES_MAX);
    }
}
