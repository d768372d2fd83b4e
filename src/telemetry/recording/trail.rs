//! A trail of points that stays small however long the run is.

use super::index::{Index, Moment};
use nalgebra::Vector3;

/// A trail has at most this many points.
const POINTS_MAX: usize = 300;

/// The points gone through so far, thinned out evenly: when they are too many every second one is
/// left out, and from then on only every second new one is taken. So a run of N points makes
/// about `300 + 150 log₂(N/300)` updates of at most 300 points, and not N of up to N.
#[derive(Debug, Default)]
pub(super) struct Trail {
    points: Vec<[f32; 3]>,
    /// Of 2^thinned points, one is taken.
    thinned: u32,
    given: u64,
    index: Index,
    updates: Vec<Vec<[f32; 3]>>,
}

impl Trail {
    /// Goes on to `point_mm`; a point that is not finite is passed over.
    pub(super) fn push(&mut self, moment: Moment, point_mm: &Vector3<f64>) {
        if !point_mm.iter().all(|c| c.is_finite()) {
            return;
        }
        let given = self.given;
        self.given += 1;
        if !given.is_multiple_of(1 << self.thinned) {
            return;
        }
        self.points.push((*point_mm).cast::<f32>().into());
        if self.points.len() == POINTS_MAX {
            let mut n = 0;
            self.points.retain(|_| {
                n += 1;
                n % 2 == 1
            });
            self.thinned += 1;
        }
        self.index.push(moment);
        self.updates.push(self.points.clone());
    }

    /// The states of the trail since the last call, with their moments.
    pub(super) fn take_updates(&mut self) -> (Index, Vec<Vec<[f32; 3]>>) {
        (std::mem::take(&mut self.index), std::mem::take(&mut self.updates))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trail_stays_small_and_evenly_spaced() {
        let mut trail = Trail::default();
        for n in 0..10_000 {
            trail.push(Moment::default(), &Vector3::new(0.0, 0.0, f64::from(n)));
        }
        let (index, updates) = trail.take_updates();
        assert_eq!(index.len(), updates.len());
        assert!(updates.len() < 300 + 150 * 6, "{}", updates.len());
        assert!(updates.iter().all(|u| u.len() < POINTS_MAX));
        for update in &updates {
            let spacing = update.get(1).map_or(1.0, |p| p[2]);
            assert!(update.iter().enumerate().all(|(n, p)| p[2] == n as f32 * spacing));
        }
        assert!(updates.last().and_then(|u| u.last()).is_some_and(|p| p[2] > 9_900.0));
        assert_eq!(trail.take_updates().1.len(), 0);
    }

    #[test]
    fn points_that_are_nowhere_are_passed_over() {
        let mut trail = Trail::default();
        trail.push(Moment::default(), &Vector3::new(0.0, f64::NAN, 0.0));
        assert_eq!(trail.take_updates().1.len(), 0);
    }
}
