//! Colours by meaning: those of the viewer (`telemetry::recording`), adapted to white paper.

/// The observer's estimate.
pub(super) const ESTIMATE: &str = "#56B4E9";
/// The emulator's truth.
pub(super) const TRUTH: &str = "#009E73";
/// Measurements.
pub(super) const MEASURED: &str = "#E69F00";
/// Commands.
pub(super) const COMMANDED: &str = "#CC79A7";
/// The first, second and third coordinate; black replaces the viewer's yellow.
pub(super) const COORDINATES: [&str; 3] = ["#D55E00", "#000000", "#0072B2"];
/// Faults.
pub(super) const FAULT: &str = "#D55E00";
/// Limits and holds: neither good nor bad.
pub(super) const NEUTRAL: &str = "#8A8A8A";
