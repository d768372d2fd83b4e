//! Waiting for a socket, to the microsecond: poll(2) counts whole milliseconds, ppoll(2) does not.

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;
use std::io;
use std::os::fd::BorrowedFd;
use std::time::Duration;

/// Waits up to `timeout` until `socket` has something to read, or an error to tell. A signal ends
/// the wait as the time does: the caller looks, and waits for what is left.
pub(super) fn readable(socket: BorrowedFd<'_>, timeout: Duration) -> io::Result<()> {
    let mut sockets = [PollFd::new(socket, PollFlags::POLLIN)];
    match ppoll(&mut sockets, Some(TimeSpec::from_duration(timeout)), None) {
        Ok(_) | Err(Errno::EINTR) => Ok(()),
        Err(error) => Err(error.into()),
    }
}
