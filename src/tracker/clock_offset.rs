//! The offset of the sender's clock from the bench's.

use super::refusal::{Effect, GateName, Refusal};
use crate::units::Time;
use std::time::Duration;

/// The minimum covers this window and the one before.
const WINDOW: Duration = Duration::from_secs(30);
/// A stamp that leads the quickest delivery so far by more than this is not a quicker delivery.
const AHEAD_MAX_NS: i64 = 50_000_000;
/// An offset is learnt from at least this many samples …
const SETTLING_SAMPLES: u32 = 3;
/// … over at least this time …
const SETTLING_TIME: Duration = Duration::from_millis(200);
/// … none of them delivered quicker than the first by more than this: while a queue empties, each
/// delivery is quicker than the one before …
const SETTLING_FALL_NS: i64 = 20_000_000;
/// … nor slower than the first by more than this.
const SETTLING_RISE_NS: i64 = 1_000_000_000;

/// If a stamp trails the quickest delivery by more than this, it is late, or the sender's clock was
/// set back …
const BEHIND_MIN_NS: i64 = 10_000_000;
/// … and by more than this, it is not dated by the old offset while a new one is learnt.
const DATED_BEHIND_MAX_NS: i64 = 40_000_000;
/// A clock that goes back by this much or more is another clock, not a corrected one …
const ANOTHER_CLOCK_NS: i64 = 500_000_000;
/// … and its offset is learnt over this time instead.
const ANOTHER_CLOCK_TIME: Duration = Duration::from_secs(1);
/// If all stamps are as late as that for this time, the operator is told …
const FAR_LATE_TIME: Duration = Duration::from_secs(1);
/// … or if all are late for this time …
const LATE_TIME: Duration = Duration::from_secs(5);
/// … and at least this many.
const LATE_SAMPLES: u32 = 10;

/// Tracks the minimum of `receive − source` over the last 30 to 60 s. The quickest delivery shows the offset
/// best, and the window follows a clock that drifts. After a gap in the samples the old minimum counts for
/// another 30 s.
///
/// - The first samples of a connection are not believed: they may have waited in a queue, and there
///   are no others to compare them with. The offset counts once it has stopped falling.
/// - A single stamp ahead would be the minimum for a minute, so it is set aside. If the stamps after
///   it agree with it, the sender's clock was set, and the offset is learnt again.
/// - If a stamp goes back and the next ones go on from there, the sender's clock was set back: a
///   connection keeps its order, so a queue never makes a stamp go back. The offset is learnt again if
///   it is larger than just before the step back; where one stamp was only overtaken, it is not. Meanwhile
///   stamps that are a little late are dated by the old offset, and others are refused.
/// - Stamps that are later than before but never went back may have waited. They are dated by the
///   old offset. If it was the clock after all, they are dated too old, never too young. The
///   operator is told.
#[derive(Debug, Clone, Default)]
pub(super) struct ClockOffset {
    known: Option<Minimum>,
    candidate: Settling,
    /// The last stamp that was dated.
    last_source_ns: Option<i64>,
    /// `receive − source` of the last one that was dated before a stamp went back.
    before_ns: Option<i64>,
    /// A stamp went back, and none since has matched the old offset.
    went_back: bool,
    /// Stamps that are all far late, and that are all late.
    late: [Option<Late>; 2],
    news: Option<String>,
}

/// A run of stamps that are all late.
#[derive(Debug, Clone, Copy)]
struct Late {
    since: Time,
    samples: u32,
    least_ns: i64,
    is_told: bool,
}

impl ClockOffset {
    /// What to add to `source_ns` to bring it to our time line: at most `receive − source`.
    ///
    /// # Errors
    /// [`Refusal`]; the stamp must not be used.
    pub(super) fn update(&mut self, receive: Time, source_ns: i64) -> Result<i64, Refusal> {
        let back_ns = self.last_source_ns.map(|last_ns| last_ns.saturating_sub(source_ns));
        if back_ns == Some(0) {
            let why = format!("sent twice (stamp {source_ns} ns)");
            return Err(Refusal::new(GateName::Duplicate, why));
        }
        let offset_ns = receive.as_nanos().saturating_sub(source_ns);
        let known_ns = self.known.as_ref().map(Minimum::ns);
        let behind_ns = known_ns.map(|known_ns| offset_ns.saturating_sub(known_ns));
        let has_gone_back = back_ns.is_some_and(|back_ns| back_ns > 0);
        let is_behind = behind_ns.is_some_and(|behind_ns| behind_ns > BEHIND_MIN_NS);
        let goes_on = self.went_back && self.candidate.goes_on(source_ns, offset_ns);
        self.went_back = is_behind && (goes_on || has_gone_back);
        let is_ahead = behind_ns.is_some_and(|behind_ns| behind_ns < -AHEAD_MAX_NS);
        let is_far_behind = behind_ns.is_some_and(|behind_ns| behind_ns > DATED_BEHIND_MAX_NS);
        let settled = if is_ahead || self.went_back || self.known.is_none() {
            let time = match behind_ns {
                Some(ANOTHER_CLOCK_NS..) => ANOTHER_CLOCK_TIME,
                _ => SETTLING_TIME,
            };
            let settled = self.candidate.take(receive, source_ns, offset_ns, time);
            let before_ns = self.before_ns.filter(|_| self.went_back);
            let has_risen = |settled: &Minimum| {
                before_ns.is_none_or(|ns| settled.ns().saturating_sub(ns) > BEHIND_MIN_NS)
            };
            match settled {
                Ok(settled) if !has_risen(&settled) => {
                    (self.candidate, self.went_back) = (Settling::default(), false);
                    Err(0)
                }
                settled => settled,
            }
        } else {
            self.candidate = Settling::default();
            Err(0)
        };
        let is_set_aside = is_ahead || (self.went_back && is_far_behind);
        if let Some(known) = self.known.as_mut().filter(|_| settled.is_err() && !is_set_aside) {
            if let Some(by_ns) = back_ns.filter(|_| has_gone_back) {
                return Err(went_back(by_ns));
            }
            self.last_source_ns = Some(source_ns);
            if !self.went_back {
                self.before_ns = Some(offset_ns);
            }
            let dated_by_ns = known.update(receive, offset_ns);
            self.note_late(receive, offset_ns.saturating_sub(dated_by_ns));
            return Ok(dated_by_ns);
        }
        match settled {
            Ok(settled) => {
                let settled_ns = settled.ns();
                let set_back_ns = known_ns.filter(|_| self.went_back);
                let news = set_back_ns.map(|known_ns| {
                    let by_s = seconds(settled_ns.saturating_sub(known_ns));
                    format!(
                        "the sender's clock was set back by {by_s:.3} s; its offset was learnt again"
                    )
                });
                let (known, last_source_ns) = (Some(settled), Some(source_ns));
                *self = ClockOffset { known, last_source_ns, news, ..ClockOffset::default() };
                Ok(settled_ns)
            }
            Err(samples) => Err(match (back_ns, behind_ns) {
                (Some(by_ns @ 1..), _) => went_back(by_ns),
                (_, Some(behind_ns @ ..0)) => {
                    let by_s = seconds(behind_ns.saturating_neg());
                    let why =
                        format!("{by_s:.3} s ahead of the sender's clock so far; was it set?");
                    Refusal::new(GateName::Stamp, why)
                }
                _ => {
                    let why = format!(
                        "the sender's clock is still being learnt, from {samples} samples so far"
                    );
                    Refusal { effect: Effect::None, ..Refusal::new(GateName::Stamp, why) }
                }
            }),
        }
    }

    /// What to tell the operator about the sender's clock.
    pub(super) fn news(&mut self) -> Option<String> {
        self.news.take()
    }

    /// Counts stamps that are late by `late_ns`, and reports each kind once.
    fn note_late(&mut self, receive: Time, late_ns: i64) {
        let kinds = [(DATED_BEHIND_MAX_NS, FAR_LATE_TIME), (BEHIND_MIN_NS, LATE_TIME)];
        let mut is_told = false;
        for (run, (min_ns, time)) in self.late.iter_mut().zip(kinds) {
            if late_ns <= min_ns {
                *run = None;
                continue;
            }
            let first = Late { since: receive, samples: 0, least_ns: late_ns, is_told: false };
            let late = run.get_or_insert(first);
            late.samples = late.samples.saturating_add(1);
            late.least_ns = late.least_ns.min(late_ns);
            let lasts = late.samples >= LATE_SAMPLES && receive.since(late.since) >= time;
            // Those that are far late are late as well.
            if lasts && !late.is_told && !is_told {
                self.news = Some(format!(
                    "by their stamps, positions come {:.3} s later than before: delayed, or the sender's \
                     clock was set back or runs slow; they are dated as delayed; if it was the clock, \
                     reconnect the tracker",
                    seconds(late.least_ns)
                ));
            }
            late.is_told |= lasts || is_told;
            is_told |= late.is_told;
        }
    }
}

fn went_back(by_ns: i64) -> Refusal {
    let why = format!("went back by {:.3} s; was the sender's clock set?", seconds(by_ns));
    Refusal::new(GateName::Stamp, why)
}

fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

/// The minimum over this window and the one before.
#[derive(Debug, Clone)]
struct Minimum {
    window_start: Time,
    current_ns: i64,
    previous_ns: Option<i64>,
}

impl Minimum {
    fn ns(&self) -> i64 {
        self.previous_ns.map_or(self.current_ns, |ns| ns.min(self.current_ns))
    }

    fn update(&mut self, receive: Time, offset_ns: i64) -> i64 {
        if receive.since(self.window_start) >= WINDOW {
            self.window_start = receive;
            self.previous_ns = Some(self.current_ns);
            self.current_ns = offset_ns;
        }
        self.current_ns = self.current_ns.min(offset_ns);
        self.ns()
    }
}

/// An offset that is being learnt.
#[derive(Debug, Clone, Default)]
struct Settling {
    since: Option<Time>,
    samples: u32,
    first_ns: i64,
    least_ns: i64,
    last_source_ns: i64,
}

impl Settling {
    /// True if a stamp continues those that the offset is being learnt from.
    fn goes_on(&self, source_ns: i64, offset_ns: i64) -> bool {
        let rise_ns = offset_ns.saturating_sub(self.first_ns);
        self.since.is_some()
            && source_ns >= self.last_source_ns
            && (-SETTLING_FALL_NS..=SETTLING_RISE_NS).contains(&rise_ns)
    }

    /// The offset once it has been stable for `time`; before that, the number of samples it is being
    /// learnt from.
    fn take(
        &mut self,
        receive: Time,
        source_ns: i64,
        offset_ns: i64,
        time: Duration,
    ) -> Result<Minimum, u32> {
        let goes_on = self.goes_on(source_ns, offset_ns);
        let since = match self.since {
            // Sent twice: it says nothing about the clock.
            Some(_) if source_ns == self.last_source_ns => return Err(self.samples),
            Some(since) if goes_on => {
                self.samples += 1;
                self.least_ns = self.least_ns.min(offset_ns);
                since
            }
            _ => {
                (self.samples, self.first_ns, self.least_ns) = (1, offset_ns, offset_ns);
                *self.since.insert(receive)
            }
        };
        self.last_source_ns = source_ns;
        if self.samples < SETTLING_SAMPLES || receive.since(since) < time {
            return Err(self.samples);
        }
        let current_ns = self.least_ns;
        Ok(Minimum { window_start: since, current_ns, previous_ns: None })
    }
}

#[cfg(test)]
mod tests;
