//! The one loop of every run, in real time and in virtual time.

use crate::canopen::Frame;
use crate::emulator::Truth;
use crate::session::{
    Direction, Input, Machine, OperatorCommand, Outcome, Output, Progress, Record,
};
use crate::transport::can::CanError;
use crate::units::Time;

/// Takes the records of a run.
pub(super) trait Witness {
    /// Takes one record, with the truth of its moment where the run is emulated.
    fn take(&mut self, record: Record, truth: Option<Truth>);

    /// The run has come this far.
    fn progress(&mut self, _progress: Progress) {}

    /// What the operator asks for next, if anything.
    fn command(&mut self) -> Option<OperatorCommand> {
        None
    }

    /// Why the runtime itself wants the run to end; `None` of a run that `is_asked` to already.
    fn stop_reason(&mut self, _now: Time, _is_asked: bool) -> Option<String> {
        None
    }
}

/// A run that nobody watches or interrupts: its records go to a function.
impl<F: FnMut(Record, Option<Truth>)> Witness for F {
    fn take(&mut self, record: Record, truth: Option<Truth>) {
        self(record, truth);
    }
}

/// What a machine is joined to: a bus, a tracker, a clock.
pub(super) trait World {
    fn machine(&mut self) -> &mut dyn Machine;

    fn witness(&mut self) -> &mut dyn Witness;

    fn now(&self) -> Time;

    /// Gives `input` to the machine with the time of now.
    fn give(&mut self, input: Input);

    /// Sends a frame that was made at `made`; false of one that is too old to be sent.
    ///
    /// # Errors
    /// What the bus says that does not take it.
    fn send(&mut self, made: Time, frame: &Frame) -> Result<bool, CanError>;

    fn record(&mut self, record: Record);

    /// Gives the machine what has come since; true when there was anything that may not wait.
    fn take_arrived(&mut self) -> bool;

    /// Goes on to the next thing that is due or comes.
    fn go_on(&mut self);
}

/// Carries a run on to its end.
pub(super) fn drive(world: &mut impl World) -> Outcome {
    let mut stop_asked = false;
    loop {
        carry_out(world);
        if let Some(outcome) = world.machine().outcome() {
            return outcome.clone();
        }
        if world.take_arrived() {
            continue;
        }
        // What answers them leaves before anything that is due is done.
        carry_out(world);
        let now = world.now();
        match world.witness().stop_reason(now, stop_asked) {
            Some(reason) => {
                stop_asked = true;
                world.give(Input::Stop(reason));
            }
            None => {
                // One at a time: however many there are, what is due is done in between.
                if let Some(command) = world.witness().command() {
                    world.give(Input::Operator(command));
                    carry_out(world);
                }
                world.go_on();
            }
        }
    }
}

/// Sends everything that the machine has to send, and then records everything that it has to say: a
/// SYNC waits for no record. A frame is recorded as sent if it was. One that the bus does not take is a
/// fault, which the machine is told once; what was queued behind it is stale and never sent, so that the
/// frames that stop the axes are the next to be tried.
pub(super) fn carry_out(world: &mut impl World) {
    let (mut records, mut has_failed) = (Vec::new(), false);
    while let Some(output) = world.machine().poll() {
        let (time, frame) = match output {
            Output::Transmit { time, frame } => (time, frame),
            Output::Record(record) => {
                records.push(record);
                continue;
            }
        };
        match world.send(time, &frame) {
            Ok(true) => records.push(Record::Can { time, direction: Direction::Sent, frame }),
            Ok(false) => {}
            // The frames that follow the fault are tried all the same.
            Err(_) if has_failed => {}
            Err(error) => {
                has_failed = true;
                records.extend(left_records(world));
                world.give(Input::BusFault(error.to_string()));
            }
        }
    }
    records.into_iter().for_each(|record| world.record(record));
}

/// The records among what the machine has left to say; the frames among it are forgotten.
fn left_records(world: &mut impl World) -> Vec<Record> {
    let left = std::iter::from_fn(|| world.machine().poll());
    left.filter_map(|output| match output {
        Output::Record(record) => Some(record),
        Output::Transmit { .. } => None,
    })
    .collect()
}
