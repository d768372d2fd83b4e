//! OpenIGTLink over TCP, both ways: [`Link`] is the bench's end, [`TransformServer`] the
//! tracker's, as the emulated one serves it.
//!
//! Both run as tasks of the tokio runtime they are made in, and end when they are dropped. Either
//! can be used from any thread, one without a runtime too.

mod link;
mod server;

pub use link::{Link, LinkSettings};
pub use server::TransformServer;

#[cfg(test)]
mod tests;
