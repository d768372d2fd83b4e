//! A guard against a law that keeps turning the needle in one direction.

use super::ControlError;
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// Depth over which the net rotation is limited, mm.
const WINDOW_MM: f64 = 50.0;

/// Net rotation allowed in the window to a law whose observer may not know the roll yet, rad. The
/// law then tries several rolls, and each may be most of a turn away.
pub(super) const SEARCHING_SPIN_RAD: f64 = 3.0 * TAU;

/// The rotation commanded over the last part of the insertion.
#[derive(Debug, Clone, Default)]
pub(super) struct SpinGuard {
    /// Commanded rotation, rad, and its depth, mm, of the steps in the window.
    recent: VecDeque<(f64, f64)>,
}

impl SpinGuard {
    /// Records a rotation before it is commanded.
    ///
    /// # Errors
    /// [`ControlError::Spinning`] if the net rotation over the window is beyond `limit_rad`.
    pub(super) fn turn(
        &mut self,
        rotation_rad: f64,
        step_mm: f64,
        limit_rad: f64,
    ) -> Result<(), ControlError> {
        self.recent.push_back((rotation_rad, step_mm));
        let mut window_mm: f64 = self.recent.iter().map(|&(_, depth)| depth).sum();
        while window_mm > WINDOW_MM {
            let Some((_, depth)) = self.recent.pop_front() else { break };
            window_mm -= depth;
        }
        let turned_rad = self.recent.iter().map(|&(turn, _)| turn).sum::<f64>();
        if turned_rad.abs() > limit_rad {
            return Err(ControlError::Spinning { turned_rad, window_mm, limit_rad });
        }
        Ok(())
    }
}
