//! Dialogues with drives over SDO alone.
//!
//! Each is a script: an async function that reads and writes one object after the other and awaits each
//! reply. No async runtime runs it. A [`ScriptRunner`] resumes it whenever it is given a frame or the time, so
//! a script is sans-IO like everything here.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::fmt;
use std::future::poll_fn;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use super::{Axis, Output, PerAxis, StageConfig, StageEvent};
use crate::canopen::cia402::{Statusword, object};
use crate::canopen::nmt::{NmtCommand, NmtState, nmt_frame, parse_heartbeat};
use crate::canopen::sdo::{SdoClient, SdoError, SdoReply, SdoRequest, SdoValue};
use crate::canopen::{Frame, NodeId, ObjectAddress};
use crate::units::Time;

/// This many extra answers, if they are also a quarter of the answered requests, show that two drives have the same
/// node number. A bus may repeat a frame after a lost acknowledgement, but rarely.
const EXTRA_ANSWERS_MIN: u32 = 3;

/// A sans-IO machine that talks with the drives until it [is over](Self::is_over). Hand in frames and the
/// time, and drain [`poll_transmit`](Self::poll_transmit) after each.
pub trait Dialogue {
    /// Takes any frame of the bus.
    fn handle_frame(&mut self, now: Time, frame: &Frame);

    /// Does what is due at `now`.
    fn handle_timeout(&mut self, now: Time);

    /// The next frame to send.
    fn poll_transmit(&mut self) -> Option<Frame>;

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    fn deadline(&self) -> Time;

    /// True once the dialogue has ended.
    fn is_over(&self) -> bool;
}

/// A script's access to its drive.
#[derive(Debug, Clone)]
pub(super) struct Sdo(Rc<RefCell<Line>>);

#[derive(Debug)]
struct Line {
    client: SdoClient,
    attempts_max: u8,
    /// The node's NMT state, if a heartbeat was received.
    nmt_state: Option<NmtState>,
    now: Time,
    /// When the script's pause ends.
    wake: Time,
    /// Frames and events of the script other than SDO requests.
    outputs: VecDeque<Output>,
}

impl Sdo {
    pub(super) fn new(config: &StageConfig, axis: Axis) -> Self {
        Sdo(Rc::new(RefCell::new(Line {
            client: SdoClient::new(config.axis(axis).node, config.bus.sdo_timeout()),
            attempts_max: config.bus.sdo_attempts,
            nmt_state: None,
            now: Time::ZERO,
            wake: Time::NEVER,
            outputs: VecDeque::new(),
        })))
    }

    pub(super) fn node(&self) -> NodeId {
        self.0.borrow().client.node()
    }

    pub(super) fn now(&self) -> Time {
        self.0.borrow().now
    }

    /// The drive's NMT state, if a heartbeat was received.
    pub(super) fn nmt_state(&self) -> Option<NmtState> {
        self.0.borrow().nmt_state
    }

    /// How many more answers than requests there were, if they show that two drives have this node number; else 0.
    pub(super) fn extra_answers(&self) -> u32 {
        let line = self.0.borrow();
        let (extra, answers) = (line.client.extra_answers(), line.client.answers());
        if extra >= EXTRA_ANSWERS_MIN && 4 * extra >= answers { extra } else { 0 }
    }

    pub(super) fn send(&self, frame: Frame) {
        self.0.borrow_mut().outputs.push_back(Output::Transmit(frame));
    }

    pub(super) fn emit(&self, event: StageEvent) {
        self.0.borrow_mut().outputs.push_back(Output::Event(event));
    }

    /// Sends the node to Pre-operational, where it takes no PDOs.
    pub(super) fn leave_operational(&self) {
        self.send(nmt_frame(NmtCommand::EnterPreOperational, Some(self.node())));
    }

    pub(super) async fn pause(&self, pause: Duration) {
        let until = self.now() + pause;
        self.0.borrow_mut().wake = until;
        poll_fn(|_| if self.now() >= until { Poll::Ready(()) } else { Poll::Pending }).await;
        self.0.borrow_mut().wake = Time::NEVER;
    }

    /// Reads or writes an object.
    pub(super) async fn ask_once(&self, request: SdoRequest) -> Result<SdoReply, SdoError> {
        let now = self.now();
        self.0.borrow_mut().client.start(now, request);
        poll_fn(|_| match self.0.borrow_mut().client.poll_result() {
            Some(result) => Poll::Ready(result),
            None => Poll::Pending,
        })
        .await
    }

    /// As [`Sdo::ask_once`], but repeats a request that the drive neither answers nor refuses, up to the
    /// configured number of attempts.
    pub(super) async fn ask(&self, request: SdoRequest) -> Result<SdoReply, SdoError> {
        let attempts_max = self.0.borrow().attempts_max;
        for _ in 1..attempts_max {
            let result = self.ask_once(request).await;
            if matches!(result, Ok(_) | Err(SdoError::Aborted(_))) {
                return result;
            }
        }
        self.ask_once(request).await
    }

    /// Reads `object`.
    ///
    /// # Errors
    /// There is no usable answer: the reason, with the node and the object.
    pub(super) async fn read(&self, object: ObjectAddress) -> Result<SdoValue, String> {
        match self.ask(SdoRequest::Upload(object)).await {
            Ok(SdoReply::Uploaded(value)) => Ok(value),
            Ok(SdoReply::Downloaded) => Err(format!("node {} {object}: no value", self.node())),
            Err(error) => Err(self.explain(object, error)),
        }
    }

    /// Reads `object`; `None` if the drive answers, but not with its value.
    ///
    /// # Errors
    /// The drive does not answer.
    pub(super) async fn read_optional(
        &self,
        object: ObjectAddress,
    ) -> Result<Option<SdoValue>, String> {
        match self.ask(SdoRequest::Upload(object)).await {
            Ok(SdoReply::Uploaded(value)) => Ok(Some(value)),
            Err(error @ SdoError::Timeout(_)) => Err(self.explain(object, error)),
            Ok(SdoReply::Downloaded) | Err(_) => Ok(None),
        }
    }

    /// Reads the statusword.
    ///
    /// # Errors
    /// As [`Sdo::read`].
    pub(super) async fn statusword(&self) -> Result<Statusword, String> {
        Ok(Statusword(self.read_at_least(object::STATUSWORD, 2).await? as u16))
    }

    /// Reads `object`, of at least `len` bytes.
    ///
    /// # Errors
    /// As [`Sdo::read`].
    pub(super) async fn read_at_least(
        &self,
        object: ObjectAddress,
        len: u8,
    ) -> Result<u32, String> {
        let value = self.read(object).await?;
        value.at_least(len).ok_or_else(|| {
            format!("node {} {object} has {} bytes", self.node(), value.as_bytes().len())
        })
    }

    /// Writes `value` to `object`.
    ///
    /// # Errors
    /// As [`Sdo::read`].
    pub(super) async fn write(&self, object: ObjectAddress, value: SdoValue) -> Result<(), String> {
        let written = self.ask(SdoRequest::Download(object, value)).await;
        written.map(drop).map_err(|error| self.explain(object, error))
    }

    fn explain(&self, object: ObjectAddress, error: SdoError) -> String {
        let (node, attempts) = (self.node(), self.0.borrow().attempts_max);
        match error {
            SdoError::Timeout(_) => format!(
                "node {node} {object}: {error} (attempt {attempts} of {attempts}), is the drive \
                 powered, node-id and bitrate right?"
            ),
            _ => format!("node {node} {object}: {error}"),
        }
    }
}

/// Runs a script that talks with a drive, and keeps its outcome.
pub(super) struct ScriptRunner<T> {
    /// The script's access to its drive.
    pub(super) sdo: Sdo,
    script: Pin<Box<dyn Future<Output = T>>>,
    outcome: Option<T>,
}

impl<T> ScriptRunner<T> {
    /// Begins `script` at `now`. A transfer of another script over `sdo` is cancelled.
    pub(super) fn begin(sdo: &Sdo, now: Time, script: impl Future<Output = T> + 'static) -> Self {
        let (sdo, script) = (sdo.clone(), Box::pin(script));
        let mut runner = ScriptRunner { sdo, script, outcome: None };
        runner.cancel();
        runner.resume(now);
        runner
    }

    pub(super) fn handle_frame(&mut self, now: Time, frame: &Frame) {
        if let Some((node, state)) = parse_heartbeat(frame)
            && node == self.sdo.node()
        {
            self.sdo.0.borrow_mut().nmt_state = Some(state);
        }
        self.sdo.0.borrow_mut().client.handle_frame(now, frame);
        self.resume(now);
    }

    pub(super) fn handle_timeout(&mut self, now: Time) {
        self.sdo.0.borrow_mut().client.handle_timeout(now);
        self.resume(now);
    }

    fn resume(&mut self, now: Time) {
        self.sdo.0.borrow_mut().now = now;
        let mut context = Context::from_waker(Waker::noop());
        if self.outcome.is_none()
            && let Poll::Ready(outcome) = self.script.as_mut().poll(&mut context)
        {
            self.outcome = Some(outcome);
        }
    }

    /// The next frame or event.
    pub(super) fn poll(&mut self) -> Option<Output> {
        let mut line = self.sdo.0.borrow_mut();
        let frame = line.client.poll_transmit().map(Output::Transmit);
        frame.or_else(|| line.outputs.pop_front())
    }

    pub(super) fn deadline(&self) -> Time {
        let line = self.sdo.0.borrow();
        line.client.deadline().min(line.wake)
    }

    /// Cancels the transfer that is under way, and the script's pause.
    pub(super) fn cancel(&mut self) {
        let mut line = self.sdo.0.borrow_mut();
        line.client.cancel();
        line.wake = Time::NEVER;
    }

    /// Ends the script early.
    pub(super) fn end(&mut self, outcome: T) {
        self.cancel();
        self.outcome = Some(outcome);
    }

    /// How the script ended; `None` while it goes on.
    pub(super) fn outcome(&self) -> Option<&T> {
        self.outcome.as_ref()
    }
}

impl<T> fmt::Debug for ScriptRunner<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ScriptRunner").field("sdo", &self.sdo).finish_non_exhaustive()
    }
}

/// Runs the same script with both drives at the same time.
#[derive(Debug)]
pub struct WithBothDrives<T> {
    /// Frames to send before those of the scripts.
    first: VecDeque<Frame>,
    pub(super) axes: PerAxis<ScriptRunner<Result<T, String>>>,
}

impl<T> WithBothDrives<T> {
    pub(super) fn begin(
        first: impl Into<VecDeque<Frame>>,
        axis: impl FnMut(Axis) -> ScriptRunner<Result<T, String>>,
    ) -> Self {
        WithBothDrives { first: first.into(), axes: PerAxis::from_fn(axis) }
    }
}

impl<T: Clone> WithBothDrives<T> {
    /// The outcome of the script with the drive of `axis`; `None` while it goes on.
    ///
    /// # Errors
    /// Why the script failed, with the axis.
    pub fn outcome(&self, axis: Axis) -> Option<Result<T, String>> {
        let outcome = self.axes[axis].outcome()?.clone();
        Some(outcome.map_err(|error| format!("{axis}: {error}")))
    }
}

impl<T> Dialogue for WithBothDrives<T> {
    fn handle_frame(&mut self, now: Time, frame: &Frame) {
        Axis::BOTH.into_iter().for_each(|axis| self.axes[axis].handle_frame(now, frame));
    }

    fn handle_timeout(&mut self, now: Time) {
        Axis::BOTH.into_iter().for_each(|axis| self.axes[axis].handle_timeout(now));
    }

    fn poll_transmit(&mut self) -> Option<Frame> {
        let first = self.first.pop_front();
        first.or_else(|| {
            let mut outputs = std::iter::from_fn(|| {
                self.axes.insertion.poll().or_else(|| self.axes.rotation.poll())
            });
            outputs.find_map(|output| match output {
                Output::Transmit(frame) => Some(frame),
                Output::Event(_) => None,
            })
        })
    }

    fn deadline(&self) -> Time {
        self.axes.insertion.deadline().min(self.axes.rotation.deadline())
    }

    fn is_over(&self) -> bool {
        self.axes.all(|axis| axis.outcome().is_some())
    }
}
