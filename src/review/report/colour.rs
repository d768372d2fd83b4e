//! Colours by meaning: those of the viewer (`telemetry::recording`), adapted to white paper.

use plotters::style::RGBColor;

/// The observer's estimate.
pub(super) const ESTIMATE: RGBColor = RGBColor(0x56, 0xB4, 0xE9);
/// The emulator's truth.
pub(super) const TRUTH: RGBColor = RGBColor(0x00, 0x9E, 0x73);
/// Measurements.
pub(super) const MEASURED: RGBColor = RGBColor(0xE6, 0x9F, 0x00);
/// Commands.
pub(super) const COMMANDED: RGBColor = RGBColor(0xCC, 0x79, 0xA7);
/// The first, second and third coordinate; black replaces the viewer's yellow.
pub(super) const COORDINATES: [RGBColor; 3] =
    [RGBColor(0xD5, 0x5E, 0x00), RGBColor(0x00, 0x00, 0x00), RGBColor(0x00, 0x72, 0xB2)];
/// Faults.
pub(super) const FAULT: RGBColor = RGBColor(0xD5, 0x5E, 0x00);
/// Limits and holds: neither good nor bad.
pub(super) const NEUTRAL: RGBColor = RGBColor(0x8A, 0x8A, 0x8A);

/// `colour` in CSS.
pub(super) fn css(colour: RGBColor) -> String {
    let RGBColor(r, g, b) = colour;
    format!("#{r:02X}{g:02X}{b:02X}")
}
