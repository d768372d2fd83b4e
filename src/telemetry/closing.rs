//! The end of a run: its writers complete their files, and those that do not are left behind.

use super::TelemetryError;
use super::silence::{LOOK_MAX, Silence};
use super::worker::{Closing, Ended, Left, RETRY, Worker};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

/// One who waits for a writer to complete its files says so after this long.
const TOLD_AFTER: Duration = Duration::from_secs(3);

/// How long one waits for a writer that completes its files.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patience {
    /// Without a sign of life.
    pub(super) silence: Duration,
    /// In all.
    pub(super) total: Duration,
}

/// A writer that is to complete its files.
struct Closer<'a> {
    worker: &'a Worker,
    patience: Patience,
    /// It knows that the run is over.
    knows: bool,
    silence: Silence,
    /// The operator was told that it is waited for.
    told: bool,
    is_given_up: bool,
    ended: Option<Ended>,
}

/// Tells the writers that the run is over and waits until they are done, each as long as its patience
/// lasts: a wedged one is left alone.
pub(super) fn close_all<const N: usize>(
    writers: [(&Worker, Patience); N],
    closing: &Arc<Closing>,
) -> [Ended; N] {
    let (mut looked, mut waited) = (Instant::now(), Duration::ZERO);
    let mut closers = writers.map(|(worker, patience)| Closer {
        worker,
        patience,
        knows: false,
        silence: Silence::new(worker.intake.vitals.beats(), looked),
        told: false,
        is_given_up: false,
        ended: None,
    });
    while closers.iter().any(Closer::is_waited_for) {
        let now = Instant::now();
        // Where all of them stood still, with who waits, nothing is proved of any.
        let since = now.duration_since(std::mem::replace(&mut looked, now)).min(LOOK_MAX);
        waited += since;
        closers.iter_mut().for_each(|closer| closer.look(closing, now, waited));
        thread::sleep(RETRY);
    }
    closers.map(Closer::end)
}

impl Closer<'_> {
    fn is_waited_for(&self) -> bool {
        self.ended.is_none() && !self.is_given_up
    }

    fn look(&mut self, closing: &Arc<Closing>, now: Instant, waited: Duration) {
        if !self.is_waited_for() {
            return;
        }
        self.knows = self.knows || self.worker.tell(closing);
        self.ended = self.worker.ended();
        self.silence.look(self.worker.intake.vitals.beats(), now);
        let (silent, Patience { silence, total }) = (self.silence.lasted(), self.patience);
        if silent > TOLD_AFTER && !std::mem::replace(&mut self.told, true) {
            let (writer, limit_s) = (self.worker.writer, silence.as_secs_f64());
            tracing::warn!(
                "{writer}: waiting for it to complete its files, {limit_s:.0} s at most"
            );
        }
        self.is_given_up = silent > silence || waited > total;
    }

    fn end(self) -> Ended {
        let Closer { worker: Worker { writer, .. }, patience, .. } = self;
        let silent = self.silence.lasted();
        let (silent_s, limit_s) = (silent.as_secs_f64(), patience.silence.as_secs_f64());
        self.ended.unwrap_or_else(|| {
            let fault = if silent > patience.silence {
                TelemetryError::WriterSilent { writer, silent_s, limit_s }
            } else {
                let total_s = patience.total.as_secs_f64();
                let reason = format!("its files were not complete after {total_s:.0} s");
                TelemetryError::WriterFailed { writer, reason }
            };
            Ended { left: Left::default(), fault: Some(fault) }
        })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::worker::Backpressure;
    use super::super::worker::tests::{entry, gated};
    use super::*;
    use crate::archive::Manifest;

    fn closing() -> Arc<Closing> {
        Arc::new(Closing { manifest: Manifest::new("x", String::new()) })
    }

    const HOUR: Duration = Duration::from_secs(3600);
    pub(in crate::telemetry) const FOR_EVER: Patience = Patience { silence: HOUR, total: HOUR };
    const NO_PATIENCE: Patience = Patience { silence: Duration::ZERO, total: Duration::ZERO };

    pub(in crate::telemetry) fn closed(worker: &Worker, patience: Patience) -> Ended {
        let [ended] = close_all([(worker, patience)], &closing());
        ended
    }

    #[test]
    fn a_wedged_writer_does_not_hold_up_the_end() {
        let (worker, begun, _let_go) = gated(u64::MAX, Backpressure::DropAndCount);
        worker.intake.give(entry());
        begun.recv().unwrap();
        (0..4).for_each(|_| worker.intake.give(entry()));
        let fault = closed(&worker, NO_PATIENCE).fault;
        assert!(matches!(fault, Some(TelemetryError::WriterSilent { writer: "gated", .. })));
        let fault = closed(&worker, Patience { total: Duration::ZERO, ..FOR_EVER }).fault;
        assert!(fault.unwrap().to_string().contains("not complete after 0 s"));
    }

    /// A slow machine is no wedged one: its patience counts from the last sign of life.
    #[test]
    fn a_writer_that_shows_itself_is_waited_for() {
        let (worker, begun, let_go) = gated(u64::MAX, Backpressure::DropAndCount);
        worker.intake.give(entry());
        begun.recv().unwrap();
        let vitals = Arc::clone(&worker.intake.vitals);
        let silence = Duration::from_secs(1);
        let shows_itself = thread::spawn(move || {
            let end = Instant::now() + 2 * silence;
            while Instant::now() < end {
                vitals.beat();
                thread::sleep(RETRY);
            }
            drop(let_go);
        });
        let ended = closed(&worker, Patience { silence, total: HOUR });
        shows_itself.join().unwrap();
        assert!(ended.fault.is_none(), "{:?}", ended.fault);
        assert_eq!(ended.left.counts.steps, 1);
    }
}
