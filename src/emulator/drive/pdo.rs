//! The four receive and four transmit PDOs of a node at work.

use std::time::Duration;

use super::parameters::mapping_of;
use crate::canopen::object_dictionary::ObjectDictionary;
use crate::canopen::pdo::{PdoCobId, PdoDirection, PdoMapping};
use crate::canopen::{Frame, ObjectAddress};
use crate::units::Time;

// Transmission types (CiA 301, tables 72 and 74); 1 to 240 are the number of SYNCs between two PDOs.
// Types for remote frames (252, 253), which CiA advises against, are refused.
pub(super) const SYNC_EVERY_MAX: u8 = 240;
pub(super) const EVENT_MANUFACTURER: u8 = 254;
pub(super) const EVENT_PROFILE: u8 = 255;

/// The values of a receive PDO, by object.
pub(super) type Values = Vec<(ObjectAddress, u64)>;

/// Minimum interval between two event-driven PDOs. A device checks its objects once per cycle, so a
/// moving axis cannot flood the bus.
const EVENT_SPACING_MIN: Duration = Duration::from_millis(1);

/// The parameters that both directions have.
#[derive(Debug, Clone)]
struct Settings {
    /// `None` while the PDO is switched off or carries nothing.
    cob_id: Option<u16>,
    transmission: u8,
    mapping: PdoMapping,
}

impl Settings {
    fn load(objects: &ObjectDictionary, direction: PdoDirection, offset: u16) -> Self {
        let index = direction.communication_index(offset);
        let cob_id = PdoCobId(objects.integer(ObjectAddress::new(index, 1)) as u32);
        let mapping = mapping_of(objects, direction, offset);
        let is_active = cob_id.is_valid() && !mapping.objects().is_empty();
        Settings {
            cob_id: cob_id.cob_id().filter(|_| is_active),
            transmission: objects.integer(ObjectAddress::new(index, 2)) as u8,
            mapping,
        }
    }
}

/// A receive PDO.
#[derive(Debug, Clone)]
pub(super) struct Rpdo {
    settings: Settings,
    /// Received, and waiting for SYNC. A newer PDO replaces it.
    latched: Option<Values>,
}

impl Rpdo {
    pub(super) fn load(objects: &ObjectDictionary, offset: u16) -> Self {
        Rpdo { settings: Settings::load(objects, PdoDirection::Receive, offset), latched: None }
    }

    pub(super) fn is_for(&self, frame: &Frame) -> bool {
        self.settings.cob_id.is_some_and(|cob_id| frame.cob_id() == Some(cob_id))
    }

    /// The values to act on now: none if they wait for SYNC. Returns `None` if the frame is shorter than the
    /// mapping.
    pub(super) fn receive(&mut self, frame: &Frame) -> Option<Values> {
        let values = self.settings.mapping.unpack(frame.data())?;
        if self.settings.transmission <= SYNC_EVERY_MAX {
            self.latched = Some(values);
            Some(Vec::new())
        } else {
            Some(values)
        }
    }

    /// The values that waited for this SYNC.
    pub(super) fn take_latched(&mut self) -> Values {
        self.latched.take().unwrap_or_default()
    }
}

/// A transmit PDO.
#[derive(Debug, Clone)]
pub(super) struct Tpdo {
    settings: Settings,
    inhibit: Duration,
    event_timer: Duration,
    /// Payload of the last event-driven PDO; `None` before the first one in Operational.
    last_payload: Option<Vec<u8>>,
    /// SYNCs since the last SYNC-driven PDO.
    syncs: u8,
    not_before: Time,
    event_due: Time,
    /// Something changed while the inhibit time ran.
    pending: bool,
}

impl Tpdo {
    pub(super) fn load(objects: &ObjectDictionary, offset: u16) -> Self {
        let index = PdoDirection::Transmit.communication_index(offset);
        let time = |sub| objects.integer(ObjectAddress::new(index, sub)).unsigned_abs();
        let inhibit = Duration::from_micros(100 * time(3));
        Tpdo {
            settings: Settings::load(objects, PdoDirection::Transmit, offset),
            inhibit: inhibit.max(EVENT_SPACING_MIN),
            event_timer: Duration::from_millis(time(5)),
            last_payload: None,
            syncs: 0,
            not_before: Time::ZERO,
            event_due: Time::NEVER,
            pending: false,
        }
    }

    /// The node became Operational, or the PDO's parameters changed while it was.
    pub(super) fn start(&mut self, now: Time) {
        self.last_payload = None;
        self.syncs = 0;
        self.not_before = now;
        self.rearm(now);
    }

    /// The PDO of this SYNC, if one is due.
    pub(super) fn sync(&mut self, objects: &ObjectDictionary) -> Option<Frame> {
        let every = self.settings.transmission;
        if !(1..=SYNC_EVERY_MAX).contains(&every) {
            return None;
        }
        self.syncs += 1;
        if self.syncs < every {
            return None;
        }
        self.syncs = 0;
        self.frame(&payload(&self.settings.mapping, objects))
    }

    /// The PDO to send because an object changed or its event timer ran out.
    pub(super) fn event(&mut self, now: Time, objects: &ObjectDictionary) -> Option<Frame> {
        if !self.is_event_driven() {
            return None;
        }
        let payload = payload(&self.settings.mapping, objects);
        let due = now >= self.event_due || self.last_payload.as_ref() != Some(&payload);
        self.pending = due && now < self.not_before;
        if !due || self.pending {
            return None;
        }
        self.not_before = now + self.inhibit;
        self.rearm(now);
        let frame = self.frame(&payload);
        self.last_payload = Some(payload);
        frame
    }

    pub(super) fn deadline(&self) -> Time {
        match (self.is_event_driven(), self.pending) {
            (false, _) => Time::NEVER,
            (true, false) => self.event_due,
            (true, true) => self.not_before,
        }
    }

    fn is_event_driven(&self) -> bool {
        self.settings.cob_id.is_some()
            && matches!(self.settings.transmission, EVENT_MANUFACTURER | EVENT_PROFILE)
    }

    fn rearm(&mut self, now: Time) {
        self.pending = false;
        self.event_due =
            if self.event_timer.is_zero() { Time::NEVER } else { now + self.event_timer };
    }

    fn frame(&self, payload: &[u8]) -> Option<Frame> {
        Some(Frame::new(self.settings.cob_id?, payload))
    }
}

fn payload(mapping: &PdoMapping, objects: &ObjectDictionary) -> Vec<u8> {
    mapping.pack(mapping.objects().iter().map(|entry| objects.integer(entry.object) as u64))
}
