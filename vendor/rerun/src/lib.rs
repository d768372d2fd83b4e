//! The SDK as the crate `rerun` shows it, without that crate's store of chunks, its clients for
//! servers and what those need (docs/decisions/0020).

pub use re_chunk::TimeColumn;
pub use re_sdk::*;
pub use re_sdk_types::archetypes::*;
pub use re_sdk_types::components::{Color, FillMode, Radius};
pub use re_sdk_types::datatypes::{Quaternion, Rgba32};
pub use re_sdk_types::{DynamicArchetype, archetypes, components, datatypes};

/// Other crates of rerun's.
pub mod external {
    pub use re_sdk::external::*;
    pub use {arrow, re_build_info, re_sdk_types};
}
