//! Heartbeat producer and consumer (CiA 301, 7.2.8.3.2): how each side notices that the other
//! is gone.

use std::time::Duration;

use super::nmt::{NmtState, heartbeat_frame, parse_heartbeat};
use super::{Frame, NodeId};
use crate::units::Time;

/// An event that a [`HeartbeatConsumer`] reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeartbeatEvent {
    /// The node restarted. In the middle of a run this is a fault.
    BootUp,
    /// The node's first heartbeat, or one with another state than before.
    State(NmtState),
    /// No heartbeat came in time.
    Lost,
}

/// Watches the heartbeat of one node.
///
/// Monitoring starts with the first heartbeat received, as CiA 301 says, so a node that never sends
/// one is not reported lost, unless a heartbeat is [expected](Self::expect_by). After a loss or a
/// boot-up, monitoring starts again with the next heartbeat.
#[derive(Debug, Clone)]
pub struct HeartbeatConsumer {
    node: NodeId,
    timeout: Duration,
    state: Option<NmtState>,
    deadline: Time,
}

impl HeartbeatConsumer {
    /// Watches `node`, whose heartbeats may be at most `timeout` apart.
    pub fn new(node: NodeId, timeout: Duration) -> Self {
        HeartbeatConsumer { node, timeout, state: None, deadline: Time::NEVER }
    }

    /// The node that is watched.
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// The state in the last heartbeat; `None` before the first one, and after a loss or a boot-up.
    pub fn state(&self) -> Option<NmtState> {
        self.state
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due: a loss is reported unless a heartbeat
    /// comes before.
    pub fn deadline(&self) -> Time {
        self.deadline
    }

    /// Forgets the state. A loss is reported unless a heartbeat comes before `deadline`.
    pub fn expect_by(&mut self, deadline: Time) {
        self.state = None;
        self.deadline = deadline;
    }

    /// Takes any frame; frames of other nodes and of other kinds change nothing.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) -> Option<HeartbeatEvent> {
        let (_, state) = parse_heartbeat(frame).filter(|(node, _)| *node == self.node)?;
        if state == NmtState::BootUp {
            self.expect_by(Time::NEVER);
            return Some(HeartbeatEvent::BootUp);
        }
        self.deadline = now + self.timeout;
        let before = self.state.replace(state);
        (before != Some(state)).then_some(HeartbeatEvent::State(state))
    }

    /// Reports the loss when the deadline has passed.
    pub fn handle_timeout(&mut self, now: Time) -> Option<HeartbeatEvent> {
        if now < self.deadline {
            return None;
        }
        self.expect_by(Time::NEVER);
        Some(HeartbeatEvent::Lost)
    }
}

/// Sends the heartbeat of one node.
#[derive(Debug, Clone)]
pub struct HeartbeatProducer {
    node: NodeId,
    period: Duration,
    deadline: Time,
    last_sent: Option<Time>,
}

impl HeartbeatProducer {
    /// Heartbeats of `node` every `period`, the first at `first`; none if `period` is zero.
    pub fn new(node: NodeId, period: Duration, first: Time) -> Self {
        let deadline = if period.is_zero() { Time::NEVER } else { first };
        HeartbeatProducer { node, period, deadline, last_sent: None }
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub fn deadline(&self) -> Time {
        self.deadline
    }

    /// The heartbeat to send now, if one is due. Missed heartbeats are skipped.
    pub fn handle_timeout(&mut self, now: Time, state: NmtState) -> Option<Frame> {
        // A period of zero is off, even at `Time::NEVER`.
        if self.period.is_zero() || now < self.deadline {
            return None;
        }
        self.deadline = self.deadline + self.period;
        if self.deadline <= now {
            self.deadline = now + self.period;
        }
        self.last_sent = Some(now);
        Some(heartbeat_frame(self.node, state))
    }

    /// Sends no heartbeat any more. Returns when the last one was sent; `None` if there was none.
    pub fn stop(&mut self) -> Option<Time> {
        (self.period, self.deadline) = (Duration::ZERO, Time::NEVER);
        self.last_sent
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::at_ms;

    const NODE: NodeId = NodeId::new(5).unwrap();
    const TIMEOUT: Duration = Duration::from_millis(100);

    fn heartbeat(state: NmtState) -> Frame {
        heartbeat_frame(NODE, state)
    }

    #[test]
    fn monitoring_starts_with_the_first_heartbeat() {
        let mut consumer = HeartbeatConsumer::new(NODE, TIMEOUT);
        assert_eq!(consumer.deadline(), Time::NEVER);
        assert_eq!(consumer.handle_timeout(at_ms(10_000)), None);

        let event = consumer.handle_frame(at_ms(10_000), &heartbeat(NmtState::Operational));
        assert_eq!(event, Some(HeartbeatEvent::State(NmtState::Operational)));
        assert_eq!(consumer.handle_frame(at_ms(10_050), &heartbeat(NmtState::Operational)), None);
        assert_eq!(consumer.handle_timeout(at_ms(10_149)), None);
        assert_eq!(consumer.handle_timeout(at_ms(10_150)), Some(HeartbeatEvent::Lost));
        assert_eq!(consumer.state(), None);
        assert_eq!(consumer.handle_timeout(at_ms(20_000)), None, "a loss is reported once");
    }

    #[test]
    fn a_node_that_sends_no_heartbeat_by_the_expected_time_is_lost() {
        let mut consumer = HeartbeatConsumer::new(NODE, TIMEOUT);
        consumer.expect_by(at_ms(500));
        assert_eq!(consumer.handle_timeout(at_ms(499)), None);
        assert_eq!(consumer.handle_timeout(at_ms(500)), Some(HeartbeatEvent::Lost));
    }

    #[test]
    fn a_boot_up_ends_monitoring_until_the_next_heartbeat() {
        let mut consumer = HeartbeatConsumer::new(NODE, TIMEOUT);
        consumer.handle_frame(at_ms(0), &heartbeat(NmtState::Operational));
        let event = consumer.handle_frame(at_ms(10), &heartbeat(NmtState::BootUp));
        assert_eq!(event, Some(HeartbeatEvent::BootUp));
        assert_eq!(consumer.deadline(), Time::NEVER);
        let event = consumer.handle_frame(at_ms(20), &heartbeat(NmtState::PreOperational));
        assert_eq!(event, Some(HeartbeatEvent::State(NmtState::PreOperational)));
    }

    #[test]
    fn a_heartbeat_of_another_node_does_not_prolong_the_timeout() {
        let mut consumer = HeartbeatConsumer::new(NODE, TIMEOUT);
        consumer.handle_frame(at_ms(0), &heartbeat(NmtState::Operational));
        consumer.handle_frame(at_ms(90), &Frame::new(0x706, &[5]));
        assert_eq!(consumer.deadline(), at_ms(100));
    }

    #[test]
    fn the_producer_keeps_its_period_and_skips_missed_heartbeats() {
        let mut producer = HeartbeatProducer::new(NODE, TIMEOUT, at_ms(0));
        assert_eq!(
            producer.handle_timeout(at_ms(3), NmtState::Operational),
            Some(heartbeat(NmtState::Operational))
        );
        assert_eq!(producer.deadline(), at_ms(100), "not 103 ms");
        assert!(producer.handle_timeout(at_ms(99), NmtState::Operational).is_none());
        assert!(producer.handle_timeout(at_ms(350), NmtState::Operational).is_some());
        assert!(producer.handle_timeout(at_ms(350), NmtState::Operational).is_none());
        assert_eq!(HeartbeatProducer::new(NODE, Duration::ZERO, at_ms(0)).deadline(), Time::NEVER);
    }
}
