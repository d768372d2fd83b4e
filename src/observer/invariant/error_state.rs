//! The error state of a hypothesis, its covariance, and how predict and correct change it.
//!
//! The terms of the torsion model ([`crate::needle::Torsion`]):
//! - lag λ: rotation that the play has passed on to the tip, less the base's rotation;
//! - band: the play keeps λ between a lower and an upper edge; their distance grows with depth;
//! - push: rotation that the play passes on to the tip while an edge of the band holds λ;
//! - anchor: λ where the base last reversed;
//! - backlog: rotation that was pushed but that the tip, which creeps, has not made yet.

use crate::geometry::{Pose, Twist};
use nalgebra::{Matrix3, Matrix6, Vector3};

// Indices into the error state. The first six states are the left-invariant error of the pose, a twist
// (v; w) in the tip frame: `g = ĝ Exp(ε)`. The others are parameters, each as true minus estimated.

/// Rotation about the tip's own axis, rad: the last component of the twist.
pub(super) const ROLL: usize = 5;
/// κ, per mm.
pub(super) const CURVATURE: usize = 6;
/// Backlog: rotation that was pushed and that the tip has not made yet, rad.
pub(super) const BACKLOG: usize = 7;
/// λ, the lag, rad.
pub(super) const LAG: usize = 8;
/// λ where the base last reversed, rad.
pub(super) const ANCHOR: usize = 9;
/// Lower edge of the band at depth 0, rad.
pub(super) const LOWER: usize = 10;
/// Upper edge of the band at depth 0, rad.
pub(super) const UPPER: usize = 11;
/// Growth of the half-width, rad/mm.
pub(super) const GROWTH: usize = 12;
/// Number of states.
pub(super) const STATES: usize = 13;

/// A vector of the error state.
pub(super) type ErrorState = [f64; STATES];

/// How many of the leading states a hypothesis uses. To save time, parameters that are known exactly are
/// omitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Extent {
    /// Pose and curvature: the tip does not creep, and the band, if there is one, is known exactly.
    Rigid,
    /// Pose, curvature and backlog: the tip creeps, and the band, if there is one, is known exactly.
    Creeping,
    /// All states: the band is uncertain.
    Banded,
}

impl Extent {
    /// Number of states.
    fn states(self) -> usize {
        match self {
            Extent::Rigid => CURVATURE + 1,
            Extent::Creeping => BACKLOG + 1,
            Extent::Banded => STATES,
        }
    }
}

/// The transition of the error state over one or several increments.
#[derive(Debug, Clone, Copy)]
pub(super) struct Transition {
    /// Motion of the tip: its pose at the end in its frame at the start.
    pub(super) motion: Pose,
    /// Derivative of the pose error with respect to the error of the curvature.
    pub(super) by_curvature: [f64; 6],
    /// Derivative of the pose error with respect to the error of the backlog.
    pub(super) by_backlog: [f64; 6],
    /// Fraction of the backlog that remains.
    pub(super) backlog_kept: f64,
    /// Effect of an error of the edge's distance from the anchor: state `push_edge` − state `ANCHOR`.
    pub(super) by_edge: PushDerivatives,
    /// Effect of an error of the growth.
    pub(super) by_growth: PushDerivatives,
    /// The edge that pushes: `LOWER` or `UPPER`.
    pub(super) push_edge: usize,
    /// Variance of the push that no state explains, rad².
    pub(super) push_variance: f64,
}

/// Derivatives of pose error, backlog and lag with respect to one error that changes the push.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct PushDerivatives {
    pub(super) pose: [f64; 6],
    pub(super) backlog: f64,
    pub(super) lag: f64,
}

/// Covariance of the error state; symmetric.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Covariance {
    extent: Extent,
    p: [[f64; STATES]; STATES],
}

/// `Ad(g⁻¹)` on the twist (v; w), without the matrix.
pub(super) fn adjoint_inverse(g: &Pose, twist: &[f64; 6]) -> [f64; 6] {
    let r = g.rotation.matrix();
    let [x, y, z] = [g.translation.x, g.translation.y, g.translation.z];
    let [a, b, c, d, e, f] = *twist;
    let v = [a - (y * f - z * e), b - (z * d - x * f), c - (x * e - y * d)];
    let turn = |k: usize, u: [f64; 3]| r[(0, k)] * u[0] + r[(1, k)] * u[1] + r[(2, k)] * u[2];
    let w = [d, e, f];
    [turn(0, v), turn(1, v), turn(2, v), turn(0, w), turn(1, w), turn(2, w)]
}

/// The bracket `ad_ξ τ` of twists (v; w).
pub(super) fn bracket(xi: &Twist, tau: &[f64; 6]) -> [f64; 6] {
    let (v, w) = (Vector3::new(tau[0], tau[1], tau[2]), Vector3::new(tau[3], tau[4], tau[5]));
    let (a, b) = (xi.w.cross(&v) + xi.v.cross(&w), xi.w.cross(&w));
    [a.x, a.y, a.z, b.x, b.y, b.z]
}

impl Covariance {
    pub(super) fn zero(extent: Extent) -> Self {
        Covariance { extent, p: [[0.0; STATES]; STATES] }
    }

    pub(super) fn extent(&self) -> Extent {
        self.extent
    }

    pub(super) fn at(&self, row: usize, column: usize) -> f64 {
        self.p[row][column]
    }

    pub(super) fn set(&mut self, row: usize, column: usize, value: f64) {
        self.p[row][column] = value;
        self.p[column][row] = value;
    }

    pub(super) fn add_variance(&mut self, state: usize, variance: f64) {
        self.p[state][state] += variance;
    }

    /// Moves the covariance to the pose corrected by `delta`, to second order in δ. The remaining
    /// error η becomes `J_r(δ) η` with the right Jacobian of SE(3),
    /// `Exp(−δ) Exp(δ + η) ≈ Exp(J_r(δ) η)` and `J_r(δ) ≈ I − ad_δ/2 + ad_δ²/6`.
    pub(super) fn shift(&mut self, delta: &Twist) {
        self.transform(self.extent.states(), |error| {
            let once = bracket(delta, &std::array::from_fn(|k| error[k]));
            let twice = bracket(delta, &once);
            for k in 0..6 {
                error[k] += twice[k] / 6.0 - 0.5 * once[k];
            }
        });
    }

    /// Replaces P, which has so many states, by J P Jᵀ: `apply` replaces an error vector by J times it.
    fn transform(&mut self, states: usize, apply: impl Fn(&mut ErrorState)) {
        self.p[..states].iter_mut().for_each(&apply);
        for i in 0..states {
            let mut column = std::array::from_fn(|k| self.p[k][i]);
            apply(&mut column);
            for (row, value) in self.p[..states].iter_mut().zip(column) {
                row[i] = value;
            }
        }
    }

    /// Adds process noise of the roll. A turn of the tip reduces the backlog by as much.
    pub(super) fn add_roll_variance(&mut self, variance: f64) {
        self.p[ROLL][ROLL] += variance;
        if self.extent != Extent::Rigid {
            self.p[BACKLOG][BACKLOG] += variance;
            self.p[ROLL][BACKLOG] -= variance;
            self.p[BACKLOG][ROLL] -= variance;
        }
    }

    /// Variance of the sum of `terms`, each a state and its factor.
    pub(super) fn variance_of(&self, terms: &[(usize, f64)]) -> f64 {
        let pairs = terms.iter().flat_map(|a| terms.iter().map(move |b| (a, b)));
        pairs.map(|(&(i, a), &(j, b))| a * b * self.p[i][j]).sum::<f64>().max(0.0)
    }

    /// Makes state `to` a copy of state `from`.
    pub(super) fn copy_state(&mut self, from: usize, to: usize) {
        for i in 0..STATES {
            self.set(to, i, self.p[from][i]);
        }
        self.set(to, to, self.p[from][from]);
        self.set(to, from, self.p[from][from]);
    }

    /// The pose's block.
    pub(super) fn pose(&self) -> Matrix6<f64> {
        Matrix6::from_fn(|i, j| self.p[i][j])
    }

    /// True if every number is finite and no variance is negative.
    pub(super) fn is_sound(&self) -> bool {
        self.p.iter().flatten().all(|v| v.is_finite()) && (0..STATES).all(|i| self.p[i][i] >= 0.0)
    }

    /// Propagates the covariance: `P ← F P Fᵀ`, plus the variance of the push.
    pub(super) fn propagate(&mut self, t: &Transition) {
        match self.extent {
            Extent::Rigid => self.propagate_states::<{ CURVATURE + 1 }>(t),
            Extent::Creeping => self.propagate_states::<{ BACKLOG + 1 }>(t),
            Extent::Banded => self.propagate_states::<STATES>(t),
        }
    }

    fn propagate_states<const N: usize>(&mut self, t: &Transition) {
        self.transform(N, |error| t.apply::<N>(error));
        if t.push_variance > 0.0 {
            // A tip that creeps takes up the push later; any other turns at once.
            let tip = if t.backlog_kept < 1.0 { BACKLOG } else { ROLL };
            self.p[LAG][LAG] += t.push_variance;
            self.p[tip][tip] += t.push_variance;
            self.p[LAG][tip] += t.push_variance;
            self.p[tip][LAG] += t.push_variance;
        }
    }

    /// Covariance of the position, in the tip frame, mm².
    pub(super) fn position(&self) -> Matrix3<f64> {
        Matrix3::from_fn(|i, j| self.p[i][j])
    }

    /// Corrects with the innovation of a position, in the tip frame, `H = [I 0]`; `weight` is the
    /// inverse of the innovation's covariance. Returns the correction of the state.
    pub(super) fn correct(
        &mut self,
        innovation: &Vector3<f64>,
        weight: &Matrix3<f64>,
    ) -> ErrorState {
        match self.extent {
            Extent::Rigid => self.correct_states::<{ CURVATURE + 1 }>(innovation, weight),
            Extent::Creeping => self.correct_states::<{ BACKLOG + 1 }>(innovation, weight),
            Extent::Banded => self.correct_states::<STATES>(innovation, weight),
        }
    }

    fn correct_states<const N: usize>(
        &mut self,
        innovation: &Vector3<f64>,
        weight: &Matrix3<f64>,
    ) -> ErrorState {
        let cross: [[f64; 3]; N] = std::array::from_fn(|i| [0, 1, 2].map(|k| self.p[i][k]));
        let mut delta = [0.0; STATES];
        for i in 0..N {
            let c = cross[i];
            let gain = [0, 1, 2]
                .map(|k| c[0] * weight[(0, k)] + c[1] * weight[(1, k)] + c[2] * weight[(2, k)]);
            delta[i] = gain[0] * innovation.x + gain[1] * innovation.y + gain[2] * innovation.z;
            for (p, c) in self.p[i].iter_mut().zip(&cross) {
                *p -= gain[0] * c[0] + gain[1] * c[1] + gain[2] * c[2];
            }
        }
        delta
    }
}

impl Transition {
    /// The transition without any motion.
    pub(super) fn none() -> Self {
        Transition {
            motion: Pose::identity(),
            by_curvature: [0.0; 6],
            by_backlog: [0.0; 6],
            backlog_kept: 1.0,
            by_edge: PushDerivatives::default(),
            by_growth: PushDerivatives::default(),
            push_edge: LOWER,
            push_variance: 0.0,
        }
    }

    /// Replaces an error vector, of which the first N states count, by F times it.
    pub(super) fn apply<const N: usize>(&self, error: &mut ErrorState) {
        let mut pose = adjoint_inverse(&self.motion, &std::array::from_fn(|i| error[i]));
        for (p, by) in pose.iter_mut().zip(&self.by_curvature) {
            *p += by * error[CURVATURE];
        }
        if N > BACKLOG {
            for (p, by) in pose.iter_mut().zip(&self.by_backlog) {
                *p += by * error[BACKLOG];
            }
            error[BACKLOG] *= self.backlog_kept;
        }
        if N > LAG {
            let edge = error[self.push_edge] - error[ANCHOR];
            for (by, cause) in [(&self.by_edge, edge), (&self.by_growth, error[GROWTH])] {
                for (p, by) in pose.iter_mut().zip(&by.pose) {
                    *p += by * cause;
                }
                error[BACKLOG] += by.backlog * cause;
                error[LAG] += by.lag * cause;
            }
        }
        error[..6].copy_from_slice(&pose);
    }
}
