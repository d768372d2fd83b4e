//! A scripted CiA 402 drive: the part that the stage uses, and the ways to misbehave.

use std::collections::BTreeMap;

use crate::canopen::cia402::{DriveState, Statusword};
use crate::canopen::emcy::{Emcy, EmcyCode};
use crate::canopen::nmt::{NmtCommand, NmtState, heartbeat_frame, parse_nmt};
use crate::canopen::pdo::PdoCobId;
use crate::canopen::sdo::codec::{ClientFrame, ServerFrame};
use crate::canopen::sdo::{AbortCode, SdoReply, SdoRequest, SdoValue};
use crate::canopen::sync::is_sync;
use crate::canopen::{Frame, NodeId, ObjectAddress, cob};
use crate::units::Time;
use std::time::Duration;

pub(super) const VENDOR: u32 = 0xfb;

pub(super) struct TestDrive {
    pub(super) node: NodeId,
    pub(super) objects: BTreeMap<ObjectAddress, SdoValue>,
    pub(super) nmt: NmtState,
    pub(super) state: DriveState,
    pub(super) counts: i32,
    rpdo: Option<(u16, i32)>,
    controlword: u16,
    target: i32,
    step: i32,
    next_heartbeat: Time,
    out: Vec<Frame>,

    /// Without supply: it receives and sends nothing.
    pub(super) off: bool,
    /// This many requests about this object get no answer.
    pub(super) mute: Option<(ObjectAddress, u32)>,
    /// Reads of this object are refused.
    pub(super) refused: Option<(ObjectAddress, AbortCode)>,
    /// Writes of this object are refused.
    pub(super) read_only: Option<ObjectAddress>,
    /// Whether an object was written while the motor had power.
    pub(super) configured_under_power: bool,
    /// Number of next TPDOs that are lost.
    pub(super) tpdos_lost: u32,
    /// Writes of this object are confirmed but not kept.
    pub(super) forgets: Option<ObjectAddress>,
    /// Bits that are set in the statusword, and then bits that are cleared.
    pub(super) extra_bits: u16,
    pub(super) clear_bits: u16,
    /// Before each SYNC this RPDO1 arrives late, after the newest one.
    pub(super) stale_rpdo: Option<(u16, i32)>,
    /// Ignores controlwords in RPDO1, or those by SDO.
    pub(super) ignores_rpdo: bool,
    pub(super) ignores_sdo: bool,
    /// It reports this position, whatever its own is.
    pub(super) frozen_at: Option<i32>,
    /// The highest speed in counts a SYNC at which power was taken off.
    pub(super) coasted_from: i32,
    /// SYNCs between Switch On and Switched On, to charge capacitors.
    pub(super) charge_cycles: u32,
    /// SYNCs between Enable Operation and Operation Enabled, to open a brake.
    pub(super) brake_cycles: u32,
    pub(super) heartbeat_off: bool,
    /// State of homing, for bits 10, 12 and 13 of the statusword in homing mode.
    pub(super) homing: Homing,
    /// SYNCs that homing takes.
    pub(super) homing_cycles: u32,
    /// SYNCs for which the bits of an earlier homing stay after a new one has begun.
    pub(super) clears_late: u32,
    pub(super) homing_fails: bool,
    /// A reset does not end its fault.
    pub(super) keeps_its_fault: bool,
    /// Number of rising edges of Fault Reset.
    pub(super) resets: u32,
    /// Its safety input is open: it stays in Switch On Disabled, or returns there.
    pub(super) safety_open: bool,
    /// Its answer to the last SYNC.
    pub(super) last_tpdo: Option<Frame>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Homing {
    NotDone,
    Attained,
    Failed,
    Running { cycles: u32 },
}

fn at(index: u16, subindex: u8) -> ObjectAddress {
    ObjectAddress::new(index, subindex)
}

impl TestDrive {
    pub(super) fn new(node: NodeId, counts: i32) -> Self {
        let id = u32::from(node.get());
        let mut objects: BTreeMap<ObjectAddress, SdoValue> = [
            (at(0x1000, 0), SdoValue::from(0x0002_0192_u32)),
            (at(0x1001, 0), 0_u8.into()),
            (at(0x1003, 1), 0x0000_7320_u32.into()),
            (at(0x1005, 0), 0x80_u32.into()),
            (at(0x1016, 1), 0_u32.into()),
            (at(0x1017, 0), 0_u16.into()),
            (at(0x1018, 1), VENDOR.into()),
            (at(0x1018, 2), 0x6065_0000_u32.into()),
            (at(0x1018, 3), 0x0170_0000_u32.into()),
            (at(0x1029, 1), 1_u8.into()),
            (at(0x1400, 1), (0x200 + id).into()),
            (at(0x1401, 1), (0x300 + id).into()),
            (at(0x1800, 1), PdoCobId::enabled(cob::tpdo1(node)).0.into()),
            (at(0x1801, 1), (0xc000_0280 + id).into()),
            (at(0x6007, 0), 1_i16.into()),
            (at(0x603f, 0), 0x7320_u16.into()),
            (at(0x6040, 0), 0_u16.into()),
            (at(0x605a, 0), 2_i16.into()),
            (at(0x6060, 0), 1_i8.into()),
            (at(0x6065, 0), 2000_u32.into()),
            (at(0x607a, 0), 0_i32.into()),
            (at(0x607c, 0), 0_i32.into()),
            (at(0x607d, 1), (-5000_i32).into()),
            (at(0x607d, 2), (-4000_i32).into()),
            (at(0x6085, 0), 10_000_u32.into()),
            (at(0x6098, 0), 0_i8.into()),
            (at(0x6099, 1), 100_u32.into()),
            (at(0x6099, 2), 10_u32.into()),
            (at(0x609a, 0), 1000_u32.into()),
            (at(0x60b0, 0), 0_i32.into()),
            (at(0x60c2, 1), 1_u8.into()),
            (at(0x60c2, 2), (-3_i8).into()),
            (at(0x6502, 0), 0x3a5_u32.into()),
        ]
        .into();
        for (communication, mapping) in [(0x1400, 0x1600), (0x1800, 0x1a00)] {
            objects.insert(at(communication, 2), 255_u8.into());
            objects.insert(at(mapping, 0), 1_u8.into());
            objects.insert(at(mapping, 1), 0x6040_0010_u32.into());
            objects.insert(at(mapping, 2), 0_u32.into());
        }
        TestDrive {
            node,
            objects,
            nmt: NmtState::PreOperational,
            state: DriveState::SwitchOnDisabled,
            counts,
            rpdo: None,
            controlword: 0,
            target: 0,
            step: 0,
            next_heartbeat: Time::NEVER,
            out: Vec::new(),
            off: false,
            mute: None,
            refused: None,
            read_only: None,
            configured_under_power: false,
            tpdos_lost: 0,
            forgets: None,
            extra_bits: 0,
            clear_bits: 0,
            stale_rpdo: None,
            ignores_rpdo: false,
            ignores_sdo: false,
            coasted_from: 0,
            frozen_at: None,
            charge_cycles: 0,
            brake_cycles: 0,
            heartbeat_off: false,
            homing: Homing::NotDone,
            homing_cycles: 20,
            clears_late: 0,
            homing_fails: false,
            keeps_its_fault: false,
            resets: 0,
            safety_open: false,
            last_tpdo: None,
        }
    }

    pub(super) fn value(&self, index: u16, subindex: u8) -> u32 {
        self.objects[&at(index, subindex)].to_u32()
    }

    pub(super) fn set(&mut self, index: u16, subindex: u8, value: impl Into<SdoValue>) {
        self.objects.insert(at(index, subindex), value.into());
    }

    pub(super) fn emergency(&self, code: u16) -> Frame {
        let emcy = Emcy { code: EmcyCode(code), register: 0x21, manufacturer: [0; 5] };
        emcy.to_frame(self.node)
    }

    pub(super) fn deadline(&self) -> Time {
        if self.off || self.heartbeat_off { Time::NEVER } else { self.next_heartbeat }
    }

    pub(super) fn handle_timeout(&mut self, now: Time) -> Vec<Frame> {
        if now < self.deadline() {
            return Vec::new();
        }
        self.next_heartbeat = now + Duration::from_millis(self.value(0x1017, 0).into());
        vec![heartbeat_frame(self.node, self.nmt)]
    }

    pub(super) fn handle_frame(&mut self, now: Time, frame: &Frame) -> Vec<Frame> {
        if self.off {
            return Vec::new();
        }
        if let Some((command, Some(node))) = parse_nmt(frame)
            && node == self.node
        {
            self.nmt = match command {
                NmtCommand::StartRemoteNode => NmtState::Operational,
                NmtCommand::StopRemoteNode => NmtState::Stopped,
                _ => NmtState::PreOperational,
            };
        } else if frame.cob_id() == Some(cob::sdo_rx(self.node)) {
            if self.nmt != NmtState::Stopped {
                self.handle_sdo(now, frame);
            }
        } else if self.nmt == NmtState::Operational {
            if frame.cob_id() == Some(cob::rpdo1(self.node)) {
                let [c0, c1, t @ ..] = frame.data() else { panic!("RPDO1 without a controlword") };
                let target = t.try_into().expect("RPDO1 has 6 bytes");
                self.rpdo = Some((u16::from_le_bytes([*c0, *c1]), i32::from_le_bytes(target)));
            } else if is_sync(frame, cob::SYNC) {
                self.handle_sync();
            }
        }
        std::mem::take(&mut self.out)
    }

    fn handle_sync(&mut self) {
        if self.tpdos_lost > 0 {
            self.tpdos_lost -= 1;
        } else {
            let [s0, s1] = self.statusword().0.to_le_bytes();
            let [p0, p1, p2, p3] = self.frozen_at.unwrap_or(self.counts).to_le_bytes();
            let tpdo = Frame::new(cob::tpdo1(self.node), &[s0, s1, p0, p1, p2, p3]);
            self.last_tpdo = Some(tpdo);
            self.out.push(tpdo);
        }
        if let Some((controlword, target)) = self.stale_rpdo.or(self.rpdo) {
            if !self.ignores_rpdo {
                self.command(controlword);
            }
            self.target = target;
        }
        let speed = self.step.abs();
        self.step = match self.state {
            DriveState::OperationEnabled if self.is_homing_mode() => self.home(),
            DriveState::OperationEnabled => {
                let offset =
                    self.objects.get(&at(0x60b0, 0)).map_or(0, |value| value.to_u32() as i32);
                self.target.wrapping_add(offset).wrapping_sub(self.counts)
            }
            DriveState::QuickStopActive => self.step - self.step.signum(),
            _ => 0,
        };
        if self.state == DriveState::SwitchOnDisabled {
            self.coasted_from = self.coasted_from.max(speed);
        }
        self.counts = self.counts.wrapping_add(self.step);
    }

    fn is_homing_mode(&self) -> bool {
        self.value(0x6060, 0) == 6
    }

    /// One SYNC of homing: 5 counts of motion, and at the end a position of minus the home offset.
    fn home(&mut self) -> i32 {
        let Homing::Running { cycles } = self.homing else { return 0 };
        if cycles > 0 {
            self.homing = Homing::Running { cycles: cycles - 1 };
            return -5;
        }
        self.homing = if self.homing_fails { Homing::Failed } else { Homing::Attained };
        if !self.homing_fails {
            self.counts =
                -(self.objects.get(&at(0x607c, 0)).map_or(0, |offset| offset.to_u32() as i32));
        }
        0
    }

    fn statusword(&self) -> Statusword {
        let homing = match self.homing {
            _ if !self.is_homing_mode() => 0,
            Homing::NotDone => 0x0400,
            Homing::Attained => 0x1400,
            Homing::Failed => 0x2400,
            Homing::Running { cycles } if cycles + self.clears_late > self.homing_cycles => 0x1400,
            Homing::Running { .. } => 0,
        };
        let bits = Statusword::state_bits(self.state) | 0x0210 | homing | self.extra_bits;
        Statusword(bits & !self.clear_bits)
    }

    fn command(&mut self, controlword: u16) {
        use DriveState as S;
        let rising = controlword & !self.controlword;
        let reset = rising & 0x80 != 0;
        if rising & 0x10 != 0 && self.is_homing_mode() && self.state == S::OperationEnabled {
            self.homing = Homing::Running { cycles: self.homing_cycles };
        }
        self.controlword = controlword;
        self.resets += u32::from(reset);
        self.state = match (self.state, controlword & 0x0f) {
            (S::Fault, _) if reset && !self.keeps_its_fault => S::SwitchOnDisabled,
            (state @ (S::Fault | S::FaultReactionActive | S::NotReadyToSwitchOn), _) => state,
            (S::OperationEnabled, 0x02 | 0x03) => S::QuickStopActive,
            (S::QuickStopActive, 0x0f) if self.value(0x605a, 0) >= 5 => S::OperationEnabled,
            (state @ S::QuickStopActive, 0x02 | 0x03 | 0x06 | 0x07 | 0x0f) => state,
            (_, 0x00 | 0x02 | 0x03) => S::SwitchOnDisabled,
            _ if self.safety_open => S::SwitchOnDisabled,
            (_, 0x06) => S::ReadyToSwitchOn,
            (S::ReadyToSwitchOn, 0x07) if self.charge_cycles > 0 => {
                self.charge_cycles -= 1;
                S::ReadyToSwitchOn
            }
            (S::ReadyToSwitchOn | S::OperationEnabled, 0x07) => S::SwitchedOn,
            (S::SwitchedOn, 0x0f) if self.brake_cycles > 0 => {
                self.brake_cycles -= 1;
                S::SwitchedOn
            }
            (S::SwitchedOn, 0x0f) => S::OperationEnabled,
            (state, _) => state,
        };
    }

    fn handle_sdo(&mut self, now: Time, frame: &Frame) {
        let Some(ClientFrame::Request(request)) = ClientFrame::decode(frame.data()) else { return };
        let object = request.object();
        if let Some((muted, left @ 1..)) = &mut self.mute
            && *muted == object
        {
            *left -= 1;
            return;
        }
        let answer = match request {
            SdoRequest::Upload(object) => self.read(object),
            SdoRequest::Download(object, value) => self.write(now, object, value),
        };
        let answer = answer.unwrap_or_else(|(object, code)| ServerFrame::Abort(object, code));
        self.out.push(Frame::new(cob::sdo_tx(self.node), &answer.encode()));
    }

    fn read(&self, object: ObjectAddress) -> Result<ServerFrame, (ObjectAddress, AbortCode)> {
        if let Some(refused) = self.refused.filter(|(refused, _)| *refused == object) {
            return Err(refused);
        }
        let value = match object.index {
            0x6041 => self.statusword().0.into(),
            0x6061 => self.objects[&at(0x6060, 0)],
            0x6064 => self.counts.into(),
            // "No data available": the error history is empty (CiA 301, 7.5.2.4).
            0x1003 => *self.objects.get(&object).ok_or((object, AbortCode::NO_DATA))?,
            _ => *self.objects.get(&object).ok_or((object, AbortCode::NO_SUCH_OBJECT))?,
        };
        Ok(ServerFrame::Reply(object, SdoReply::Uploaded(value)))
    }

    /// By the rules of CiA 301 for PDO parameters: the number of entries changes only while the PDO is off, an
    /// entry only while that number is 0, and the identifier only while the PDO is switched off.
    fn write(
        &mut self,
        now: Time,
        object: ObjectAddress,
        value: SdoValue,
    ) -> Result<ServerFrame, (ObjectAddress, AbortCode)> {
        let refuse = |code| Err((object, code));
        let Some(before) = self.objects.get(&object).copied() else {
            return refuse(AbortCode::NO_SUCH_OBJECT);
        };
        if self.read_only == Some(object) {
            return refuse(AbortCode::READ_ONLY);
        }
        if before.as_bytes().len() != value.as_bytes().len() {
            return refuse(AbortCode(0x0607_0010));
        }
        let powered = self.state == DriveState::OperationEnabled;
        self.configured_under_power |= powered && object.index != 0x6040;
        let valid = |cob_id: u32| cob_id >> 31 == 0;
        match object.index {
            0x1400..0x1600 | 0x1800..0x1a00 if object.subindex == 1 => {
                let (old, new) = (before.to_u32(), value.to_u32());
                if valid(old) && (old ^ new) & 0x1fff_ffff != 0 {
                    return refuse(AbortCode::INVALID_VALUE);
                }
            }
            0x607d => {
                let value = value.to_u32() as i32;
                let other = self.value(0x607d, 3 - object.subindex) as i32;
                if (object.subindex == 1 && value > other)
                    || (object.subindex == 2 && value < other)
                {
                    return refuse(AbortCode(0x0609_0036));
                }
            }
            0x1600..0x1800 | 0x1a00..0x1c00 => {
                let off = !valid(self.value(object.index - 0x200, 1));
                let empty = object.subindex == 0 || self.value(object.index, 0) == 0;
                if !off || !empty {
                    return refuse(AbortCode::UNSUPPORTED_ACCESS);
                }
            }
            _ => {}
        }
        if self.forgets != Some(object) {
            self.objects.insert(object, value);
        }
        match object.index {
            0x1017 => self.next_heartbeat = now,
            0x6040 if !self.ignores_sdo => self.command(value.to_u32() as u16),
            _ => {}
        }
        Ok(ServerFrame::Reply(object, SdoReply::Downloaded))
    }
}
