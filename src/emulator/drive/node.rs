//! The drive's node (CiA 301): NMT slave, SDO server, PDOs, SYNC, heartbeat and emergencies around the
//! axis.

use std::collections::VecDeque;
use std::time::Duration;

use super::DriveConfig;
use super::axis::Axis;
use super::device::Device;
use super::objects::data_sheet;
use super::parameters::{self, SUPERVISED_LEN};
use super::pdo::{Rpdo, Tpdo, Values};
use crate::canopen::cia402::DriveState;
use crate::canopen::emcy::EmcyCode;
use crate::canopen::heartbeat::{HeartbeatConsumer, HeartbeatEvent, HeartbeatProducer};
use crate::canopen::nmt::{NmtCommand, NmtState, heartbeat_frame, nmt_frame, parse_nmt};
use crate::canopen::object::communication::{self, consumer_heartbeat, error_history};
use crate::canopen::object_dictionary::ObjectDictionary;
use crate::canopen::pdo::PdoDirection;
use crate::canopen::sdo::{AbortCode, ObjectAccess, SdoServer, SdoValue};
use crate::canopen::sync::is_sync;
use crate::canopen::{Frame, NodeId, ObjectAddress};
use crate::emulator::fault::{Fault, FaultKind};
use crate::units::Time;

/// How long the SDO server waits for the next segment.
const SDO_TIMEOUT: Duration = Duration::from_secs(1);

/// An emulated CiA 402 drive, sans-IO.
///
/// Pass in every frame of the bus, call [`handle_timeout`](Self::handle_timeout) at
/// [`deadline`](Self::deadline), and after either drain [`poll_transmit`](Self::poll_transmit).
/// A receive PDO of a synchronous type acts at the next SYNC; transmit PDOs are sampled at SYNC
/// before that, so the effect of a command shows one SYNC later, as with real devices.
///
/// In cyclic synchronous position the axis reaches the target received before a SYNC exactly, at
/// constant speed, one interpolation period (0x60C2) after that SYNC. So the position reported at each
/// SYNC is the target of the SYNC before.
#[derive(Debug, Clone)]
pub struct Drive {
    id: NodeId,
    pub(super) device: Device,
    pub(super) axis: Axis,
    server: SdoServer,
    rpdos: [Rpdo; 4],
    tpdos: [Tpdo; 4],
    producer: HeartbeatProducer,
    supervised: Vec<Supervised>,
    outgoing: VecDeque<Frame>,
}

/// A node whose heartbeat this one watches: an entry of 0x1016.
#[derive(Debug, Clone)]
struct Supervised {
    subindex: u8,
    consumer: HeartbeatConsumer,
    lost: bool,
}

impl Drive {
    /// A drive that has just been switched on; its boot-up message waits to be sent.
    pub fn new(config: DriveConfig) -> Self {
        let objects = data_sheet(&config).objects(config.node);
        Drive::with_objects(config, objects)
    }

    pub(super) fn with_objects(config: DriveConfig, objects: ObjectDictionary) -> Self {
        let (now, id) = (Time::ZERO, config.node);
        let mut node = Drive {
            id,
            rpdos: [0, 1, 2, 3].map(|offset| Rpdo::load(&objects, offset)),
            tpdos: [0, 1, 2, 3].map(|offset| Tpdo::load(&objects, offset)),
            device: Device::new(objects),
            axis: Axis::new(config),
            server: SdoServer::new(id, SDO_TIMEOUT),
            producer: HeartbeatProducer::new(id, Duration::ZERO, now),
            supervised: Vec::new(),
            outgoing: VecDeque::new(),
        };
        node.boot(now);
        node
    }

    /// The node's number.
    pub fn id(&self) -> NodeId {
        self.id
    }

    /// The NMT state.
    pub fn nmt_state(&self) -> NmtState {
        self.device.nmt_state
    }

    /// The state of the CiA 402 state machine.
    pub fn state(&self) -> DriveState {
        self.axis.state()
    }

    /// The true position of the axis in counts, not wrapped to 32 bits and not rounded.
    pub fn position_counts_at(&self, now: Time) -> f64 {
        self.axis.motion.position_at(now)
    }

    /// Begins or ends a fault of the drive or its axis; faults of frames and of the bus do nothing here.
    pub fn apply_fault(&mut self, now: Time, fault: &Fault, begins: bool) {
        match fault.kind {
            // The drive also restarts at the end of the fault: only then does its boot-up message reach the bus.
            FaultKind::Restart => {
                self.handle_frame(now, &nmt_frame(NmtCommand::ResetNode, Some(self.id)));
            }
            _ => {
                self.axis.apply_fault(now, fault, begins, &mut self.device);
                self.flush(now);
            }
        }
    }

    /// Takes any frame of the bus.
    pub fn handle_frame(&mut self, now: Time, frame: &Frame) {
        if let Some((command, target)) = parse_nmt(frame) {
            if target.is_none_or(|target| target == self.id) {
                self.command(now, command);
            }
        } else {
            self.handle_heartbeat(now, frame);
            if self.nmt_state() != NmtState::Stopped {
                self.handle_sdo(now, frame);
            }
            if self.nmt_state() == NmtState::Operational {
                self.handle_process_data(now, frame);
            }
        }
        self.flush(now);
    }

    /// Does what is due at `now`.
    pub fn handle_timeout(&mut self, now: Time) {
        self.server.handle_timeout(now);
        let beat = self.producer.handle_timeout(now, self.nmt_state());
        self.outgoing.extend(beat);
        for n in 0..self.supervised.len() {
            let event = self.supervised[n].consumer.handle_timeout(now);
            if event == Some(HeartbeatEvent::Lost) {
                self.heartbeat_lost(now, n);
            }
        }
        self.flush(now);
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self) -> Option<Frame> {
        self.outgoing.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub fn deadline(&self) -> Time {
        let operational = self.nmt_state() == NmtState::Operational;
        let pdos = self.tpdos.iter().filter(|_| operational).map(Tpdo::deadline);
        let consumers = self.supervised.iter().map(|supervised| supervised.consumer.deadline());
        let own = [self.server.deadline(), self.producer.deadline(), self.axis.deadline()];
        pdos.chain(consumers).chain(own).min().unwrap_or(Time::NEVER)
    }

    fn command(&mut self, now: Time, command: NmtCommand) {
        match command {
            NmtCommand::StartRemoteNode => self.enter(now, NmtState::Operational),
            NmtCommand::StopRemoteNode => self.enter(now, NmtState::Stopped),
            NmtCommand::EnterPreOperational => self.enter(now, NmtState::PreOperational),
            NmtCommand::ResetCommunication => {
                self.enter(now, NmtState::PreOperational);
                // The error register is not a parameter: it shows the errors that the axis still has.
                self.device.objects.reset(0x1002..=0x1fff);
                self.boot(now);
            }
            NmtCommand::ResetNode => {
                self.enter(now, NmtState::PreOperational);
                self.device.objects.reset(0x0000..=0xffff);
                self.device.forget_errors();
                self.axis.reset(now);
                self.boot(now);
            }
        }
    }

    fn enter(&mut self, now: Time, state: NmtState) {
        let before = self.nmt_state();
        if state == before {
            return;
        }
        self.device.nmt_state = state;
        self.rpdos.iter_mut().for_each(|rpdo| drop(rpdo.take_latched()));
        if state == NmtState::Operational {
            self.tpdos.iter_mut().for_each(|tpdo| tpdo.start(now));
        }
        if state == NmtState::Stopped {
            self.server.reset();
        }
        self.axis.nmt_state_changed(now, before, &mut self.device);
    }

    /// Starts communication with the parameters in the objects, and sends the boot-up message.
    fn boot(&mut self, now: Time) {
        self.server.reset();
        let objects = &self.device.objects;
        self.rpdos = [0, 1, 2, 3].map(|offset| Rpdo::load(objects, offset));
        self.tpdos = [0, 1, 2, 3].map(|offset| Tpdo::load(objects, offset));
        self.restart_producer(now);
        (1..=SUPERVISED_LEN).for_each(|subindex| self.restart_consumer(subindex));
        self.outgoing.push_back(heartbeat_frame(self.id, NmtState::BootUp));
    }

    fn handle_heartbeat(&mut self, now: Time, frame: &Frame) {
        for n in 0..self.supervised.len() {
            let supervised = &mut self.supervised[n];
            let was_alive = supervised.consumer.state().is_some();
            match supervised.consumer.handle_frame(now, frame) {
                // A supervised node that restarted counts as lost.
                Some(HeartbeatEvent::BootUp) if was_alive => self.heartbeat_lost(now, n),
                Some(HeartbeatEvent::State(_)) if supervised.lost => {
                    supervised.lost = false;
                    self.heartbeat_returned();
                }
                _ => {}
            }
        }
    }

    fn heartbeat_lost(&mut self, now: Time, n: usize) {
        let supervised = &mut self.supervised[n];
        supervised.lost = true;
        let lost = [supervised.consumer.node().get(), 0, 0, 0, 0];
        self.device.raise(EmcyCode::HEARTBEAT, lost);
        self.axis.heartbeat_lost(now, &mut self.device);
        self.send_emergencies();
        let operational = self.nmt_state() == NmtState::Operational;
        match self.device.objects.integer(communication::COMMUNICATION_ERROR_BEHAVIOUR) {
            0 if operational => self.enter(now, NmtState::PreOperational),
            2 => self.enter(now, NmtState::Stopped),
            _ => {}
        }
    }

    fn heartbeat_returned(&mut self) {
        if !self.supervised.iter().any(|supervised| supervised.lost) {
            self.axis.heartbeat_returned(&mut self.device);
        }
    }

    fn handle_sdo(&mut self, now: Time, frame: &Frame) {
        let Drive { device, axis, server, .. } = self;
        let mut access = Access { now, device, axis, written: None };
        server.handle_frame(now, frame, &mut access);
        match access.written {
            Some(object @ ObjectAddress { index: 0x1000..=0x1fff, .. }) => {
                self.handle_communication_object(now, object);
            }
            Some(object) => self.axis.handle_write(now, object, &mut self.device),
            None => {}
        }
    }

    fn handle_communication_object(&mut self, now: Time, object: ObjectAddress) {
        match (object.index, parameters::pdo_of(object.index)) {
            (_, Some((PdoDirection::Receive, offset))) => {
                self.rpdos[usize::from(offset)] = Rpdo::load(&self.device.objects, offset);
            }
            (_, Some((PdoDirection::Transmit, offset))) => {
                let mut tpdo = Tpdo::load(&self.device.objects, offset);
                tpdo.start(now);
                self.tpdos[usize::from(offset)] = tpdo;
            }
            (0x1003, _) => self.device.clear_history(),
            (0x1016, _) => self.restart_consumer(object.subindex),
            (0x1017, _) => self.restart_producer(now),
            _ => {}
        }
    }

    fn restart_producer(&mut self, now: Time) {
        let period_ms =
            self.device.objects.integer(communication::PRODUCER_HEARTBEAT).unsigned_abs();
        let period = Duration::from_millis(period_ms);
        self.producer = HeartbeatProducer::new(self.id, period, now + period);
    }

    /// Entry of 0x1016: node in bits 16 to 23, time in milliseconds in bits 0 to 15.
    fn restart_consumer(&mut self, subindex: u8) {
        let was_lost = self.supervised.iter().any(|supervised| supervised.lost);
        self.supervised.retain(|supervised| supervised.subindex != subindex);
        let entry = self.device.objects.integer(consumer_heartbeat(subindex));
        let timeout = Duration::from_millis(entry as u64 & 0xffff);
        if let Some(node) = NodeId::new((entry >> 16) as u8)
            && !timeout.is_zero()
        {
            let consumer = HeartbeatConsumer::new(node, timeout);
            self.supervised.push(Supervised { subindex, consumer, lost: false });
        }
        if was_lost {
            self.heartbeat_returned();
        }
    }

    fn handle_process_data(&mut self, now: Time, frame: &Frame) {
        let sync = self.device.objects.integer(communication::SYNC_COB_ID) as u16;
        if is_sync(frame, sync) {
            self.axis.sample(now, &mut self.device);
            let samples = self.tpdos.iter_mut().filter_map(|tpdo| tpdo.sync(&self.device.objects));
            self.outgoing.extend(samples);
            for n in 0..self.rpdos.len() {
                let values = self.rpdos[n].take_latched();
                self.write_values(now, values);
            }
            self.axis.take_target(now, &mut self.device);
            return;
        }
        let Some(rpdo) = self.rpdos.iter_mut().find(|rpdo| rpdo.is_for(frame)) else { return };
        match rpdo.receive(frame) {
            Some(values) => {
                self.device.clear(EmcyCode::PDO_LENGTH);
                self.write_values(now, values);
            }
            None => self.device.raise(EmcyCode::PDO_LENGTH, [0; 5]),
        }
    }

    /// Writes all values of a PDO, then informs the axis, so that a command never acts on
    /// the target of an earlier PDO. Ignores a value that an SDO could not write.
    fn write_values(&mut self, now: Time, values: Values) {
        let mut written = Vec::with_capacity(values.len());
        for (object, bits) in values {
            let Ok(value) = self.device.objects.parse_raw(object, bits) else { continue };
            if self.axis.check_write(object, value).is_ok() {
                self.device.objects.set(object, value);
                written.push(object);
            }
        }
        for object in written {
            self.axis.handle_write(now, object, &mut self.device);
        }
    }

    /// Queues the frames that follow from the last input.
    fn flush(&mut self, now: Time) {
        self.axis.update(now, &mut self.device);
        self.outgoing.extend(std::iter::from_fn(|| self.server.poll_transmit()));
        self.send_emergencies();
        if self.nmt_state() == NmtState::Operational {
            let objects = &self.device.objects;
            self.outgoing.extend(self.tpdos.iter_mut().filter_map(|pdo| pdo.event(now, objects)));
        }
    }

    /// In NMT Stopped they wait until the node leaves it.
    fn send_emergencies(&mut self) {
        if self.nmt_state() == NmtState::Stopped {
            return;
        }
        let emcy_enabled = self.device.objects.integer(communication::EMCY_COB_ID) >> 31 & 1 == 0;
        while let Some(emcy) = self.device.poll_emcy() {
            if emcy_enabled {
                self.outgoing.push_back(emcy.to_frame(self.id));
            }
        }
    }
}

/// The objects as the SDO server reaches them.
struct Access<'a> {
    now: Time,
    device: &'a mut Device,
    axis: &'a mut Axis,
    written: Option<ObjectAddress>,
}

impl ObjectAccess for Access<'_> {
    fn read(&mut self, object: ObjectAddress) -> Result<Vec<u8>, AbortCode> {
        self.axis.update(self.now, self.device);
        let value = self.device.objects.read(object)?;
        let errors = self.device.objects.integer(error_history(0));
        let is_empty = object.index == 0x1003 && i64::from(object.subindex) > errors;
        if is_empty { Err(AbortCode::NO_DATA) } else { Ok(value) }
    }

    fn write(&mut self, object: ObjectAddress, value: SdoValue) -> Result<(), AbortCode> {
        let number = self.device.objects.parse(object, value)?;
        if (0x1000..=0x1fff).contains(&object.index) {
            parameters::check_write(&self.device.objects, object, number)?;
        } else {
            self.axis.check_write(object, number)?;
        }
        self.device.objects.set(object, number);
        self.written = Some(object);
        Ok(())
    }
}
