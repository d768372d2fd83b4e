//! What the keys of the console do.

use super::screen::Setup;
use super::{Shared, lock};
use crate::session::OperatorCommand;
use std::mem;
use std::sync::atomic::Ordering;
use std::sync::mpsc::SyncSender;

const CTRL_C: u8 = 3;
const ESCAPE: u8 = 27;

/// Does what the keys say. An escape sequence, such as an arrow's, is no key.
pub(super) fn take_keys(pressed: &[u8], shared: &Shared, commands: &SyncSender<OperatorCommand>) {
    let is_over = shared.is_over.load(Ordering::Relaxed);
    let mut keys = pressed.iter();
    while let Some(key) = keys.next() {
        match (*key, keys.as_slice().first()) {
            // Up to its final byte.
            (ESCAPE, Some(b'[')) => {
                keys.next();
                keys.find(|byte| (0x40..=0x7e).contains(*byte));
                continue;
            }
            (ESCAPE, Some(b'O')) => {
                keys.nth(1);
                continue;
            }
            _ => {}
        }
        let (speed, speed_max, step_mm) = {
            let screen = lock(&shared.screen);
            let Setup { speed_max_mm_per_s, step_mm, .. } = screen.setup;
            (screen.progress.speed_mm_per_s, speed_max_mm_per_s, step_mm)
        };
        // The session refuses what is out of its limits.
        let tenths = |by: f64| OperatorCommand::Speed {
            mm_per_s: ((speed / speed_max * 10.0).round() + by) * 0.1 * speed_max,
        };
        let command = match key {
            b'?' => {
                let mut screen = lock(&shared.screen);
                screen.has_help = !screen.has_help;
                continue;
            }
            key if is_over => {
                take_last_key(*key, shared);
                continue;
            }
            b'q' | &CTRL_C => {
                shared.interrupt.raise();
                continue;
            }
            b' ' => {
                shared.hold.store(true, Ordering::Relaxed);
                continue;
            }
            b'r' => OperatorCommand::Resume,
            b's' => OperatorCommand::Step { mm: step_mm },
            b'+' | b'=' => tenths(1.0),
            b'-' => tenths(-1.0),
            _ => continue,
        };
        if commands.try_send(command).is_err() {
            shared.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// A key after the end of the run. The needle is withdrawn after w and y.
fn take_last_key(key: u8, shared: &Shared) {
    let mut screen = lock(&shared.screen);
    let was_asked = mem::take(&mut screen.asks_to_withdraw);
    match key {
        b'y' if was_asked => {
            shared.withdraws.store(true, Ordering::Relaxed);
            shared.is_leaving.store(true, Ordering::Relaxed);
        }
        b'w' => screen.asks_to_withdraw = screen.withdrawal().is_ok(),
        b'q' | CTRL_C => shared.is_leaving.store(true, Ordering::Relaxed),
        _ => {}
    }
}
