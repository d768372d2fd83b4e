//! Runs a dialogue with the drives, on a bus or on the virtual stage.

use std::thread;
use std::time::Duration;

use super::timing::Clock;
use crate::canopen::Frame;
use crate::emulator::{StageOutput, VirtualStage};
use crate::stage::Dialogue;
use crate::transport::can::{BusEvent, CanBus, CanError};
use crate::units::Time;

/// Interval between two attempts to send a frame that the bus refused.
const RETRY_PERIOD: Duration = Duration::from_millis(100);

/// The bus errors of a dialogue that continued in spite of them.
#[derive(Debug, Default)]
pub struct BusErrors {
    /// Attempts to send that the bus refused.
    pub refused: u32,
    /// Frames that the bus refused until the end.
    pub unsent: Vec<Frame>,
    /// The first error.
    pub first: Option<CanError>,
}

impl BusErrors {
    /// Tries to send each unsent frame, even if the bus refuses those before it.
    fn send(&mut self, bus: &mut dyn CanBus) {
        for frame in std::mem::take(&mut self.unsent) {
            if let Err(error) = bus.send(&frame) {
                self.refused += 1;
                self.unsent.push(frame);
                self.first.get_or_insert(error);
            }
        }
    }
}

/// Runs `dialogue` on `bus` to its end, whatever errors the bus reports. A frame that the bus
/// refuses is sent again, ten times a second, until the dialogue is over and `give_up` has passed.
/// Without `give_up` the first error ends it.
pub fn talk_live(
    dialogue: &mut dyn Dialogue,
    bus: &mut dyn CanBus,
    clock: Clock,
    give_up: Option<Time>,
) -> BusErrors {
    let mut trouble = BusErrors::default();
    let mut retry = Time::NEVER;
    loop {
        let now = clock.now();
        let waiting = trouble.unsent.len();
        while let Some(frame) = dialogue.poll_transmit() {
            // The dialogue repeats an unanswered request, even if it was never sent.
            if !trouble.unsent.contains(&frame) {
                trouble.unsent.push(frame);
            }
        }
        if trouble.unsent.len() > waiting || now >= retry {
            trouble.send(bus);
            retry = if trouble.unsent.is_empty() { Time::NEVER } else { now + RETRY_PERIOD };
        }
        if give_up.is_none() && trouble.first.is_some() {
            return trouble;
        }
        let due = match dialogue.is_over() {
            true if trouble.unsent.is_empty() || give_up.is_none_or(|at| now >= at) => {
                return trouble;
            }
            true => retry,
            false if now >= dialogue.deadline() => {
                dialogue.handle_timeout(now);
                continue;
            }
            false => dialogue.deadline().min(retry),
        };
        match bus.receive(due.since(now)) {
            Ok(Some(BusEvent::Frame(frame))) => dialogue.handle_frame(clock.now(), &frame),
            Ok(Some(BusEvent::Error(error))) => tracing::warn!("{error}"),
            Ok(None) => {}
            Err(error) => {
                trouble.first.get_or_insert(error);
                thread::sleep(due.since(now).min(RETRY_PERIOD));
            }
        }
    }
}

/// Runs `dialogue` with the drives of `stage`, in virtual time, to its end.
pub fn talk_virtual(dialogue: &mut dyn Dialogue, stage: &mut VirtualStage) {
    let mut now = Time::ZERO;
    while !dialogue.is_over() {
        let mut quiet = true;
        while let Some(frame) = dialogue.poll_transmit() {
            quiet = false;
            stage.handle_frame(now, &frame);
        }
        while let Some(output) = stage.poll() {
            if let StageOutput::Frame(frame) = output {
                quiet = false;
                dialogue.handle_frame(now, &frame);
            }
        }
        if quiet {
            now = now.max(dialogue.deadline().min(stage.deadline()));
            stage.handle_timeout(now);
            dialogue.handle_timeout(now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::canopen::cia402::DriveState;
    use crate::canopen::nmt::NmtState;
    use crate::config::Config;
    use crate::stage::{Axis, QuickStop, StageConfig};
    use std::io;

    /// The virtual stage in real time, on a bus that refuses frames and fails to receive.
    struct RefusingBus<F> {
        stage: VirtualStage,
        clock: Clock,
        refuses: F,
        /// Frames that it accepted.
        sent: Vec<Frame>,
        /// Number of calls of `receive` that still fail.
        receive_errors: u32,
    }

    impl<F: FnMut(&Frame) -> bool + Send> CanBus for RefusingBus<F> {
        fn send(&mut self, frame: &Frame) -> Result<(), CanError> {
            if (self.refuses)(frame) {
                let interface = "can0".to_owned();
                return Err(CanError::TransmitQueueFull { interface, frame: *frame });
            }
            self.sent.push(*frame);
            self.stage.handle_frame(self.clock.now(), frame);
            Ok(())
        }

        fn receive(&mut self, timeout: Duration) -> Result<Option<BusEvent>, CanError> {
            if self.receive_errors > 0 {
                self.receive_errors -= 1;
                let (interface, action) = ("can0".to_owned(), "receive");
                return Err(CanError::Io { interface, action, reason: io::Error::other("broken") });
            }
            let end = self.clock.now() + timeout;
            loop {
                while let Some(output) = self.stage.poll() {
                    if let StageOutput::Frame(frame) = output {
                        return Ok(Some(BusEvent::Frame(frame)));
                    }
                }
                let now = self.clock.now();
                if now >= end {
                    return Ok(None);
                }
                thread::sleep(self.stage.deadline().min(end).since(now));
                self.stage.handle_timeout(self.clock.now());
            }
        }

        fn name(&self) -> &str {
            "can0"
        }

        fn dropped(&self) -> Option<u64> {
            Some(0)
        }
    }

    fn stage() -> (StageConfig, VirtualStage) {
        let config = Config::from_sources(&[], &[]).expect("valid");
        let mut stage = config.to_stage().expect("valid");
        stage.power.stop_timeout = Duration::from_millis(600);
        stage.bus.sdo_timeout_ms = 50;
        let emulated = config.virtual_stage().expect("valid");
        (stage, VirtualStage::new(emulated, Time::ZERO))
    }

    /// Stops a stage on a bus that refuses frames and fails to receive `receive_errors` times.
    fn stop<F: FnMut(&Frame) -> bool + Send>(
        refuses: F,
        receive_errors: u32,
    ) -> (RefusingBus<F>, QuickStop, BusErrors, Duration) {
        let (config, stage) = stage();
        let clock = Clock::start();
        let mut bus = RefusingBus { stage, clock, refuses, sent: Vec::new(), receive_errors };
        let begun = clock.now();
        let mut quick_stop = QuickStop::new(&config, begun);
        let trouble =
            talk_live(&mut quick_stop, &mut bus, clock, Some(begun + config.power.stop_timeout));
        (bus, quick_stop, trouble, clock.now().since(begun))
    }

    #[test]
    fn a_stop_is_sent_again_until_the_bus_takes_it() {
        for count in [1, 2, 7, 20] {
            let mut left = count;
            let refuses = |_: &Frame| {
                let is_refused = left > 0;
                left -= u32::from(is_refused);
                is_refused
            };
            let (bus, quick_stop, trouble, _) = stop(refuses, 2);
            for axis in Axis::BOTH {
                assert!(
                    quick_stop.outcome(axis).is_some_and(|result| result.is_ok()),
                    "{count}: {axis}"
                );
            }
            assert_eq!((trouble.refused, trouble.unsent.as_slice()), (count, &[][..]));
            let first = trouble.first.expect("an error").to_string();
            assert!(
                first.starts_with("can0 takes no more frames, 000#8001 was not sent"),
                "{first}"
            );
            for drive in bus.stage.drives() {
                assert_eq!(drive.state(), DriveState::SwitchOnDisabled);
                assert_eq!(drive.nmt_state(), NmtState::PreOperational);
            }
        }
    }

    #[test]
    fn one_drive_is_stopped_at_once_although_the_frames_to_the_other_are_refused() {
        let of_insertion = |frame: &Frame| {
            frame.cob_id() == Some(0x601) || (frame.cob_id(), frame.data()) == (Some(0), &[0x80, 1])
        };
        let (bus, quick_stop, trouble, took) = stop(of_insertion, 0);
        let sent: Vec<String> = bus.sent.iter().take(2).map(Frame::to_string).collect();
        assert_eq!(sent, ["000#8002", "602#2B40600002000000"]);
        assert!(quick_stop.outcome(Axis::Rotation).is_some_and(|result| result.is_ok()));
        let error = quick_stop.outcome(Axis::Insertion).expect("over").expect_err("not confirmed");
        assert!(error.ends_with("power off was not confirmed"), "{error}");
        let unsent: Vec<String> = trouble.unsent.iter().map(Frame::to_string).collect();
        for frame in ["000#8001", "601#2B40600002000000", "601#2B40600000000000"] {
            assert!(unsent.contains(&frame.to_owned()), "no {frame} in {unsent:?}");
        }
        // After the stop timeout the bench tries as long again to take power off.
        assert!((Duration::from_millis(1200)..Duration::from_secs(2)).contains(&took), "{took:?}");
        let per_s = f64::from(trouble.refused) / took.as_secs_f64();
        assert!((10.0..100.0).contains(&per_s), "{per_s} a second");
    }

    #[test]
    fn a_stop_on_a_dead_bus_ends_at_its_deadline() {
        let (bus, quick_stop, trouble, took) = stop(|_| true, u32::MAX);
        assert!(bus.sent.is_empty());
        for axis in Axis::BOTH {
            let error = quick_stop.outcome(axis).expect("over").expect_err("not confirmed");
            assert!(error.ends_with("power off was not confirmed"), "{axis}: {error}");
        }
        assert!(trouble.unsent.len() >= 4, "{:?}", trouble.unsent);
        assert!((Duration::from_millis(600)..Duration::from_secs(2)).contains(&took), "{took:?}");
    }
}
