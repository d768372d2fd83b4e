//! Tells the bench which commit it was built from, where there is a repository to ask.

use std::process::Command;

fn main() {
    println!("cargo:rerun-if-changed=src");
    println!("cargo:rerun-if-changed=.git/HEAD");
    println!("cargo:rerun-if-changed=.git/index");
    let described = Command::new("git").args(["describe", "--always", "--dirty"]).output();
    if let Ok(output) = described
        && output.status.success()
        && let Ok(state) = String::from_utf8(output.stdout)
    {
        println!("cargo:rustc-env=NEEDLE_BENCH_GIT={}", state.trim());
    }
}
