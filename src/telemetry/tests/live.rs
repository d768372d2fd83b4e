//! The live view.

use super::*;
use std::net::{Ipv4Addr, TcpListener};

#[test]
fn a_port_that_is_taken_is_refused_before_the_run() {
    let scratch = Scratch::new("live-taken");
    let taken = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let address = taken.local_addr().unwrap();
    let mut recorder = recorder(&scratch.0, Backpressure::Block);
    let error = recorder.serve(address, &scene()).unwrap_err().to_string();
    assert!(error.starts_with(&format!("--live: {address}: ")), "{error}");
}
