//! Origin and quality of the calibrated values in a configuration. The preflight judges their age and the
//! registration's RMS. The fiducials determine how well the tip is known. Nothing else is used.

use super::FiducialPair;
use crate::keys::{Rule, section, within};
use crate::needle::TorsionConfig;

const LENGTH: Rule = within(0.0, 10_000.0);
const STANDARD_ERROR: Rule = within(0.0, 1e6);

section! {
    /// Origin and quality of a computed registration.
    pub struct RegistrationRecord {
        /// Where it came from.
        provenance: Provenance, flat;
        /// Number of fiducials.
        points: u32 [within(3.0, u32::MAX as f64)];
        /// RMS of the remaining distances between the fiducials, mm.
        rms_mm: f64 [LENGTH];
        /// RMS extent of the fiducials along their principal axes, mm.
        spread_mm: [f64; 3] [LENGTH];
        /// `tracker.tool` with which the bench collected the fiducials.
        tool: Option<String>;
        /// `tracker.tip_offset_mm` while the bench collected the fiducials, mm.
        tip_offset_mm: Option<[f64; 3]> [within(-1000.0, 1000.0)];
        /// The fiducials. From them follows how well the tip is known at the depth of a run.
        fiducials: Vec<FiducialPair> [Rule::Fields("tracker_mm, bench_mm")] = [], everywhere;
    }
}

section! {
    /// Where a calibrated value came from.
    pub struct Provenance {
        /// The file it was computed from.
        file: String;
        /// SHA-256 of that file, hex.
        sha256: String;
        /// Version of the bench that computed it.
        version: String;
        /// When, RFC 3339.
        date_utc: String;
    }
}

section! {
    /// Origin and quality of a computed tip offset and tilt.
    pub struct TipRecord {
        /// Where they came from.
        provenance: Provenance, flat;
        /// Number of positions.
        points: u32 [within(1.0, u32::MAX as f64)];
        /// Radius of the circle, mm.
        radius_mm: f64 [LENGTH];
        /// RMS distance of the positions from the circle, mm.
        rms_mm: f64 [LENGTH];
    }
}

section! {
    /// Origin and quality of a calibrated needle. The standard errors are from how
    /// the insertions differ.
    pub struct NeedleRecord {
        /// Where it came from.
        provenance: Provenance, flat;
        /// Number of insertions.
        insertions: u32 [within(1.0, u32::MAX as f64)];
        /// RMS of the tip's recorded roll minus the roll that the torsion predicts, degrees.
        roll_rms_deg: f64 [STANDARD_ERROR];
        /// Standard error of the curvature, per mm.
        curvature_sd_per_mm: f64 [STANDARD_ERROR];
        /// Standard error of `tip_ahead_mm`, mm.
        tip_ahead_sd_mm: f64 [STANDARD_ERROR];
        /// Standard error of the bend axis about the shaft's, degrees.
        bend_axis_sd_deg: f64 [STANDARD_ERROR];
        /// Standard deviation of the torsion's offset from one insertion to the next, degrees.
        offset_spread_deg: f64 [STANDARD_ERROR];
        /// Standard errors of the torsion.
        torsion_sd: TorsionConfig, whole;
    }
}
