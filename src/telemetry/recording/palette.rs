//! Colours by meaning, from the palette of Okabe and Ito, which colour-blind readers tell apart.

use rerun::Color;

/// An estimate.
pub(super) const ESTIMATE: Color = opaque(0x56B4E9);
/// The bounds of the estimate.
pub(super) const ESTIMATE_BOUND: Color = opaque(0x3F86AD);
/// The truth, which only the emulator knows.
pub(super) const TRUTH: Color = opaque(0x009E73);
/// A measured value.
pub(super) const MEASURED: Color = opaque(0xE69F00);
/// A commanded value.
pub(super) const COMMANDED: Color = opaque(0xCC79A7);
/// The first, second and third of three coordinates.
pub(super) const COORDINATES: [Color; 3] = [opaque(0xD55E00), opaque(0xF0E442), opaque(0x0072B2)];
/// A limit.
pub(super) const LIMIT: Color = opaque(0xD55E00);
/// Something is wrong.
pub(super) const FAULT: Color = opaque(0xD55E00);
/// Something deserves a look.
pub(super) const WARNING: Color = opaque(0xE69F00);
/// As it should be.
pub(super) const GOOD: Color = opaque(0x009E73);
/// Out of the needle's reach.
pub(super) const OUT_OF_REACH: Color = opaque(0x0072B2);
/// Neither good nor bad.
pub(super) const NEUTRAL: Color = opaque(0x8A8A8A);
/// Behind everything in the 3-D view.
pub(super) const BACKGROUND: Color = opaque(0x14171B);
/// The plane.
pub(super) const PLANE_SHEET: Color = translucent(0x8A8A8A, 0x28);
/// The lines on it.
pub(super) const PLANE_LINES: Color = opaque(0x4A4A4A);

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

const fn opaque(rgb: u32) -> Color {
    translucent(rgb, 0xFF)
}

const fn translucent(rgb: u32, alpha: u32) -> Color {
    Color(rerun::Rgba32(rgb << 8 | alpha))
}
