//! Tests that need neither the host's sockets nor its clock, so all of them run in parallel.

mod architecture;
mod arguments;
mod calibrate;
mod calibrate_needle;
mod calibrate_tracker;
mod can_log_peers;
mod cli;
mod conformance;
mod eds;
mod evaluate;
mod faults;
mod fuzz;
mod kinematics_reference;
mod openigtlink_vectors;
mod paper_figures;
mod plan;
mod planner;
mod real_drives;
mod rehearsal;
mod replay;
mod replay_commands;
mod review;
mod stage_dialogues;
mod stage_drives;
mod stage_operations;
mod steering;
mod study;
#[path = "../support/mod.rs"]
mod support;
mod target;
mod tracker_recording;
mod tracker_sources;
mod without_noise;
