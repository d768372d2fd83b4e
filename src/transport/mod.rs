//! The outside world: sockets and buses. What the bytes mean is decided elsewhere; here they are
//! moved.

pub mod tcp;
