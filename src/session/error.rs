//! Why a session cannot start.

use crate::observer::ObserverError;
use thiserror::Error;

/// A configuration that a session cannot start with.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SessionError {
    /// An observer refuses it.
    #[error("observer: {0}")]
    Observer(#[from] ObserverError),
    /// The stage refuses it.
    #[error("stage: {0}")]
    Stage(String),
}
