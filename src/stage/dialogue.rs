//! Talk with both drives over SDO alone: no bring-up, no SYNC, no power.

use std::collections::VecDeque;
use std::time::Duration;

use super::{Axis, StageConfig};
use crate::canopen::sdo::{SdoClient, SdoErrorKind, SdoReply, SdoRequest};
use crate::canopen::{Frame, NodeId};
use crate::units::Time;

/// A machine that talks with the drives and comes to an end, sans-IO: hand in frames and the time,
/// drain [`poll_transmit`](Self::poll_transmit) after each, until [`is_over`](Self::is_over).
pub trait Dialogue {
    /// Takes any frame of the bus.
    fn handle_frame(&mut self, now: Time, frame: &Frame);

    /// Does what is due at `now`.
    fn handle_timeout(&mut self, now: Time);

    /// The next frame to send.
    fn poll_transmit(&mut self) -> Option<Frame>;

    /// When [`handle_timeout`](Self::handle_timeout) wants to be called.
    fn deadline(&self) -> Time;

    /// True when there is nothing left to say.
    fn is_over(&self) -> bool;
}

/// Asks one node, and again where it does not answer.
#[derive(Debug, Clone)]
pub(super) struct Asker {
    client: SdoClient,
    timeout: Duration,
    attempts_max: u32,
    attempts: u32,
    request: Option<SdoRequest>,
    results: VecDeque<Result<SdoReply, String>>,
}

impl Asker {
    pub(super) fn new(config: &StageConfig, axis: Axis) -> Self {
        Asker {
            client: SdoClient::new(config.axis(axis).node, config.sdo_timeout),
            timeout: config.sdo_timeout,
            attempts_max: config.sdo_attempts,
            attempts: 0,
            request: None,
            results: VecDeque::new(),
        }
    }

    pub(super) fn node(&self) -> NodeId {
        self.client.node()
    }

    pub(super) fn ask(&mut self, now: Time, request: SdoRequest) {
        self.attempts = 1;
        self.request = Some(request.clone());
        self.start(now, request);
    }

    pub(super) fn handle_frame(&mut self, now: Time, frame: &Frame) {
        self.client.handle_frame(now, frame);
        self.take_result(now);
    }

    pub(super) fn handle_timeout(&mut self, now: Time) {
        self.client.handle_timeout(now);
        self.take_result(now);
    }

    pub(super) fn poll_transmit(&mut self) -> Option<Frame> {
        self.client.poll_transmit()
    }

    pub(super) fn deadline(&self) -> Time {
        self.client.deadline()
    }

    /// The answer to the last request, once; an error says what the node did not do.
    pub(super) fn poll_result(&mut self) -> Option<Result<SdoReply, String>> {
        self.results.pop_front()
    }

    fn start(&mut self, now: Time, request: SdoRequest) {
        if let Err(error) = self.client.start(now, request) {
            self.results.push_back(Err(error.to_string()));
        }
    }

    fn take_result(&mut self, now: Time) {
        let Some(result) = self.client.poll_result() else { return };
        match (result, self.request.clone()) {
            (Err(error), Some(request))
                if matches!(error.kind, SdoErrorKind::Timeout(_))
                    && self.attempts < self.attempts_max =>
            {
                self.attempts += 1;
                self.start(now, request);
            }
            (Err(error), _) if matches!(error.kind, SdoErrorKind::Timeout(_)) => {
                let (node, object, attempts) = (error.node, error.object, self.attempts);
                let ms = self.timeout.as_millis();
                self.results.push_back(Err(format!(
                    "node {node} {object}: no SDO reply within {ms} ms (attempt {attempts} of \
                     {attempts}), is the drive powered, node-id and bitrate right?"
                )));
            }
            (result, _) => self.results.push_back(result.map_err(|error| error.to_string())),
        }
    }
}
