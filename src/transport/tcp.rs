//! Trackers over TCP. [`Link::connect`](super::link::Link::connect) and
//! [`Link::listen`](super::link::Link::listen) are the bench's end, and [`TransformServer`] is the end
//! of an emulated tracker.
//!
//! Both run as tasks of the tokio runtime in which they were made, and end when they are dropped. Any
//! thread can use them.

mod link;
mod server;

pub use server::TransformServer;

#[cfg(test)]
mod tests;
