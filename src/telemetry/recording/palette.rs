//! Colours by meaning, from the palette of Okabe and Ito, which colour-blind readers can distinguish.

use rerun::Color;

/// An estimate.
pub(super) const ESTIMATE: Color = rgba(0x56B4E9FF);
/// The bounds of the estimate.
pub(super) const ESTIMATE_BOUND: Color = rgba(0x3F86ADFF);
/// The truth, which only the emulator knows.
pub(super) const TRUTH: Color = rgba(0x009E73FF);
/// A measured value.
pub(super) const MEASURED: Color = rgba(0xE69F00FF);
/// A commanded value.
pub(super) const COMMANDED: Color = rgba(0xCC79A7FF);
/// The first, second and third of three coordinates.
pub(super) const COORDINATES: [Color; 3] = [rgba(0xD55E00FF), rgba(0xF0E442FF), rgba(0x0072B2FF)];
/// A limit.
pub(super) const LIMIT: Color = rgba(0xD55E00FF);
/// Something is wrong.
pub(super) const FAULT: Color = rgba(0xD55E00FF);
/// Something deserves a look.
pub(super) const WARNING: Color = rgba(0xE69F00FF);
/// As it should be.
pub(super) const GOOD: Color = rgba(0x009E73FF);
/// Out of the needle's reach.
pub(super) const OUT_OF_REACH: Color = rgba(0x0072B2FF);
/// Neither good nor bad.
pub(super) const NEUTRAL: Color = rgba(0x8A8A8AFF);
/// Behind everything in the 3-D view.
pub(super) const BACKGROUND: Color = rgba(0x14171BFF);
/// The plane.
pub(super) const PLANE_SHEET: Color = rgba(0x8A8A8A28);
/// The lines on it.
pub(super) const PLANE_LINES: Color = rgba(0x4A4A4AFF);

/// The colour for a name in `layout.toml`; the neutral one for an unknown name.
pub(super) fn named(name: &str) -> Color {
    match name {
        "estimate" => ESTIMATE,
        "estimate bound" => ESTIMATE_BOUND,
        "truth" => TRUTH,
        "measured" => MEASURED,
        "commanded" => COMMANDED,
        "first" => COORDINATES[0],
        "second" => COORDINATES[1],
        "third" => COORDINATES[2],
        "limit" => LIMIT,
        "good" => GOOD,
        "fault" => FAULT,
        _ => NEUTRAL,
    }
}

const fn rgba(rgba: u32) -> Color {
    Color(rerun::Rgba32(rgba))
}
