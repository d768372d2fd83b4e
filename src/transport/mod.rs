//! The outside world: sockets and buses. Protocols are elsewhere; here bytes are moved.
