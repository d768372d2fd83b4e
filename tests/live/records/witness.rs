//! One who hears the bus and is no part of the bench or the stage.

use crate::support::programs::LONG;
use crate::support::udp_stage::{COUNTS_PER_MM, Stage};
use needle_bench::transport::can::{BusEvent, CanBus};
use needle_bench::transport::udp::UdpBus;
use std::time::Instant;

const SYNC: u16 = 0x080;
const TPDO1_INSERTION: u16 = 0x181;
pub(crate) const EMCY_INSERTION: u16 = 0x081;

/// What it has heard.
pub(crate) struct Witness {
    bus: UdpBus,
    pub(crate) syncs: usize,
    inserted_mm: f64,
    /// The drives go on to be heard when a bench has stopped that was to insert.
    end: Instant,
}

impl Witness {
    pub(crate) fn of(stage: &Stage) -> Self {
        let bus = UdpBus::join(stage.group).unwrap();
        Witness { bus, syncs: 0, inserted_mm: 0.0, end: Instant::now() + 2 * LONG }
    }

    /// The next frame's COB-ID.
    pub(crate) fn hear(&mut self) -> Option<u16> {
        assert!(Instant::now() < self.end, "{:.1} mm in, and no more", self.inserted_mm);
        let event = self.bus.receive(LONG).unwrap();
        let Some(BusEvent::Frame(frame)) = event else { panic!("silent, or {event:?}") };
        match (frame.cob_id(), frame.data()) {
            (Some(SYNC), _) => self.syncs += 1,
            (Some(TPDO1_INSERTION), &[_, _, a, b, c, d]) => {
                self.inserted_mm = f64::from(i32::from_le_bytes([a, b, c, d])) / COUNTS_PER_MM;
            }
            _ => {}
        }
        frame.cob_id()
    }

    pub(crate) fn wait_until_inserted(&mut self, depth_mm: f64) {
        while self.inserted_mm < depth_mm {
            self.hear();
        }
    }
}
