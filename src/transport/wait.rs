//! Waiting for a socket. It uses ppoll(2), because poll(2) counts whole milliseconds.

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::time::TimeSpec;
use std::io;
use std::os::fd::BorrowedFd;
use std::time::Duration;

/// Waits up to `timeout` until `socket` has data or an error. A signal ends the wait early; the caller
/// waits again for the rest.
pub(super) fn readable(socket: BorrowedFd<'_>, timeout: Duration) -> io::Result<()> {
    let mut sockets = [PollFd::new(socket, PollFlags::POLLIN)];
    match ppoll(&mut sockets, Some(TimeSpec::from_duration(timeout)), None) {
        Ok(_) | Err(Errno::EINTR) => Ok(()),
        Err(error) => Err(error.into()),
    }
}
