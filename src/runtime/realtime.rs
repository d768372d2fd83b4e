//! `--realtime`: gives the SYNC thread a fixed priority above all ordinary threads, memory that is never paged
//! out, and a processor of its own.

use nix::errno::Errno;
use nix::sched::{CpuSet, sched_getaffinity, sched_setaffinity};
use nix::sys::mman::{MlockAllFlags, mlockall};
use nix::sys::prctl::set_timerslack;
use nix::sys::resource::{RLIM_INFINITY, Resource, getrlimit};
use nix::unistd::Pid;
use serde::Serialize;
use std::fs;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Above the interrupt threads of a PREEMPT_RT kernel (50), below the kernel's own housekeeping (99).
const PRIORITY: u8 = 80;
/// A process with this capability may lock any amount of memory (capabilities(7)).
const CAP_IPC_LOCK: u64 = 1 << 14;

/// How the SYNC thread runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct RealTime {
    /// Its priority under SCHED_FIFO.
    pub priority: u8,
    /// The processor it is bound to.
    pub cpu: usize,
}

/// How to give the program the rights that `--realtime` needs.
const RIGHTS: &str = "run as root, or give the program the right: sudo setcap \
    cap_sys_nice,cap_ipc_lock+ep $(which needle-bench), or give the user";

/// Binds the calling thread to processor `cpu`, locks the memory of the process, and gives the thread a
/// real-time priority. Without `cpu` it takes the last processor that this process may use, since the first
/// ones serve most interrupts. Threads that this thread starts later inherit processor and priority, so start
/// all other threads before.
///
/// # Errors
/// This process lacks a right; the message says how to give it. Earlier steps are not undone.
pub fn enter_real_time(cpu: Option<usize>) -> Result<RealTime, String> {
    let cpu = bind(cpu)?;
    lock_memory()?;
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let priority = ThreadPriorityValue::try_from(PRIORITY).map(ThreadPriority::Crossplatform);
    priority
        .and_then(|priority| {
            set_thread_priority_and_policy(thread_native_id(), priority, policy)
                .map_err(|error| error.to_string())
        })
        .map_err(|reason| {
            let limit = soft_limit(Resource::RLIMIT_RTPRIO);
            format!(
                "--realtime: SCHED_FIFO with priority {PRIORITY} is refused: {reason}; {RIGHTS} rtprio \
                 {PRIORITY} in /etc/security/limits.conf (ulimit -r is {limit} now)"
            )
        })?;
    Ok(RealTime { priority: PRIORITY, cpu })
}

/// Reduces the calling thread's timer slack to 1 ns (PR_SET_TIMERSLACK). By default the kernel may wake an
/// ordinary thread 50 µs late, to serve several timers together.
pub(super) fn wake_in_time() {
    if let Err(error) = set_timerslack(1) {
        tracing::debug!("the SYNC thread keeps its timer slack: {error}");
    }
}

fn bind(cpu: Option<usize>) -> Result<usize, String> {
    let this_thread = Pid::from_raw(0);
    let allowed = sched_getaffinity(this_thread).unwrap_or_default();
    let numbers: Vec<usize> =
        (0..CpuSet::count()).filter(|&cpu| allowed.is_set(cpu) == Ok(true)).collect();
    let cpu = cpu.or(numbers.last().copied()).unwrap_or(0);
    let mut only_cpu = CpuSet::new();
    let bound = only_cpu.set(cpu).and_then(|()| sched_setaffinity(this_thread, &only_cpu));
    bound.map(|()| cpu).map_err(|reason| {
        format!(
            "--realtime: cannot bind the SYNC thread to processor {cpu}: {reason}; this process may use \
             {numbers:?}"
        )
    })
}

/// Locks present and future memory. Under a limit (RLIMIT_MEMLOCK) a later allocation would fail in the middle
/// of a run, so a limit is refused here.
fn lock_memory() -> Result<(), String> {
    let limit = soft_limit(Resource::RLIMIT_MEMLOCK);
    let refused = |reason| memory_refused(reason, limit / 1024);
    if limit != RLIM_INFINITY && !may_lock_any_amount() {
        return Err(refused(Errno::EPERM));
    }
    mlockall(MlockAllFlags::MCL_CURRENT | MlockAllFlags::MCL_FUTURE).map_err(refused)
}

/// The message that memory cannot be locked, with the next step.
fn memory_refused(reason: Errno, limit_kb: u64) -> String {
    format!(
        "--realtime: memory cannot be locked: {reason}; {RIGHTS} memlock unlimited in \
         /etc/security/limits.conf (ulimit -l is {limit_kb} kB now)"
    )
}

fn soft_limit(resource: Resource) -> u64 {
    getrlimit(resource).map_or(0, |(soft, _)| soft)
}

/// True if this process has CAP_IPC_LOCK (proc(5)).
fn may_lock_any_amount() -> bool {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    let bits = effective.and_then(|hex| u64::from_str_radix(hex.trim(), 16).ok());
    bits.is_some_and(|bits| bits & CAP_IPC_LOCK != 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_absent_processor_is_refused_with_those_that_exist() {
        let error = std::thread::spawn(|| enter_real_time(Some(CpuSet::count() - 1)));
        let error = error.join().unwrap().unwrap_err();
        let expected = "--realtime: cannot bind the SYNC thread to processor 1023: EINVAL";
        assert!(error.starts_with(expected) && error.contains("this process may use ["), "{error}");
    }

    #[test]
    fn a_refused_memory_lock_names_the_permission_and_the_limit() {
        assert_eq!(
            memory_refused(Errno::EPERM, 8192),
            "--realtime: memory cannot be locked: EPERM: Operation not permitted; run as root, or \
             give the program the right: sudo setcap cap_sys_nice,cap_ipc_lock+ep $(which \
             needle-bench), or give the user memlock unlimited in /etc/security/limits.conf \
             (ulimit -l is 8192 kB now)"
        );
    }
}
