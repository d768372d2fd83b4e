//! Principal axes of a set of points.

use nalgebra::{Matrix3, SymmetricEigen};

/// RMS extents along the principal axes of a covariance, largest first, and the axes as columns in
/// that order.
pub(super) fn principal(covariance: Matrix3<f64>) -> ([f64; 3], Matrix3<f64>) {
    let SymmetricEigen { eigenvalues, eigenvectors } = covariance.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigenvalues[b].total_cmp(&eigenvalues[a]));
    let extents = order.map(|k| eigenvalues[k].max(0.0).sqrt());
    (extents, Matrix3::from_columns(&order.map(|k| eigenvectors.column(k))))
}
