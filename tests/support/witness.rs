//! A witness on the bus, which belongs neither to the bench nor to the stage.

use super::programs::LONG;
use super::udp_stage::{COUNTS_PER_MM, Stage};
use needle_bench::canopen::Frame;
use needle_bench::transport::can::{BusEvent, CanBus};
use needle_bench::transport::udp::UdpBus;
use std::time::Instant;

const SYNC: u16 = 0x080;
const EMCY_INSERTION: u16 = 0x081;
const TPDO1_INSERTION: u16 = 0x181;
const RPDO1_INSERTION: u16 = 0x201;
const HEARTBEAT_BENCH: u16 = 0x77F;

/// What it has seen.
pub(crate) struct Witness {
    bus: Box<dyn CanBus>,
    pub(crate) syncs: usize,
    /// Emergency messages of the insertion drive.
    emergencies: usize,
    /// Position of the insertion drive in its last TPDO1.
    pub(crate) inserted_mm: f64,
    /// Target of the insertion drive in the bench's last RPDO1.
    pub(crate) commanded_mm: f64,
    /// Time of the bench's last heartbeat.
    pub(crate) heartbeat_at: Instant,
}

impl Witness {
    pub(crate) fn new(bus: impl CanBus + 'static) -> Self {
        Witness {
            bus: Box::new(bus),
            syncs: 0,
            emergencies: 0,
            inserted_mm: 0.0,
            commanded_mm: 0.0,
            heartbeat_at: Instant::now(),
        }
    }

    /// A witness on the UDP bus of this stage.
    pub(crate) fn of(stage: &Stage) -> Self {
        Self::new(UdpBus::join(stage.group).unwrap())
    }

    /// The next frame.
    pub(crate) fn next(&mut self) -> Frame {
        let frame = loop {
            match self.bus.receive(LONG).unwrap() {
                Some(BusEvent::Frame(frame)) => break frame,
                Some(BusEvent::Error(_)) => {}
                None => panic!("no frame on the bus for {LONG:?}"),
            }
        };
        // Statusword and position, or controlword and target.
        let counts = match frame.data() {
            &[_, _, a, b, c, d] => i32::from_le_bytes([a, b, c, d]),
            _ => 0,
        };
        match frame.cob_id() {
            Some(SYNC) => self.syncs += 1,
            Some(EMCY_INSERTION) => self.emergencies += 1,
            Some(TPDO1_INSERTION) => self.inserted_mm = f64::from(counts) / COUNTS_PER_MM,
            Some(RPDO1_INSERTION) => self.commanded_mm = f64::from(counts) / COUNTS_PER_MM,
            Some(HEARTBEAT_BENCH) => self.heartbeat_at = Instant::now(),
            _ => {}
        }
        frame
    }

    /// Reads frames until `is_reached`.
    #[track_caller]
    pub(crate) fn wait_until(&mut self, is_reached: impl Fn(&Self) -> bool) {
        // The drives send on after the bench has stopped.
        let end = Instant::now() + 2 * LONG;
        while !is_reached(self) {
            assert!(Instant::now() < end, "not reached, at {:.1} mm", self.inserted_mm);
            self.next();
        }
    }

    #[track_caller]
    pub(crate) fn wait_until_inserted(&mut self, depth_mm: f64) {
        self.wait_until(|seen| seen.inserted_mm >= depth_mm);
    }

    /// Reads frames until the insertion drive sends one more emergency message.
    #[track_caller]
    pub(crate) fn wait_for_emergency(&mut self) {
        let earlier = self.emergencies;
        self.wait_until(|seen| seen.emergencies > earlier);
    }
}
