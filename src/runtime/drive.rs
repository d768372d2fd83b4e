//! The loop of every run, in real time and in virtual time.

use crate::canopen::Frame;
use crate::emulator::Truth;
use crate::session::{
    Direction, Input, Machine, OperatorCommand, Outcome, Output, Progress, Record,
};
use crate::transport::can::CanError;
use crate::units::Time;

/// Receives the records and the progress of a run, and supplies the operator's commands and the reason for a stop.
pub(super) trait RunMonitor {
    /// Takes one record; in an emulated run with the true pose at that time.
    fn take(&mut self, record: Record, truth: Option<Truth>);

    /// Takes the progress of the run.
    fn progress(&mut self, _progress: Progress) {}

    /// The operator's next command, if there is one.
    fn command(&mut self) -> Option<OperatorCommand> {
        None
    }

    /// The reason to stop the run, if the operator or the record gives one; `None` if the run `is_stopping` already.
    fn stop_reason(&mut self, _now: Time, _is_stopping: bool) -> Option<String> {
        None
    }
}

/// The records go to a function; there is no operator.
impl<F: FnMut(Record, Option<Truth>)> RunMonitor for F {
    fn take(&mut self, record: Record, truth: Option<Truth>) {
        self(record, truth);
    }
}

/// The machine of a run with its bus, tracker and clock.
pub(super) trait RunIo {
    fn machine(&mut self) -> &mut dyn Machine;

    fn monitor(&mut self) -> &mut dyn RunMonitor;

    fn now(&self) -> Time;

    /// Gives `input` to the machine at the present time.
    fn give(&mut self, input: Input);

    /// Sends a frame that was made at `made`; false if it is stale and was not sent.
    ///
    /// # Errors
    /// The bus refuses the frame.
    fn send(&mut self, made: Time, frame: &Frame) -> Result<bool, CanError>;

    fn record(&mut self, record: Record);

    /// Gives the machine the inputs that have arrived; true if its outputs must be sent before anything else is
    /// done.
    fn take_arrived(&mut self) -> bool;

    /// Waits for the next deadline or input, and gives it to the machine.
    fn wait_for_input(&mut self);
}

/// Runs the machine to its end.
pub(super) fn drive(io: &mut impl RunIo) -> Outcome {
    let mut is_stopping = false;
    loop {
        flush_outputs(io);
        if let Some(outcome) = io.machine().outcome() {
            return outcome.clone();
        }
        if io.take_arrived() {
            continue;
        }
        // Outputs are sent before the machine does what is due.
        flush_outputs(io);
        let now = io.now();
        match io.monitor().stop_reason(now, is_stopping) {
            Some(reason) => {
                is_stopping = true;
                io.give(Input::Stop(reason));
            }
            None => {
                // One command at a time, so that many commands delay nothing that is due.
                if let Some(command) = io.monitor().command() {
                    io.give(Input::Operator(command));
                    flush_outputs(io);
                }
                io.wait_for_input();
            }
        }
    }
}

/// Sends the machine's frames, and only then records its records: a SYNC waits for no record. A frame is
/// recorded only if it was sent. If the bus refuses a frame, the machine is given the fault, once. The frames
/// queued behind the refused one are stale and never sent, so the frames that stop the axes are tried next.
pub(super) fn flush_outputs(io: &mut impl RunIo) {
    let (mut records, mut has_failed) = (Vec::new(), false);
    while let Some(output) = io.machine().poll() {
        let (time, frame) = match output {
            Output::Transmit { time, frame } => (time, frame),
            Output::Record(record) => {
                records.push(record);
                continue;
            }
        };
        match io.send(time, &frame) {
            Ok(true) => records.push(Record::Can { time, direction: Direction::Sent, frame }),
            Ok(false) => {}
            // The frames with which the machine answers the fault are still tried.
            Err(_) if has_failed => {}
            Err(error) => {
                has_failed = true;
                while let Some(stale) = io.machine().poll() {
                    if let Output::Record(record) = stale {
                        records.push(record);
                    }
                }
                io.give(Input::BusFault(error.to_string()));
            }
        }
    }
    records.into_iter().for_each(|record| io.record(record));
}
