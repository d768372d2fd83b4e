//! Runs that a fault stops: checks what must hold for every stop, and compares it with `docs/hazards.md`.

use super::bench::{Bench, Detection, Position, Stopping, configured};
use needle_bench::canopen::Frame;
use needle_bench::canopen::cia402::DriveState;
use needle_bench::session::{Record, Severity, State};
use needle_bench::units::Time;
use std::time::Duration;

const HAZARDS: &str = include_str!("../../docs/hazards.md");

/// Identifiers of RPDO1 of both drives: controlword and target.
const RPDOS: [u16; 2] = [0x201, 0x202];
/// Bit 3 of the controlword: enable operation.
const ENABLE: u8 = 1 << 3;

/// A run that a fault stopped, checked.
pub(crate) struct Stop {
    pub(crate) bench: Bench,
    pub(crate) struck: Time,
    struck_at: Position,
    detection: Detection,
    stopping: Stopping,
}

/// Runs to 10 mm of 30, where the needle turns by 3.5° per mm, and causes a fault with `strike`: once a fault that
/// lasts, once one that ends as soon as it is detected.
pub(crate) fn stopped(sets: &[&str], strike: impl Fn(&mut Bench)) -> [Stop; 2] {
    [false, true].map(|heals| {
        let mut bench = Bench::new(configured(&[sets, &["insertion.depth_mm=30"]].concat()));
        bench.heals = heals;
        bench.run_to_mm(10.0);
        Stop::of(bench, &strike)
    })
}

impl Stop {
    /// Causes the fault now, runs to the end, and checks what must hold after any fault.
    pub(crate) fn of(mut bench: Bench, strike: impl Fn(&mut Bench)) -> Stop {
        let (struck, struck_at) = (bench.now, bench.stage.position_true(bench.now));
        strike(&mut bench);
        bench.run_to_end();
        assert!(!bench.completed(), "the run was not stopped");
        let (detection, stopping) = bench.detection.zip(bench.stopping).expect("it stopped");
        let stop = Stop { bench, struck, struck_at, detection, stopping };
        stop.is_safe();
        stop.commands_nothing();
        stop.is_recorded();
        stop
    }

    pub(crate) fn detected_after(&self) -> Duration {
        self.detection.time.since(self.struck)
    }

    /// Travel from the fault to its detection, and from there to standstill.
    pub(crate) fn travel(&self) -> [Position; 2] {
        let end = self.bench.stage.position_true(self.bench.now);
        let way = |from: Position, to: Position| ((to.0 - from.0).abs(), (to.1 - from.1).abs());
        [way(self.struck_at, self.detection.position), way(self.detection.position, end)]
    }

    /// No drive takes set-points. `run_to_end` has checked that both stand.
    fn is_safe(&self) {
        for drive in self.bench.stage.drives() {
            assert_ne!(drive.state(), DriveState::OperationEnabled);
        }
    }

    /// Asserts that no drive was ever told to switch on.
    pub(crate) fn never_had_power(&self) {
        assert!(self.bench.sent.iter().all(|frame| !enables(frame)));
    }

    /// After the stop the targets stay those of the last SYNC, and no drive is enabled or started.
    fn commands_nothing(&self) {
        let (before, after) = self.bench.sent.split_at(self.stopping.sent);
        let is_sync = |frame: &Frame| frame.cob_id() == Some(0x080);
        let in_effect = &before[..before.iter().rposition(is_sync).unwrap_or_default()];
        for id in RPDOS {
            let of_axis = |frame: &&Frame| frame.cob_id() == Some(id);
            let target = |frame: &Frame| frame.data().get(2..6).map(<[u8]>::to_vec);
            // A run that had sent no target sends one with its stop: the position of the axis, as `travel` shows.
            let taken_up = in_effect.iter().rev().find(of_axis);
            let sent = taken_up.or_else(|| after.iter().find(of_axis));
            let last = sent.and_then(target);
            for frame in after.iter().filter(of_axis) {
                assert_eq!(target(frame), last, "a new target after the stop: {frame}");
                assert_eq!(frame.data()[0] & ENABLE, 0, "enabled after the stop: {frame}");
            }
        }
        let started = after.iter().any(|f| f.cob_id() == Some(0) && f.data().first() == Some(&1));
        assert!(!started, "a node was started after the stop");
    }

    /// The record has everything that reached the session, steps without a gap, the fault once, and the end as its
    /// last state.
    fn is_recorded(&self) {
        let bench = &self.bench;
        assert_eq!(bench.recorded_frames(), bench.received.0);
        let samples = bench
            .records
            .iter()
            .filter(|r| matches!(r, Record::Sample(_) | Record::Target(_)))
            .count();
        assert_eq!(samples, bench.received.1);
        assert!(bench.steps().enumerate().all(|(n, step)| step.step as usize == n));
        let faults: Vec<_> = bench
            .records
            .iter()
            .filter_map(|record| match record {
                Record::Event { time, severity: Severity::Fault, text, .. } => Some((*time, text)),
                _ => None,
            })
            .collect();
        assert_eq!(faults, [(self.stopping.time, &bench.reason())]);
        let is_end =
            |record: &Record| matches!(record, Record::State { state: State::Stopped, .. });
        assert!(bench.records.last().is_some_and(is_end), "{:?}", bench.records.last());
    }
}

/// True for a set-point frame that tells a drive to switch on.
pub(crate) fn enables(frame: &Frame) -> bool {
    frame.cob_id().is_some_and(|id| RPDOS.contains(&id))
        && frame.data().first().is_some_and(|controlword| controlword & 1 != 0)
}

/// Asserts the stop reason, that the fault was detected within `within_ms`, and that the row of `docs/hazards.md`
/// for `test` has these values.
pub(crate) fn documented(stops: &[Stop], test: &str, within_ms: f64, reason: &str) {
    assert!(reason.chars().count() <= 200, "{reason}");
    for stop in stops {
        assert_eq!(stop.bench.reason(), reason);
    }
    let most = |of: fn(&Stop) -> f64| stops.iter().map(of).fold(0.0, f64::max);
    let measured = Measured {
        detected_ms: most(|stop| stop.detected_after().as_secs_f64() * 1e3),
        before: (most(|stop| stop.travel()[0].0), most(|stop| stop.travel()[0].1)),
        after: (most(|stop| stop.travel()[1].0), most(|stop| stop.travel()[1].1)),
    };
    measured.is_documented(test, within_ms, reason);
}

/// The measured figures of a fault; travel in mm and rad.
#[derive(Debug)]
pub(crate) struct Measured {
    pub(crate) detected_ms: f64,
    /// From the fault to its detection.
    pub(crate) before: Position,
    /// From there to standstill.
    pub(crate) after: Position,
}

impl Measured {
    pub(crate) fn is_documented(&self, test: &str, within_ms: f64, message: &str) {
        let Measured { detected_ms, before, after } = self;
        assert!(*detected_ms <= within_ms, "{test}: detected after {detected_ms} ms");
        let row = format!(
            "{within_ms:.0} | {detected_ms:.0} | {:.2} / {:.2} | {:.2} / {:.2} | {message} | `{test}` |",
            before.0,
            before.1.to_degrees(),
            after.0,
            after.1.to_degrees(),
        );
        is_row(test, &row);
    }
}

/// Asserts that the row of `docs/hazards.md` for `test` ends in `row`.
pub(crate) fn is_row(test: &str, row: &str) {
    let found = HAZARDS.lines().find(|line| line.contains(&format!("`{test}`")));
    let found = found.unwrap_or_else(|| panic!("docs/hazards.md has no row: {row}"));
    assert!(agree(found, row), "docs/hazards.md has\n{found}\nmeasured:\n{row}");
}

/// True if `line` ends in `row`. Numbers may differ by a unit of their last digit, because another platform may
/// round otherwise.
fn agree(line: &str, row: &str) -> bool {
    let words = |text: &str| text.split_whitespace().rev().map(str::to_owned).collect::<Vec<_>>();
    let (line, row) = (words(line), words(row));
    line.len() > row.len()
        && row.iter().zip(&line).all(|(a, b)| match (a.parse::<f64>(), b.parse::<f64>()) {
            (Ok(x), Ok(y)) => {
                let unit = if a.contains('.') { 0.01 } else { 1.0 };
                (x - y).abs() <= 1.001 * unit
            }
            _ => a == b,
        })
}
