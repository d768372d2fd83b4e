//! What the keys of the console do.

use super::screen::Setup;
use super::{Shared, lock};
use crate::session::OperatorCommand;
use rtrb::Producer;
use std::mem;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

const CTRL_C: u8 = 3;
const ESCAPE: u8 = 27;
/// Longest escape sequence of a key.
const SEQUENCE_MAX: usize = 16;
/// A terminal sends a sequence at once; later bytes are keys that the operator pressed.
const SEQUENCE_TIME_MAX: Duration = Duration::from_millis(100);

/// Turns the bytes of the keyboard into commands.
#[derive(Debug, Default)]
pub(super) struct Keys {
    /// The start of an escape sequence whose end has not come yet.
    pending: Vec<u8>,
    /// When its first byte was read.
    pending_since: Option<Instant>,
    /// Between the markers of a paste: only the keys that hold or stop act.
    is_pasting: bool,
}

impl Keys {
    /// Notes that no byte is waiting at `now`, and discards a sequence that has been incomplete for too long. Bytes
    /// that wait because this thread was descheduled still complete a sequence.
    pub(super) fn idle(&mut self, now: Instant) {
        let is_old = |since: Instant| now.saturating_duration_since(since) > SEQUENCE_TIME_MAX;
        if self.pending_since.is_some_and(is_old) {
            self.pending.clear();
            self.pending_since = None;
        }
    }

    /// Takes what was read from the terminal at `now`, and does what its keys say.
    pub(super) fn take(
        &mut self,
        now: Instant,
        pressed: &[u8],
        shared: &Shared,
        commands: &mut Producer<OperatorCommand>,
    ) {
        let mut since = self.pending_since.unwrap_or(now);
        self.pending.extend(pressed);
        // The speed asked for so far by the `+` and `-` of this read.
        let mut speed_mm_per_s = None;
        while let Some(len) = first_len(&self.pending) {
            let sequence: Vec<u8> = self.pending.drain(..len).collect();
            since = now;
            match &sequence[..] {
                [key] => self.press(*key, shared, commands, &mut speed_mm_per_s),
                // The markers of a bracketed paste.
                b"\x1b[200~" => self.is_pasting = true,
                b"\x1b[201~" => self.is_pasting = false,
                _ => {}
            }
        }
        self.pending_since = (!self.pending.is_empty()).then_some(since);
    }

    fn press(
        &self,
        key: u8,
        shared: &Shared,
        commands: &mut Producer<OperatorCommand>,
        speed_mm_per_s: &mut Option<f64>,
    ) {
        let is_over = shared.is_over.load(Ordering::Relaxed);
        // A hold and a stop must not wait for the lock on the screen.
        match key {
            b'q' | CTRL_C if is_over => shared.is_leaving.store(true, Ordering::Relaxed),
            b'q' | CTRL_C => shared.interrupt.raise(),
            b' ' if !is_over => shared.hold.store(true, Ordering::Relaxed),
            _ if self.is_pasting => {}
            b'?' => {
                let mut screen = lock(&shared.screen);
                screen.has_help = !screen.has_help;
            }
            key if is_over => press_at_end(key, shared),
            key => {
                let Some(command) = command(key, shared, speed_mm_per_s) else { return };
                if commands.push(command).is_err() {
                    shared.dropped.fetch_add(1, Ordering::Relaxed);
                }
            }
        }
    }
}

/// Length of the first key in `bytes`, or of the first escape sequence (an arrow key's, say), which the console
/// ignores; `None` if the end of a sequence has not come yet.
fn first_len(bytes: &[u8]) -> Option<usize> {
    match bytes {
        [] | [ESCAPE] | [ESCAPE, b'O'] => None,
        [ESCAPE, b'[', sequence @ ..] => {
            // Up to its final byte; a space or Ctrl-C is never part of it.
            match sequence.iter().position(|byte| !(0x30..=0x3f).contains(byte)) {
                Some(last) if (0x40..=0x7e).contains(&sequence[last]) => Some(last + 3),
                Some(other) => Some(other + 2),
                None if sequence.len() < SEQUENCE_MAX => None,
                None => Some(bytes.len()),
            }
        }
        // A space or Ctrl-C after these two is a key of its own.
        [ESCAPE, b'O', last, ..] => Some(if (0x40..=0x7e).contains(last) { 3 } else { 2 }),
        _ => Some(1),
    }
}

/// The command for `key`. It may be outside the limits: the session refuses it then.
fn command(key: u8, shared: &Shared, speed_mm_per_s: &mut Option<f64>) -> Option<OperatorCommand> {
    let (set_mm_per_s, speed_max, step_mm) = {
        let screen = lock(&shared.screen);
        let Setup { speed_max_mm_per_s, step_mm, .. } = screen.setup;
        (screen.progress.speed_mm_per_s, speed_max_mm_per_s, step_mm)
    };
    let mut change_by_tenths = |tenths: f64| {
        // An insertion begins at the highest speed; until its first progress report, the speed here is 0.
        let set_mm_per_s = if set_mm_per_s > 0.0 { set_mm_per_s } else { speed_max };
        let from_mm_per_s = speed_mm_per_s.unwrap_or(set_mm_per_s);
        let mm_per_s = ((from_mm_per_s / speed_max * 10.0).round() + tenths) * 0.1 * speed_max;
        // Clamped, so that presses which the session refuses do not accumulate.
        *speed_mm_per_s = Some(mm_per_s.clamp(0.1 * speed_max, speed_max));
        Some(OperatorCommand::Speed { mm_per_s })
    };
    match key {
        b'r' => Some(OperatorCommand::Resume),
        b's' => Some(OperatorCommand::Step { mm: step_mm }),
        b'+' | b'=' => change_by_tenths(1.0),
        b'-' => change_by_tenths(-1.0),
        _ => None,
    }
}

/// A key after the end of the run: `w` asks whether to withdraw the needle, `y` confirms; any other key cancels.
fn press_at_end(key: u8, shared: &Shared) {
    let mut screen = lock(&shared.screen);
    let was_asked = mem::take(&mut screen.asks_to_withdraw);
    match key {
        b'y' if was_asked => {
            shared.wants_withdrawal.store(true, Ordering::Relaxed);
            shared.is_leaving.store(true, Ordering::Relaxed);
        }
        b'w' => screen.asks_to_withdraw = matches!(screen.withdrawal, Some(Ok(_))),
        _ => {}
    }
}
