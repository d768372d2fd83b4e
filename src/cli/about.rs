//! The operator's notes on a run, for its record.

use clap::Args;

#[derive(Debug, Default, Args)]
pub(super) struct About {
    /// Who runs it, for the record; by default record.operator of the configuration.
    #[arg(long, value_name = "NAME")]
    pub(super) operator: Option<String>,
    /// What the needle is inserted into, for the record; by default record.phantom.
    #[arg(long, value_name = "TEXT")]
    pub(super) phantom: Option<String>,
    /// A note on this run, for the record.
    #[arg(long, value_name = "TEXT")]
    pub(super) note: Option<String>,
}
