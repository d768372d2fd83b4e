//! What the node and its axis share: objects, NMT state and errors.

use std::collections::VecDeque;

use crate::canopen::emcy::{Emcy, EmcyCode, error_register};
use crate::canopen::nmt::NmtState;
use crate::canopen::object::communication::{ERROR_REGISTER, error_history};
use crate::canopen::object_dictionary::ObjectDictionary;

/// Errors kept in the history.
const ERROR_HISTORY_LEN: u8 = 8;
/// Emergency messages kept while the node may not send them.
const EMCY_QUEUE_LEN: usize = 16;

/// Objects, NMT state and errors of a node.
#[derive(Debug, Clone)]
pub(super) struct Device {
    pub(super) objects: ObjectDictionary,
    /// The state that the NMT master put the node in.
    pub(super) nmt_state: NmtState,
    active: Vec<EmcyCode>,
    outgoing: VecDeque<Emcy>,
}

impl Device {
    pub(super) fn new(objects: ObjectDictionary) -> Self {
        Device {
            objects,
            nmt_state: NmtState::PreOperational,
            active: Vec::new(),
            outgoing: VecDeque::new(),
        }
    }

    /// Raises an error: error register, history and emergency message. An error that is active is not
    /// raised again.
    pub(super) fn raise(&mut self, code: EmcyCode, manufacturer: [u8; 5]) {
        if self.is_active(code) {
            return;
        }
        self.active.push(code);
        let register = self.update_register();
        self.remember(code);
        self.send(Emcy { code, register, manufacturer });
    }

    /// Ends one error, and sends an emergency message with code 0.
    pub(super) fn clear(&mut self, code: EmcyCode) {
        if self.is_active(code) {
            self.active.retain(|active| *active != code);
            self.report_cleared();
        }
    }

    /// Ends all errors.
    pub(super) fn clear_all(&mut self) {
        if !self.active.is_empty() {
            self.active.clear();
            self.report_cleared();
        }
    }

    /// True while this error was raised and not cleared.
    pub(super) fn is_active(&self, code: EmcyCode) -> bool {
        self.active.contains(&code)
    }

    pub(super) fn poll_emcy(&mut self) -> Option<Emcy> {
        self.outgoing.pop_front()
    }

    /// Clears all errors without an emergency message, as a reset does.
    pub(super) fn forget_errors(&mut self) {
        self.active.clear();
        self.outgoing.clear();
        self.update_register();
        self.clear_history();
    }

    pub(super) fn clear_history(&mut self) {
        (0..=ERROR_HISTORY_LEN).for_each(|n| self.objects.set(error_history(n), 0));
    }

    fn report_cleared(&mut self) {
        let register = self.update_register();
        self.send(Emcy { code: EmcyCode::NO_ERROR, register, manufacturer: [0; 5] });
    }

    fn update_register(&mut self) -> u8 {
        let bits = self.active.iter().map(|code| code.register_bits() | error_register::GENERIC);
        let register = bits.fold(0, |register, bits| register | bits);
        self.objects.set(ERROR_REGISTER, register.into());
        register
    }

    /// The newest error is at subindex 1 (CiA 301, 7.5.2.4).
    fn remember(&mut self, code: EmcyCode) {
        for n in (1..ERROR_HISTORY_LEN).rev() {
            let older = self.objects.integer(error_history(n));
            self.objects.set(error_history(n + 1), older);
        }
        self.objects.set(error_history(1), code.0.into());
        let count = self.objects.integer(error_history(0)) + 1;
        self.objects.set(error_history(0), count.min(ERROR_HISTORY_LEN.into()));
    }

    fn send(&mut self, emcy: Emcy) {
        if self.outgoing.len() == EMCY_QUEUE_LEN {
            self.outgoing.pop_front();
        }
        self.outgoing.push_back(emcy);
    }
}
