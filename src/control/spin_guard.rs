//! A guard against a law that keeps turning the needle in one direction.

use super::{Command, NOT_FINITE};
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// Depth over which the net rotation is limited, mm.
const WINDOW_MM: f64 = 50.0;

/// Net rotation allowed in the window if the observer may not know the roll yet, rad. The law then
/// tries several rolls, and each may be most of a turn away.
pub(super) const SEARCHING_SPIN_RAD: f64 = 3.0 * TAU;

/// The rotation commanded over the last part of the insertion.
#[derive(Debug, Clone, Default)]
pub(super) struct SpinGuard {
    /// Commanded rotation, rad, and its depth, mm, of the steps in the window.
    recent: VecDeque<(f64, f64)>,
}

impl SpinGuard {
    /// The command to turn the base at `wanted_rad_per_mm`, limited to ± `limit_rad_per_mm`.
    ///
    /// # Errors
    /// The rate is not finite, or the net rotation over the window is beyond `spin_limit_rad`.
    pub(super) fn command(
        &mut self,
        wanted_rad_per_mm: f64,
        limit_rad_per_mm: f64,
        step_mm: f64,
        spin_limit_rad: f64,
    ) -> Result<Command, String> {
        if !wanted_rad_per_mm.is_finite() {
            return Err(NOT_FINITE.to_owned());
        }
        let rotation_rad_per_mm = wanted_rad_per_mm.clamp(-limit_rad_per_mm, limit_rad_per_mm);
        self.recent.push_back((rotation_rad_per_mm * step_mm, step_mm));
        let mut window_mm: f64 = self.recent.iter().map(|&(_, depth)| depth).sum();
        while window_mm > WINDOW_MM {
            let Some((_, depth)) = self.recent.pop_front() else { break };
            window_mm -= depth;
        }
        let turned_rad = self.recent.iter().map(|&(turn, _)| turn).sum::<f64>();
        if turned_rad.abs() > spin_limit_rad {
            return Err(format!(
                "the needle was asked to turn {:.0} deg within {window_mm:.0} mm (limit {:.0}): the control law is spinning it",
                turned_rad.to_degrees(),
                spin_limit_rad.to_degrees()
            ));
        }
        let saturated = wanted_rad_per_mm.abs() > limit_rad_per_mm;
        Ok(Command { rotation_rad_per_mm, saturated })
    }
}
