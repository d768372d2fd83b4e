//! needle-bench: see `needle-bench --help` and README.md.

use std::process::ExitCode;

fn main() -> ExitCode {
    needle_bench::cli::bench()
}
