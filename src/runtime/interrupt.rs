//! Ctrl-C, SIGTERM, SIGHUP and SIGQUIT, as a flag that the control loop reads.

use nix::sys::signal::Signal;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};

/// Raised once the operator or the system has asked the program to end.
#[derive(Debug, Clone, Default)]
pub struct Interrupt(Arc<Flags>);

#[derive(Debug, Default)]
struct Flags {
    raised: AtomicBool,
    signalled: AtomicBool,
}

impl Interrupt {
    /// Listens for SIGINT, SIGTERM, SIGHUP (a terminal that was closed) and SIGQUIT from now on.
    /// They no longer kill the process: the flag is all they do, however often they come, so that
    /// the stage is stopped in order. Nor does SIGXFSZ: a file that may not grow (`ulimit -f`) is an
    /// error of writing it.
    ///
    /// # Errors
    /// When the handlers cannot be installed.
    pub fn listen(runtime: &Runtime) -> io::Result<Self> {
        let interrupt = Interrupt::default();
        let _in_runtime = runtime.enter();
        for kind in [
            SignalKind::interrupt(),
            SignalKind::terminate(),
            SignalKind::hangup(),
            SignalKind::quit(),
        ] {
            let mut signals = signal(kind)?;
            let raised = interrupt.clone();
            runtime.spawn(async move {
                while signals.recv().await.is_some() {
                    raised.0.signalled.store(true, Ordering::Relaxed);
                    raised.raise();
                }
            });
        }
        // Once listened to it kills no more, heard or not.
        let _ = signal(SignalKind::from_raw(Signal::SIGXFSZ as i32))?;
        Ok(interrupt)
    }

    /// Raises the flag.
    pub fn raise(&self) {
        self.0.raised.store(true, Ordering::Relaxed);
    }

    /// True once it was raised.
    pub fn is_raised(&self) -> bool {
        self.0.raised.load(Ordering::Relaxed)
    }

    /// True once a signal has raised it: the program is to end, not only what it does.
    pub fn is_signalled(&self) -> bool {
        self.0.signalled.load(Ordering::Relaxed)
    }
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

    /// A terminal that is closed, a service that is stopped: none of them leaves a moving stage.
    #[test]
    fn every_way_to_end_a_program_raises_the_flag() {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        for kind in [Signal::SIGINT, Signal::SIGTERM, Signal::SIGHUP, Signal::SIGQUIT] {
            let interrupt = Interrupt::listen(&runtime).unwrap();
            raise(kind).unwrap();
            let end = Instant::now() + Duration::from_secs(10);
            while !interrupt.is_raised() {
                assert!(Instant::now() < end, "{kind} is not heard");
                std::thread::yield_now();
            }
            assert!(interrupt.is_signalled(), "{kind}");
        }
    }
}
