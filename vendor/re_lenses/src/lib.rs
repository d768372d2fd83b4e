//! What `re_sdk` names of rerun's `re_lenses`, without the functions for MCAP files that need 60
//! more crates (docs/decisions/0020). The bench uses no lens.

use std::sync::{Arc, OnceLock};

pub use re_lenses_core::{
    CastTo, ChunkExt, DeriveLensBuilder, Lens, LensBuilderError, LensError, LensRuntimeError,
    Lenses, MutateLensBuilder, OutputMode, Runtime, Selector, function_registry,
};

/// No functions for lenses.
pub mod op {}

/// A runtime without functions.
pub fn default_runtime() -> Arc<Runtime> {
    static RUNTIME: OnceLock<Arc<Runtime>> = OnceLock::new();
    RUNTIME
        .get_or_init(|| Arc::new(Runtime::new(Arc::new(function_registry::FunctionRegistry::new()))))
        .clone()
}
