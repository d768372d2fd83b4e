//! CANopen (CiA 301) and the drive profile (CiA 402), both sides, sans-IO.
//!
//! Nothing here uses a socket, a clock or a thread. The machines take frames and the time, and give
//! frames and deadlines.
//!
//! Master side: [`sdo::SdoClient`], [`heartbeat::HeartbeatConsumer`], [`sync::SyncProducer`],
//! [`cia402::EnableSequence`]. Device side, for the emulated drives: [`object_dictionary`] and
//! [`sdo::SdoServer`]. Bytes of either side: [`nmt`], [`emcy`], [`pdo`], [`cob`].

pub mod cia402;
pub mod cob;
pub mod eds;
pub mod emcy;
pub mod frame;
pub mod heartbeat;
pub mod nmt;
pub mod object;
pub mod object_dictionary;
pub mod pdo;
pub mod sdo;
pub mod sync;

pub use frame::{CanId, Frame, NodeId};
pub use object::ObjectAddress;
