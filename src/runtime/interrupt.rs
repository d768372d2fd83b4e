//! Ctrl-C, SIGTERM, SIGHUP and SIGQUIT, as a flag that the control loop reads.

use nix::sys::signal::Signal;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use tokio::signal::unix::{SignalKind, signal};

/// A signal has come. It holds for as long as the process lives: what a command would do next, such as the
/// run after its preflight, is not begun.
static SIGNALLED: AtomicBool = AtomicBool::new(false);

/// Raised once the operator or the system has asked the program to end.
#[derive(Debug, Clone, Default)]
pub struct Interrupt {
    raised: Arc<AtomicBool>,
    hears_signals: bool,
}

impl Interrupt {
    /// Listens for SIGINT, SIGTERM, SIGHUP (a terminal that was closed) and SIGQUIT from now on, and knows
    /// of those that came since the first one listened. They no longer kill the process: the flag is all
    /// they do, however often they come, so that the stage is stopped in order. Nor does SIGXFSZ: a file
    /// that may not grow (`ulimit -f`) is an error of writing it.
    ///
    /// # Errors
    /// When the handlers cannot be installed.
    pub fn listen() -> io::Result<Self> {
        static IS_LISTENING: Mutex<bool> = Mutex::new(false);
        let mut is_listening = IS_LISTENING.lock().unwrap_or_else(PoisonError::into_inner);
        if !*is_listening {
            hear_signals()?;
            *is_listening = true;
        }
        Ok(Interrupt { hears_signals: true, ..Interrupt::default() })
    }

    /// Raises the flag.
    pub fn raise(&self) {
        self.raised.store(true, Ordering::Relaxed);
    }

    /// True once it was raised.
    pub fn is_raised(&self) -> bool {
        self.raised.load(Ordering::Relaxed) || self.is_signalled()
    }

    /// True once a signal has raised it: the program is to end, not only what it does.
    pub fn is_signalled(&self) -> bool {
        self.hears_signals && SIGNALLED.load(Ordering::Relaxed)
    }
}

/// A thread that notes signals until the process ends.
fn hear_signals() -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let in_runtime = runtime.enter();
    for kind in
        [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup(), SignalKind::quit()]
    {
        let mut signals = signal(kind)?;
        runtime.spawn(async move {
            while signals.recv().await.is_some() {
                SIGNALLED.store(true, Ordering::Relaxed);
            }
        });
    }
    // With a handler installed the signal no longer kills; nothing has to read it.
    let _ = signal(SignalKind::from_raw(Signal::SIGXFSZ as i32))?;
    drop(in_runtime);
    let hear = move || runtime.block_on(std::future::pending::<()>());
    thread::Builder::new().name("signals".to_owned()).spawn(hear)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::sys::signal::{Signal, raise};
    use std::time::{Duration, Instant};

    #[test]
    fn the_operators_own_stop_is_no_signal() {
        let interrupt = Interrupt::default();
        interrupt.raise();
        assert_eq!((interrupt.is_raised(), interrupt.is_signalled()), (true, false));
    }

    /// A terminal that is closed, a service that is stopped: none of them leaves a moving stage, nor lets
    /// what comes after begin.
    #[test]
    fn every_way_to_end_a_program_raises_the_flag_for_good() {
        for kind in [Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP, Signal::SIGQUIT] {
            SIGNALLED.store(false, Ordering::Relaxed);
            let interrupt = Interrupt::listen().unwrap();
            raise(kind).unwrap();
            let end = Instant::now() + Duration::from_secs(10);
            while !interrupt.is_raised() {
                assert!(Instant::now() < end, "{kind} is not heard");
                std::thread::yield_now();
            }
            assert!(interrupt.is_signalled(), "{kind}");
            assert!(Interrupt::listen().unwrap().is_raised(), "{kind}: the next one knows");
            assert!(!Interrupt::default().is_raised(), "one that does not listen does not");
        }
    }
}
