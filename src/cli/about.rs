//! What the operator has to say of a run, for its record.

use clap::Args;

#[derive(Debug, Default, Args)]
pub(super) struct About {
    /// Who runs it, into the record; without it, record.operator of the configuration.
    #[arg(long, value_name = "NAME")]
    pub(super) operator: Option<String>,
    /// What the needle is inserted into, into the record; without it, record.phantom.
    #[arg(long, value_name = "TEXT")]
    pub(super) phantom: Option<String>,
    /// What is to be remembered of this run, into the record.
    #[arg(long, value_name = "TEXT")]
    pub(super) note: Option<String>,
}
