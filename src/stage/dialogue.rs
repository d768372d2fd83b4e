//! Talk with both drives over SDO alone: no bring-up, no SYNC, no power.

use super::{Axis, StageConfig};
use crate::canopen::sdo::{SdoClient, SdoError, SdoReply, SdoRequest};
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

/// Reads and writes objects of one node, and tries again where it does not answer.
#[derive(Debug, Clone)]
pub(super) struct SdoRetrier {
    client: SdoClient,
    attempts_max: u32,
    attempts: u32,
    request: SdoRequest,
}

impl SdoRetrier {
    /// Makes the first `request` at `now`.
    pub(super) fn new(config: &StageConfig, axis: Axis, now: Time, request: SdoRequest) -> Self {
        let client = SdoClient::new(config.axis(axis).node, config.sdo_timeout);
        let attempts_max = config.sdo_attempts;
        let mut retrier = SdoRetrier { client, attempts_max, attempts: 0, request };
        retrier.ask(now, request);
        retrier
    }

    pub(super) fn node(&self) -> NodeId {
        self.client.node()
    }

    pub(super) fn ask(&mut self, now: Time, request: SdoRequest) {
        self.attempts = 1;
        self.request = request;
        self.client.start(now, request);
    }

    /// Takes any frame of the bus; gives the answer to the last request, once. An error says what the
    /// node did not do.
    pub(super) fn handle_frame(
        &mut self,
        now: Time,
        frame: &Frame,
    ) -> Option<Result<SdoReply, String>> {
        self.client.handle_frame(now, frame);
        self.poll_result(now)
    }

    /// The same for what is due at `now`.
    pub(super) fn handle_timeout(&mut self, now: Time) -> Option<Result<SdoReply, String>> {
        self.client.handle_timeout(now);
        self.poll_result(now)
    }

    pub(super) fn poll_transmit(&mut self) -> Option<Frame> {
        self.client.poll_transmit()
    }

    pub(super) fn deadline(&self) -> Time {
        self.client.deadline()
    }

    fn poll_result(&mut self, now: Time) -> Option<Result<SdoReply, String>> {
        let (node, object, attempts) = (self.node(), self.request.object(), self.attempts);
        match self.client.poll_result()? {
            Ok(reply) => Some(Ok(reply)),
            Err(SdoError::Timeout(_)) if attempts < self.attempts_max => {
                self.attempts += 1;
                self.client.start(now, self.request);
                None
            }
            Err(error @ SdoError::Timeout(_)) => Some(Err(format!(
                "node {node} {object}: {error} (attempt {attempts} of {attempts}), is the drive \
                 powered, node-id and bitrate right?"
            ))),
            Err(error) => Some(Err(format!("node {node} {object}: {error}"))),
        }
    }
}
