//! vcan-stage: the virtual stage as its own process. See `vcan-stage --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    needle_bench::cli::virtual_stage()
}
