//! Ctrl-C and SIGTERM, as a flag that the control loop reads.

use nix::sys::signal::Signal;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};

/// Raised once the operator or the system has asked the program to end.
#[derive(Debug, Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Listens for SIGINT and SIGTERM from now on. They no longer kill the process: the flag is
    /// all they do, however often they come, so that the stage is stopped in order. Nor does
    /// SIGXFSZ: a file that may not grow (`ulimit -f`) is an error of writing it.
    ///
    /// # Errors
    /// When the handlers cannot be installed.
    pub fn listen(runtime: &Runtime) -> io::Result<Self> {
        let interrupt = Interrupt::default();
        let _in_runtime = runtime.enter();
        for kind in [SignalKind::interrupt(), SignalKind::terminate()] {
            let mut signals = signal(kind)?;
            let raised = interrupt.clone();
            runtime.spawn(async move {
                while signals.recv().await.is_some() {
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
        self.0.store(true, Ordering::Relaxed);
    }

    /// True once it was raised.
    pub fn is_raised(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
