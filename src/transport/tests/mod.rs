//! Helpers that tests of several files share.

pub(crate) mod memory;

use crate::canopen::{CanId, Frame};
use proptest::prelude::*;

/// Any classic frame; a remote frame has a length and no data.
pub(super) fn frames() -> impl Strategy<Value = Frame> {
    let id = prop_oneof![
        (0u16..=0x7FF).prop_map(CanId::Base),
        (0u32..=0x1FFF_FFFF).prop_map(CanId::Extended),
    ];
    let data = prop::collection::vec(any::<u8>(), 0..=8);
    (id, any::<bool>(), data).prop_map(|(id, remote, data)| {
        let data = if remote { vec![0; data.len()] } else { data };
        Frame::from_parts(id, remote, &data).unwrap()
    })
}
