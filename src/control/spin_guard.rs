//! A guard against a law that turns the needle the same way on and on.

use super::ControlError;
use std::collections::VecDeque;

/// The net rotation is bounded over this depth.
const WINDOW_MM: f64 = 50.0;

/// The rotation commanded of late.
#[derive(Debug, Clone, Default)]
pub(super) struct SpinGuard {
    /// Commanded rotation, rad, and its depth, mm, of the steps in the window.
    recent: VecDeque<(f64, f64)>,
}

impl SpinGuard {
    /// Notes a rotation that is about to be commanded.
    ///
    /// # Errors
    /// [`ControlError::Spinning`] where the net rotation over the window is past `limit_rad`: the
    /// law chases its own error.
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
