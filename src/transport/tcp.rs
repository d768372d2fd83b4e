//! Trackers over TCP, both ways: [`Link::connect`](super::link::Link::connect) and
//! [`Link::listen`](super::link::Link::listen) are the bench's end, [`TransformServer`] the
//! tracker's, as the emulated one serves it.
//!
//! Both run as tasks of the tokio runtime they are made in, and end when they are dropped. Either
//! can be used from any thread, one without a runtime too.

mod link;
mod server;

pub use server::TransformServer;

#[cfg(test)]
mod tests;
