//! Stops the bench's heartbeat on purpose, to prove that each drive notices in time and stops.

use crate::canopen::Frame;
use crate::canopen::emcy::EmcyCode;
use crate::session::{Lane, PROVED, Record, Severity, Shell, State, Task};
use crate::stage::{Axis, Dialogue, PerAxis, QuickStop, StageConfig, StageEvent};
use crate::units::Time;
use std::time::Duration;

/// A drive may notice a missing heartbeat this much later than its configured timeout.
const MARGIN: Duration = Duration::from_millis(200);

/// The time without a heartbeat of the bench. The drives are read by SDO: a drive that notices the missing heartbeat
/// usually leaves Operational, and then sends no PDO.
#[derive(Debug)]
struct HeartbeatTest {
    /// When the last heartbeat was sent.
    since: Time,
    /// The time within which a drive must notice.
    within: Duration,
    noticed_after: PerAxis<Option<Duration>>,
    watch: QuickStop,
}

impl HeartbeatTest {
    /// Begins at `now`, after the last heartbeat at `since`.
    fn new(config: &StageConfig, now: Time, since: Time) -> Self {
        let within = config.bus.heartbeat_timeout() + MARGIN;
        let watch = QuickStop::watch(config, now, since + within + config.power.stop_timeout);
        HeartbeatTest { since, within, noticed_after: PerAxis::default(), watch }
    }

    /// When the verdict or the watch is due.
    fn deadline(&self) -> Time {
        let noticed = self.noticed_after.all(|after| after.is_some());
        let notice = if noticed { Time::NEVER } else { self.since + self.within };
        self.watch.deadline().min(notice)
    }

    /// The text of the proof.
    fn proof(&self) -> String {
        let noticed = Axis::BOTH.map(|axis| {
            let after_ms = self.noticed_after[axis].unwrap_or_default().as_millis();
            format!("{axis} after {after_ms} ms")
        });
        format!(
            "{PROVED}both drives notice a silent bench and stand: {} (limit {} ms)",
            noticed.join(", "),
            self.within.as_millis()
        )
    }

    /// The proof, once both drives have noticed and stand; `None` until then. An error names the drives that
    /// have not noticed in time, or were not seen to stop.
    fn verdict(&self, now: Time) -> Option<Result<String, String>> {
        let in_time =
            |axis: &Axis| self.noticed_after[*axis].is_some_and(|after| after <= self.within);
        let not_noticed: Vec<String> =
            Axis::BOTH.iter().filter(|axis| !in_time(axis)).map(Axis::to_string).collect();
        if !not_noticed.is_empty() {
            let ended = now >= self.since + self.within;
            return ended.then(|| {
                Err(format!(
                    "{}: no emergency 0x8130 within {} ms of the bench's last heartbeat: if the \
                     bench dies, it may go on; does the drive watch a heartbeat (0x1016), \
                     and send emergencies?",
                    not_noticed.join(", "),
                    self.within.as_millis()
                ))
            });
        }
        let [insertion, rotation] = Axis::BOTH.map(|axis| self.watch.outcome(axis));
        let moving: Vec<String> =
            [insertion?, rotation?].into_iter().filter_map(Result::err).collect();
        Some(match moving.is_empty() {
            true => Ok(self.proof()),
            false => Err(format!(
                "{}; it noticed the bench's silence and was not seen to stop: if the bench dies, \
                 it may go on; see abort_connection_option (0x6007)",
                moving.join(", ")
            )),
        })
    }
}

/// The task that stops the bench's heartbeat while both axes are held. SYNC and set-points go on.
#[derive(Debug, Default)]
pub(super) struct Prove {
    test: Option<HeartbeatTest>,
}

impl Task for Prove {
    fn take_stage_event(&mut self, shell: &mut Shell, event: &StageEvent) -> Result<(), String> {
        match event {
            StageEvent::Ready => {
                shell.enter(State::Silent);
                let since = shell.stop_heartbeat();
                self.test = Some(HeartbeatTest::new(shell.config(), shell.now, since));
            }
            StageEvent::Emergency(axis, emcy) if emcy.code == EmcyCode::HEARTBEAT => {
                if let Some(test) = &mut self.test {
                    let after = shell.now.since(test.since);
                    let after_ms = test.noticed_after[*axis].get_or_insert(after).as_millis();
                    let text = format!("{axis}: noticed the bench's silence after {after_ms} ms");
                    shell.report(Lane::Session, Severity::Info, text);
                }
            }
            StageEvent::Feedback(feedback) => shell.record(Record::Stage(*feedback)),
            _ => {}
        }
        Ok(())
    }

    fn take_frame(&mut self, shell: &Shell, frame: &Frame) {
        if let Some(test) = &mut self.test {
            test.watch.handle_frame(shell.now, frame);
        }
    }

    fn handle_timeout(&mut self, shell: &mut Shell) -> Result<(), String> {
        let Some(test) = self.test.as_mut().filter(|_| shell.is_running()) else {
            return Ok(());
        };
        if shell.now >= test.watch.deadline() {
            test.watch.handle_timeout(shell.now);
        }
        let verdict = test.verdict(shell.now);
        while let Some(frame) = test.watch.poll_transmit() {
            shell.send(frame);
        }
        match verdict {
            None => Ok(()),
            Some(Err(reason)) => Err(reason),
            Some(Ok(proof)) => {
                shell.report(Lane::Session, Severity::Info, proof);
                shell.complete_by_quick_stop();
                Ok(())
            }
        }
    }

    fn deadline(&self, _: &Shell) -> Time {
        self.test.as_ref().map_or(Time::NEVER, HeartbeatTest::deadline)
    }
}
