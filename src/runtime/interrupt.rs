//! Ctrl-C, SIGTERM, SIGHUP and SIGQUIT, as a flag that the control loop reads.

use nix::sys::signal::Signal;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use tokio::signal::unix::{SignalKind, signal};

/// A signal has come. It is never cleared, so that the command begins nothing else, such as the run after its
/// preflight.
static SIGNALLED: AtomicBool = AtomicBool::new(false);

/// A flag that is raised once the operator or the system has asked the program to end.
#[derive(Debug, Clone, Default)]
pub struct Interrupt {
    raised: Arc<AtomicBool>,
    /// Signals raise the flag, too.
    listens: bool,
}

impl Interrupt {
    /// A flag that SIGINT, SIGTERM, SIGHUP (a terminal that was closed) and SIGQUIT raise. It is raised already
    /// if one of them has come since the first call. They no longer kill the process, however often they come,
    /// so that the stage is stopped in order. Nor does SIGXFSZ: writing a file that may not grow (`ulimit -f`)
    /// gives an error instead.
    ///
    /// # Errors
    /// When the handlers cannot be installed.
    pub fn listen() -> io::Result<Self> {
        static IS_LISTENING: Mutex<bool> = Mutex::new(false);
        let mut is_listening = IS_LISTENING.lock().unwrap_or_else(PoisonError::into_inner);
        if !*is_listening {
            install_handlers()?;
            *is_listening = true;
        }
        Ok(Interrupt { listens: true, ..Interrupt::default() })
    }

    /// Raises the flag.
    pub fn raise(&self) {
        self.raised.store(true, Ordering::Relaxed);
    }

    /// True once the flag was raised.
    pub fn is_raised(&self) -> bool {
        self.raised.load(Ordering::Relaxed) || self.is_signalled()
    }

    /// True once a signal has raised the flag: the program must end, not only its present task.
    pub fn is_signalled(&self) -> bool {
        self.listens && SIGNALLED.load(Ordering::Relaxed)
    }
}

/// Installs the signal handlers, and starts a thread that notes signals until the process ends.
fn install_handlers() -> io::Result<()> {
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
    // With a handler installed, this signal no longer kills; nothing needs to read it.
    let _ = signal(SignalKind::from_raw(Signal::SIGXFSZ as i32))?;
    drop(in_runtime);
    let run = move || runtime.block_on(std::future::pending::<()>());
    thread::Builder::new().name("signals".to_owned()).spawn(run)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::sys::signal::{Signal, raise};
    use std::time::{Duration, Instant};

    #[test]
    fn a_stop_by_the_operator_counts_as_no_signal() {
        let interrupt = Interrupt::default();
        interrupt.raise();
        assert_eq!((interrupt.is_raised(), interrupt.is_signalled()), (true, false));
    }

    /// Ctrl-C, a stopped service, a closed terminal and Ctrl-\ each stop a moving stage, and no later run may
    /// begin.
    #[test]
    fn every_signal_that_ends_a_program_raises_the_flag_for_good() {
        for kind in [Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP, Signal::SIGQUIT] {
            SIGNALLED.store(false, Ordering::Relaxed);
            let interrupt = Interrupt::listen().unwrap();
            raise(kind).unwrap();
            let end = Instant::now() + Duration::from_secs(10);
            while !interrupt.is_raised() {
                assert!(Instant::now() < end, "{kind} is not received");
                std::thread::yield_now();
            }
            assert!(interrupt.is_signalled(), "{kind}");
            assert!(
                Interrupt::listen().unwrap().is_raised(),
                "{kind}: a later listener does not know"
            );
            assert!(!Interrupt::default().is_raised(), "{kind}: raised without listening");
        }
    }
}
