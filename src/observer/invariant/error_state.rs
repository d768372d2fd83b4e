//! The error state of a hypothesis, its covariance, and how predict and correct change it.
//!
//! The terms of the torsion model ([`crate::needle::Torsion`]):
//! - lag λ: rotation that the play has passed on to the tip, less the base's rotation;
//! - band: the play keeps λ between a lower and an upper edge; their distance grows with depth;
//! - push: rotation that the play passes on to the tip while an edge of the band holds λ;
//! - anchor: λ where the base last reversed;
//! - backlog: rotation that was pushed but that the tip, which creeps, has not made yet.

use crate::geometry::{Pose, Twist, so3};
use nalgebra::{Matrix3, Matrix6, Vector3};
use std::array;
use std::ops::Mul;

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

/// A linear map of pose errors, twists (v; w), of the form `v ← A v + B w`, `w ← A w`. Adjoint matrices and
/// Jacobians of SE(3) have this form, and so have their products.
#[derive(Debug, Clone, Copy)]
pub(super) struct PoseMap {
    a: Matrix3<f64>,
    b: Matrix3<f64>,
}

impl PoseMap {
    fn identity() -> Self {
        PoseMap { a: Matrix3::identity(), b: Matrix3::zeros() }
    }

    /// `Ad(g⁻¹)`.
    pub(super) fn adjoint_inverse(g: &Pose) -> Self {
        let a = g.rotation.matrix().transpose();
        PoseMap { a, b: -a * so3::hat(&g.translation) }
    }

    /// The right Jacobian of SE(3) to second order, `J_r(δ) ≈ I − ad_δ/2 + ad_δ²/6`: after the pose is corrected by
    /// δ, the remaining error η becomes `J_r(δ) η`, since `Exp(−δ) Exp(δ + η) ≈ Exp(J_r(δ) η)`.
    pub(super) fn right_jacobian(delta: &Twist) -> Self {
        let (v, w) = (so3::hat(&delta.v), so3::hat(&delta.w));
        PoseMap {
            a: Matrix3::identity() - w * 0.5 + w * w / 6.0,
            b: (w * v + v * w) / 6.0 - v * 0.5,
        }
    }

    /// Maps one twist.
    pub(super) fn times(&self, twist: &[f64; 6]) -> [f64; 6] {
        let [a, b, c, d, e, f] = *twist;
        let w = Vector3::new(d, e, f);
        let (v, w) = (self.a * Vector3::new(a, b, c) + self.b * w, self.a * w);
        [v.x, v.y, v.z, w.x, w.y, w.z]
    }
}

impl Mul for PoseMap {
    type Output = PoseMap;
    fn mul(self, first: PoseMap) -> PoseMap {
        PoseMap { a: self.a * first.a, b: self.a * first.b + self.b * first.a }
    }
}

/// The transition of the error state over a correction of the pose and the increments after it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Transition {
    /// Maps the pose error.
    pub(super) pose: PoseMap,
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
        // Without a short cut, which would cost more than it saves.
        let is_finite = self.p.iter().flatten().fold(true, |all, v| all & v.is_finite());
        is_finite && (0..STATES).all(|i| self.p[i][i] >= 0.0)
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
        // P is symmetric, so F (F P)ᵀ is F P Fᵀ.
        t.apply::<N>(&mut self.p);
        for i in 0..N {
            for j in 0..i {
                (self.p[i][j], self.p[j][i]) = (self.p[j][i], self.p[i][j]);
            }
        }
        t.apply::<N>(&mut self.p);
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
        let position: [[f64; N]; 3] = array::from_fn(|k| array::from_fn(|j| self.p[k][j]));
        let mut delta = [0.0; STATES];
        for i in 0..N {
            let [x, y, z] = [0, 1, 2].map(|k| position[k][i]);
            let gain = |k: usize| x * weight[(0, k)] + y * weight[(1, k)] + z * weight[(2, k)];
            let (gain_x, gain_y, gain_z) = (gain(0), gain(1), gain(2));
            delta[i] = gain_x * innovation.x + gain_y * innovation.y + gain_z * innovation.z;
            for (j, p) in self.p[i][..N].iter_mut().enumerate() {
                *p -= gain_x * position[0][j] + gain_y * position[1][j] + gain_z * position[2][j];
            }
        }
        delta
    }
}

impl Transition {
    /// The transition that changes nothing.
    pub(super) fn none() -> Self {
        Transition {
            pose: PoseMap::identity(),
            by_curvature: [0.0; 6],
            by_backlog: [0.0; 6],
            backlog_kept: 1.0,
            by_edge: PushDerivatives::default(),
            by_growth: PushDerivatives::default(),
            push_edge: LOWER,
            push_variance: 0.0,
        }
    }

    /// Replaces the matrix `m`, of which the first N rows and columns count, by F times it.
    pub(super) fn apply<const N: usize>(&self, m: &mut [[f64; STATES]; STATES]) {
        let row = |i: usize| -> [f64; N] { array::from_fn(|j| m[i][j]) };
        let (v, w, curvature) =
            ([row(0), row(1), row(2)], [row(3), row(4), row(5)], row(CURVATURE));
        let PoseMap { a, b } = &self.pose;
        for k in 0..3 {
            let (a0, a1, a2) = (a[(k, 0)], a[(k, 1)], a[(k, 2)]);
            let (b0, b1, b2) = (b[(k, 0)], b[(k, 1)], b[(k, 2)]);
            let (bent, turned) = (self.by_curvature[k], self.by_curvature[3 + k]);
            for j in 0..N {
                m[k][j] = a0 * v[0][j]
                    + a1 * v[1][j]
                    + a2 * v[2][j]
                    + bent * curvature[j]
                    + b0 * w[0][j]
                    + b1 * w[1][j]
                    + b2 * w[2][j];
                m[3 + k][j] = a0 * w[0][j] + a1 * w[1][j] + a2 * w[2][j] + turned * curvature[j];
            }
        }
        if N > BACKLOG {
            let backlog: [f64; N] = array::from_fn(|j| m[BACKLOG][j]);
            for (row, by) in m.iter_mut().zip(self.by_backlog) {
                (0..N).for_each(|j| row[j] += by * backlog[j]);
            }
            (0..N).for_each(|j| m[BACKLOG][j] *= self.backlog_kept);
        }
        if N > LAG {
            let edge: [f64; N] = array::from_fn(|j| m[self.push_edge][j] - m[ANCHOR][j]);
            let growth: [f64; N] = array::from_fn(|j| m[GROWTH][j]);
            let mut add = |i: usize, by_edge: f64, by_growth: f64| {
                (0..N).for_each(|j| m[i][j] += by_edge * edge[j] + by_growth * growth[j]);
            };
            (0..6).for_each(|i| add(i, self.by_edge.pose[i], self.by_growth.pose[i]));
            add(BACKLOG, self.by_edge.backlog, self.by_growth.backlog);
            add(LAG, self.by_edge.lag, self.by_growth.lag);
        }
    }
}
