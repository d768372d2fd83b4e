//! CANopen (CiA 301) and the drive profile (CiA 402), both sides, sans-IO.
//!
//! Nothing here touches a socket, a clock or a thread: machines take frames and the time, and
//! give frames and deadlines.

pub mod frame;

pub use frame::{CanId, Frame, NodeId};
