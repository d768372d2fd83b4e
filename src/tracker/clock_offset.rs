//! The offset of the sender's clock from the bench's.

use super::refusal::{Effect, GateName, Refusal};
use crate::units::Time;
use std::time::Duration;

/// The minimum covers this window and the one before.
const WINDOW: Duration = Duration::from_secs(30);
/// The first two windows are as short as this, because the first stamps may be wrong: PLUS fits a line through the
/// times of the last 20 frames.
const FIRST_WINDOWS: Duration = Duration::from_secs(2);
/// The first window counts for 30 s more if the second shows an offset that is larger by more than this: such positions
/// are delayed, and PLUS's first stamps are not as far off.
const FIRST_RISE_MAX_NS: i64 = 300_000_000;
/// A stamp that leads the quickest delivery so far by more than this is not a quicker delivery.
const AHEAD_MAX_NS: i64 = 50_000_000;
/// An offset is learnt from at least this many samples, over at least this time.
const SETTLING_SAMPLES: u32 = 3;
const SETTLING_TIME: Duration = Duration::from_millis(200);
/// Learning starts again if a sample is delivered quicker than the first by more than this: while a queue
/// empties, each delivery is quicker than the one before.
const SETTLING_FALL_NS: i64 = 20_000_000;
/// Learning starts again if a sample is delivered slower than the first by more than this.
const SETTLING_RISE_NS: i64 = 1_000_000_000;

/// If no offset is learnt for this long, the stamps are no clock, and the refusals say what to do.
const LEARNING_MAX: Duration = Duration::from_secs(3);

/// A stamp that trails the quickest delivery by more than this is late, or the sender's clock was set
/// back.
const BEHIND_MIN_NS: i64 = 10_000_000;
/// A stamp that trails it by more than this is far late. While a new offset is learnt, it is not dated by
/// the old one.
const DATED_BEHIND_MAX_NS: i64 = 40_000_000;
/// A clock that goes back by this much or more is another clock, not a corrected one. Its offset is
/// learnt over a longer time.
const ANOTHER_CLOCK_NS: i64 = 500_000_000;
const ANOTHER_CLOCK_TIME: Duration = Duration::from_secs(1);
/// The operator is told when all stamps trail by more than the first limit for 1 s, or by more than the second for
/// 5 s.
const LATE_LIMITS: [(i64, Duration); 2] =
    [(DATED_BEHIND_MAX_NS, Duration::from_secs(1)), (BEHIND_MIN_NS, Duration::from_secs(5))];
/// A run of fewer late stamps than this is not reported.
const LATE_SAMPLES: u32 = 10;

/// Tracks the minimum of `receive − source` over the last 30 to 60 s. The quickest delivery shows the offset
/// best, and the window follows a clock that drifts. After a gap in the samples the old minimum counts for
/// another 30 s. An offset that was just learnt is believed for 4 s: then the samples of its first 2 s no longer count.
///
/// - The first samples of a connection are not believed: they may have waited in a queue, and there
///   are no others to compare them with. The offset counts once it has stopped falling.
/// - A single stamp ahead would be the minimum for a minute, so it is refused. If the stamps after
///   it agree with it, the sender's clock was set, and the offset is learnt again.
/// - If a stamp goes back and the next ones go on from there, the sender's clock was set back: a
///   connection keeps its order, so a queue never makes a stamp go back. The new offset counts if it is
///   larger than just before the step back; otherwise a stamp was only overtaken by another. While it is
///   learnt, stamps that are a little late are dated by the old offset, and others are refused.
/// - Stamps that are later than before but never went back may have waited. They are dated by the
///   old offset. If it was the clock after all, they are dated too old, never too young. The
///   operator is told, and told again when the old minimum no longer counts. A delay that begins within the first
///   2 s and lasts is then taken for the clock, like one that was there from the first sample on.
#[derive(Debug, Clone, Default)]
pub(super) struct ClockOffset {
    known: Option<Known>,
    candidate: Settling,
    /// The first sample, while no offset is known.
    learning_since: Option<Time>,
    /// A stamp went back, and none since has matched the old offset.
    went_back: bool,
    /// The present run of late stamps by each of [`LATE_LIMITS`].
    late: [Option<Late>; 2],
    news: Option<String>,
}

/// An offset that was learnt.
#[derive(Debug, Clone)]
struct Known {
    offset: Minimum,
    /// The last stamp that was dated.
    last_source_ns: i64,
    /// `receive − source` of the last stamp that was dated before a stamp went back.
    before_step_back_ns: Option<i64>,
}

impl Known {
    /// True if `offset` is larger than just before the step back.
    fn has_risen_to(&self, offset: &Minimum) -> bool {
        let rise_ns = |before_ns| offset.ns().saturating_sub(before_ns);
        self.before_step_back_ns.is_none_or(|before_ns| rise_ns(before_ns) > BEHIND_MIN_NS)
    }
}

/// A run of stamps that are all late.
#[derive(Debug, Clone, Copy)]
struct Late {
    since: Time,
    samples: u32,
    least_ns: i64,
    is_reported: bool,
}

impl ClockOffset {
    /// Returns the offset, ns, that converts `source_ns` to our time line: at most `receive − source`.
    ///
    /// # Errors
    /// [`Refusal`]; the stamp must not be used.
    pub(super) fn update(&mut self, receive: Time, source_ns: i64) -> Result<i64, Refusal> {
        let offset_ns = receive.as_nanos().saturating_sub(source_ns);
        let Some(known) = &mut self.known else {
            let since = *self.learning_since.get_or_insert(receive);
            let back_ns = self.candidate.back_ns(source_ns);
            return match self.candidate.add(receive, source_ns, offset_ns, SETTLING_TIME) {
                Ok(offset) => Ok(self.learn(offset, source_ns, None)),
                Err(samples) => {
                    let Refusal { gate, mut why, .. } = match back_ns {
                        Some(0) => sent_twice(source_ns),
                        Some(back_ns @ 1..) => went_back(back_ns),
                        _ => still_learning(samples),
                    };
                    if receive.since(since) >= LEARNING_MAX {
                        why += "; no offset was learnt: set tracker.stamp = \"receive\"";
                    }
                    Err(Refusal { effect: Effect::None, ..Refusal::new(gate, why) })
                }
            };
        };
        let back_ns = known.last_source_ns.saturating_sub(source_ns);
        if back_ns == 0 {
            return Err(sent_twice(source_ns));
        }
        let known_ns = known.offset.ns();
        let behind_ns = offset_ns.saturating_sub(known_ns);
        let is_ahead = behind_ns < -AHEAD_MAX_NS;
        let continues = self.went_back && self.candidate.is_continued_by(source_ns, offset_ns);
        self.went_back = behind_ns > BEHIND_MIN_NS && (continues || back_ns > 0);
        if is_ahead || self.went_back {
            let is_another = behind_ns >= ANOTHER_CLOCK_NS;
            let settling_time = if is_another { ANOTHER_CLOCK_TIME } else { SETTLING_TIME };
            match self.candidate.add(receive, source_ns, offset_ns, settling_time) {
                Ok(offset) if is_ahead => return Ok(self.learn(offset, source_ns, None)),
                Ok(offset) if known.has_risen_to(&offset) => {
                    let by_s = seconds(offset.ns().saturating_sub(known_ns));
                    let news = format!(
                        "the sender's clock was set back by {by_s:.3} s; its offset was learnt again"
                    );
                    return Ok(self.learn(offset, source_ns, Some(news)));
                }
                // A stamp was only overtaken by others: the clock was not set.
                Ok(_) => (self.candidate, self.went_back) = (Settling::default(), false),
                Err(samples) if is_ahead || behind_ns > DATED_BEHIND_MAX_NS => {
                    return Err(if back_ns > 0 {
                        went_back(back_ns)
                    } else if is_ahead {
                        ahead(behind_ns.saturating_neg())
                    } else {
                        still_learning(samples)
                    });
                }
                Err(_) => {}
            }
        } else {
            self.candidate = Settling::default();
        }
        if back_ns > 0 {
            return Err(went_back(back_ns));
        }
        known.last_source_ns = source_ns;
        if !self.went_back {
            known.before_step_back_ns = Some(offset_ns);
        }
        let dated_by_ns = known.offset.update(receive, offset_ns);
        let rise_ns = dated_by_ns.saturating_sub(known_ns);
        self.note_late(receive, offset_ns.saturating_sub(dated_by_ns));
        if rise_ns > DATED_BEHIND_MAX_NS {
            self.news = Some(format!(
                "by their stamps, positions have come {0:.3} s later for 2 s or more; this is now taken for the \
                 sender's clock: they are dated {0:.3} s later",
                seconds(rise_ns)
            ));
        }
        Ok(dated_by_ns)
    }

    /// Starts again with an offset that was learnt up to this stamp.
    fn learn(&mut self, offset: Minimum, source_ns: i64, news: Option<String>) -> i64 {
        let ns = offset.ns();
        let known = Known { offset, last_source_ns: source_ns, before_step_back_ns: None };
        *self = ClockOffset { known: Some(known), news, ..ClockOffset::default() };
        ns
    }

    /// Takes the message to the operator about the sender's clock, if there is one.
    pub(super) fn news(&mut self) -> Option<String> {
        self.news.take()
    }

    /// Counts a stamp that is late by `late_ns`, and reports a run of late stamps once.
    fn note_late(&mut self, receive: Time, late_ns: i64) {
        let mut is_reported = false;
        for (run, (limit_ns, time)) in self.late.iter_mut().zip(LATE_LIMITS) {
            if late_ns <= limit_ns {
                *run = None;
                continue;
            }
            let first = Late { since: receive, samples: 0, least_ns: late_ns, is_reported: false };
            let late = run.get_or_insert(first);
            late.samples = late.samples.saturating_add(1);
            late.least_ns = late.least_ns.min(late_ns);
            let lasts = late.samples >= LATE_SAMPLES && receive.since(late.since) >= time;
            // A run that exceeds the first limit exceeds the second, too.
            if lasts && !late.is_reported && !is_reported {
                self.news = Some(format!(
                    "by their stamps, positions come {:.3} s later than before: delayed, or the sender's \
                     clock was set back or runs slow; they are dated as delayed; if it was the clock, \
                     reconnect the tracker",
                    seconds(late.least_ns)
                ));
            }
            late.is_reported |= lasts || is_reported;
            is_reported |= late.is_reported;
        }
    }
}

fn sent_twice(source_ns: i64) -> Refusal {
    Refusal::new(GateName::Duplicate, format!("sent twice (stamp {source_ns} ns)"))
}

fn went_back(by_ns: i64) -> Refusal {
    let why = format!("went back by {:.3} s; was the sender's clock set?", seconds(by_ns));
    Refusal::new(GateName::Stamp, why)
}

fn ahead(by_ns: i64) -> Refusal {
    let why = format!("{:.3} s ahead of the sender's clock so far; was it set?", seconds(by_ns));
    Refusal::new(GateName::Stamp, why)
}

fn still_learning(samples: u32) -> Refusal {
    let why = format!("the sender's clock is still being learnt, from {samples} samples so far");
    Refusal { effect: Effect::None, ..Refusal::new(GateName::Stamp, why) }
}

fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

/// The minimum over this window and the one before.
#[derive(Debug, Clone)]
struct Minimum {
    window_start: Time,
    window: Duration,
    current_ns: i64,
    previous_ns: Option<i64>,
}

impl Minimum {
    fn ns(&self) -> i64 {
        self.previous_ns.map_or(self.current_ns, |ns| ns.min(self.current_ns))
    }

    fn update(&mut self, receive: Time, offset_ns: i64) -> i64 {
        if receive.since(self.window_start) >= self.window {
            self.window_start = receive;
            let first_ns = self.previous_ns.filter(|ns| {
                self.window < WINDOW && self.current_ns.saturating_sub(*ns) > FIRST_RISE_MAX_NS
            });
            self.window = if self.previous_ns.is_none() { FIRST_WINDOWS } else { WINDOW };
            self.previous_ns = Some(first_ns.unwrap_or(self.current_ns));
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
    /// How far a stamp goes back from the one before, ns; `None` for the first stamp.
    fn back_ns(&self, source_ns: i64) -> Option<i64> {
        self.since.map(|_| self.last_source_ns.saturating_sub(source_ns))
    }

    /// True if a stamp continues those that the offset is being learnt from.
    fn is_continued_by(&self, source_ns: i64, offset_ns: i64) -> bool {
        let rise_ns = offset_ns.saturating_sub(self.first_ns);
        self.since.is_some()
            && source_ns >= self.last_source_ns
            && (-SETTLING_FALL_NS..=SETTLING_RISE_NS).contains(&rise_ns)
    }

    /// Adds a stamp. Returns the offset once it has been stable for `time`.
    ///
    /// # Errors
    /// Before that, the number of samples so far.
    fn add(
        &mut self,
        receive: Time,
        source_ns: i64,
        offset_ns: i64,
        time: Duration,
    ) -> Result<Minimum, u32> {
        let continues = self.is_continued_by(source_ns, offset_ns);
        let since = match self.since {
            // Sent twice: it says nothing about the clock.
            Some(_) if source_ns == self.last_source_ns => return Err(self.samples),
            Some(since) if continues => {
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
        let window = FIRST_WINDOWS;
        Ok(Minimum { window_start: since, window, current_ns, previous_ns: None })
    }
}

#[cfg(test)]
mod tests;
