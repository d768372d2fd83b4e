//! A session and the virtual stage in one thread, in virtual time: no sleeps, no sockets.

use super::interrupt::Interrupt;
use super::sink::{RunReport, Sink};
use crate::emulator::{StageOutput, TrackedTip, Truth, VirtualStage};
use crate::session::{Input, Outcome, Output, Record, Session};
use crate::tracker::{Event, Replay, Sample, Validity};
use crate::units::Time;
use serde_json::Map;

/// Where a run in virtual time has its tip positions from.
#[derive(Debug)]
pub enum Tips {
    /// The virtual stage's own tracker, under the name of the tool.
    Emulated {
        /// The tool.
        tool: String,
    },
    /// A recording, which takes that tracker's place.
    Recorded(Replay),
}

impl Tips {
    /// When the recording has something to say.
    fn deadline(&self) -> Time {
        match self {
            Tips::Emulated { .. } => Time::NEVER,
            Tips::Recorded(replay) => replay.deadline(),
        }
    }

    /// What the recording says by `now`.
    fn poll(&mut self, now: Time) -> Option<Event> {
        match self {
            Tips::Emulated { .. } => None,
            Tips::Recorded(replay) => replay.poll(now),
        }
    }

    /// The sample as which a tracked tip reaches the bench, in full precision and without a wire;
    /// none where a recording is in its place.
    fn sample_of(&self, tip: &TrackedTip, now: Time) -> Option<Sample> {
        let Tips::Emulated { tool } = self else { return None };
        Some(Sample {
            tool: tool.clone(),
            receive_time: now,
            source_unix_ns: Some(tip.acquisition_time.as_nanos()),
            position_mm: tip.x_tb.translation,
            orientation: Some(tip.x_tb.rotation),
            validity: Validity::Valid,
        })
    }
}

/// Runs `session` against `stage` until it ends. Frames and samples arrive the moment they are
/// sent, and time leaps to the next deadline of any.
pub fn run_virtual(
    mut session: Session,
    mut stage: VirtualStage,
    mut tips: Tips,
    mut sink: Sink<'_>,
    interrupt: &Interrupt,
) -> RunReport {
    let mut now = Time::ZERO;
    let mut stop_asked = false;
    loop {
        let mut take = |record, truth| sink.take(record, Some(truth));
        settle(&mut session, &mut stage, now, &tips, &mut take);
        sink.progress(session.progress());
        if let Some(outcome) = session.outcome() {
            let outcome = outcome.clone();
            return sink.finish(outcome, now, session.gate_counts(), Map::new());
        }
        if !stop_asked && let Some(reason) = stop_reason(interrupt, &sink) {
            stop_asked = true;
            session.handle(now, Input::Stop(reason));
            continue;
        }
        now = leap(&mut session, &mut stage, &mut tips, now);
    }
}

/// Runs `session` against `stage` until it ends, its records handed to `take` with the truth of
/// their moment: for studies, which nobody watches or interrupts.
pub(super) fn run_unwatched(
    mut session: Session,
    mut stage: VirtualStage,
    mut tips: Tips,
    take: &mut dyn FnMut(Record, Truth),
) -> Outcome {
    let mut now = Time::ZERO;
    loop {
        settle(&mut session, &mut stage, now, &tips, take);
        if let Some(outcome) = session.outcome() {
            return outcome.clone();
        }
        now = leap(&mut session, &mut stage, &mut tips, now);
    }
}

/// Goes on to the next deadline of any. Gives the time there.
fn leap(session: &mut Session, stage: &mut VirtualStage, tips: &mut Tips, now: Time) -> Time {
    let now = now.max(session.deadline().min(stage.deadline()).min(tips.deadline()));
    while let Some(event) = tips.poll(now) {
        session.handle(now, Input::Tracker(event));
    }
    if stage.deadline() <= now {
        stage.handle_timeout(now);
    }
    if session.deadline() <= now {
        session.handle(now, Input::Tick);
    }
    now
}

/// Why the runtime itself wants the run to end.
pub(super) fn stop_reason(interrupt: &Interrupt, sink: &Sink<'_>) -> Option<String> {
    if interrupt.is_raised() {
        return Some("operator: interrupted".to_owned());
    }
    sink.failure()
}

/// Carries everything that is under way at `now` until both sides are silent.
fn settle(
    session: &mut Session,
    stage: &mut VirtualStage,
    now: Time,
    tips: &Tips,
    take: &mut dyn FnMut(Record, Truth),
) {
    loop {
        let mut quiet = true;
        while let Some(output) = session.poll() {
            quiet = false;
            match output {
                Output::Transmit(frame) => stage.handle_frame(now, &frame),
                Output::Record(record) => take(record, stage.truth()),
            }
        }
        while let Some(output) = stage.poll() {
            quiet = false;
            let input = match output {
                StageOutput::Frame(frame) => Input::Frame(frame),
                StageOutput::Tip { tip, .. } => match tips.sample_of(&tip, now) {
                    Some(sample) => Input::Tracker(Event::Sample(sample)),
                    None => continue,
                },
            };
            session.handle(now, input);
        }
        if quiet {
            return;
        }
    }
}
