//! A session and the virtual stage in one thread, in virtual time: no sleeps, no sockets.

use super::interrupt::Interrupt;
use super::sink::{RunReport, Sink};
use crate::emulator::{StageOutput, TrackedTip, VirtualStage};
use crate::session::{Input, Output, Session};
use crate::tracker::{Event, Sample, Validity};
use crate::units::Time;

/// Runs `session` against `stage` until it ends. Frames and samples arrive the moment they are
/// sent, and time leaps to the next deadline of either. `tool` is the name of the tracked tip.
pub fn run_virtual(
    mut session: Session,
    mut stage: VirtualStage,
    tool: &str,
    mut sink: Sink<'_>,
    interrupt: &Interrupt,
) -> RunReport {
    let mut now = Time::ZERO;
    let mut stop_asked = false;
    loop {
        settle(&mut session, &mut stage, now, tool, &mut sink);
        sink.progress(session.progress());
        if let Some(outcome) = session.outcome() {
            let outcome = outcome.clone();
            return sink.finish(outcome, now, None);
        }
        if !stop_asked && let Some(reason) = stop_reason(interrupt, &sink) {
            stop_asked = true;
            session.handle(now, Input::Stop(reason));
            continue;
        }
        now = now.max(session.deadline().min(stage.deadline()));
        if stage.deadline() <= now {
            stage.handle_timeout(now);
        }
        if session.deadline() <= now {
            session.handle(now, Input::Tick);
        }
    }
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
    tool: &str,
    sink: &mut Sink<'_>,
) {
    loop {
        let mut quiet = true;
        while let Some(output) = session.poll() {
            quiet = false;
            match output {
                Output::Transmit(frame) => stage.handle_frame(now, &frame),
                Output::Record(record) => sink.take(record, Some(stage.truth())),
            }
        }
        while let Some(output) = stage.poll() {
            quiet = false;
            let input = match output {
                StageOutput::Frame(frame) => Input::Frame(frame),
                StageOutput::Tip { tip, .. } => {
                    Input::Tracker(Event::Sample(sample_of(&tip, tool, now)))
                }
            };
            session.handle(now, input);
        }
        if quiet {
            return;
        }
    }
}

/// The sample as which a tracked tip reaches the bench, in full precision and without a wire.
fn sample_of(tip: &TrackedTip, tool: &str, now: Time) -> Sample {
    Sample {
        tool: tool.to_owned(),
        receive_time: now,
        source_unix_ns: Some(tip.acquisition_time.as_nanos()),
        position_mm: tip.x_tb.translation,
        orientation: Some(tip.x_tb.rotation),
        validity: Validity::Valid,
    }
}
