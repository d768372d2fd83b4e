//! `--realtime` and `--cpu`, of every command that moves the stage.

use super::Failure;
use crate::runtime::{RealTime, enter_real_time};
use clap::Args;
use std::thread;

#[derive(Debug, Default, Clone, Copy, Args)]
pub(super) struct RealTimeArguments {
    /// Give the SYNC thread a real-time priority (SCHED_FIFO) and a processor of its own, and
    /// lock all memory; refused where this process has no right to.
    #[arg(long, global = true)]
    realtime: bool,
    /// The processor of the SYNC thread, by default the last one that this process may use.
    #[arg(long, value_name = "NUMBER", requires = "realtime", global = true)]
    cpu: Option<usize>,
}

impl RealTimeArguments {
    /// Refuses them in virtual time.
    pub(super) fn refuse_virtual_time(self) -> Result<(), Failure> {
        self.refuse("a run with can.interface = \"memory\" is in virtual time")
    }

    /// Refuses them for the reason `why`.
    pub(super) fn refuse(self, why: &str) -> Result<(), Failure> {
        match self.realtime {
            false => Ok(()),
            true => Err(Failure::Configuration(format!("--realtime: {why}"))),
        }
    }

    /// Checks that this process has the right, on a thread that then ends: threads created later
    /// must not inherit the priority.
    pub(super) fn try_out(self) -> Result<(), Failure> {
        let tried = thread::spawn(move || self.enter()).join();
        tried.map_err(|_| Failure::environment("--realtime: the trial ended in a panic"))?.map(drop)
    }

    /// Gives this thread, the SYNC thread, its real-time priority if asked. Call it after all other
    /// threads have started.
    pub(super) fn enter(self) -> Result<Option<RealTime>, Failure> {
        let entered = self.realtime.then(|| enter_real_time(self.cpu)).transpose();
        entered.map_err(Failure::environment)
    }
}
