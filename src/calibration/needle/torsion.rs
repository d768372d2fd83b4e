//! Fits the torsion from the recorded rotations of base and tip.

use super::insertion::{ENTRY_MM, Insertion};
use super::{CalibrationError, covariance, refused};
use crate::needle::{NeedleError, Play, Torsion, TorsionConfig};
use nalgebra::{SMatrix, SVector};

/// w₀, w₁, c, L₀, L₁: band, offset, creep.
const PARAMETERS: usize = 5;
const OFFSET: usize = 2;
type Parameters = SVector<f64, PARAMETERS>;
type Hessian = SMatrix<f64, PARAMETERS, PARAMETERS>;

/// The start of the fit, and the steps of its numerical derivatives.
const START: [f64; PARAMETERS] = [0.2, 0.002, 0.0, 0.5, 0.002];
const DIFFERENCE: [f64; PARAMETERS] = [1e-5, 1e-7, 1e-5, 1e-5, 1e-7];
/// A band narrower than this many of its standard errors counts as no band.
const CLEAR_SD: f64 = 2.0;
/// The lower bounds of the parameters: a creep shorter than the distance of the rows is no creep.
const LEAST: [f64; PARAMETERS] = [0.0, 0.0, f64::NEG_INFINITY, 0.02, 0.0];
const ITERATIONS_MAX: usize = 100;

/// A torsion with its standard errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TorsionFit {
    /// The fit.
    pub torsion: TorsionConfig,
    /// Standard errors of its five parameters.
    pub sd: TorsionConfig,
    /// Standard deviation of the offset from one insertion to the next, rad.
    pub offset_spread_rad: f64,
    /// RMS of the tip's recorded roll minus the roll that this torsion predicts, rad.
    pub roll_rms_rad: f64,
}

fn undetermined() -> CalibrationError {
    refused(
        "the insertions do not determine the shaft's torsion; turn the base both ways, by more than the tip \
         lags, at several depths",
    )
}

fn config(p: &Parameters) -> TorsionConfig {
    TorsionConfig {
        half_width_rad: p[0],
        half_width_rad_per_mm: p[1],
        offset_rad: p[2],
        creep_mm: p[3],
        creep_mm_per_mm: p[4],
    }
}

/// Roll predicted by the torsion `p` minus the recorded roll, at each row of `insertion`.
fn residuals(insertion: &Insertion, p: &Parameters) -> Result<Vec<f64>, NeedleError> {
    let torsion = Torsion::new(config(p))?;
    let (mut play, mut base_rad, mut tip_rad) = (Play::default(), 0.0, 0.0);
    let mut residuals = Vec::with_capacity(insertion.steps.len());
    for step in &insertion.steps {
        play.advance(&torsion, step.base).for_each(drop);
        base_rad += step.base.rotation_rad();
        tip_rad += step.tip_turn_rad;
        if play.insertion_mm() > ENTRY_MM {
            residuals.push(base_rad + play.lag_rad() - tip_rad);
        }
    }
    Ok(residuals)
}

/// `JᵀJ`, `Jᵀr` and `rᵀr` of one insertion.
fn normal(
    insertion: &Insertion,
    p: &Parameters,
) -> Result<(Hessian, Parameters, f64), NeedleError> {
    let at = residuals(insertion, p)?;
    let mut columns = Vec::with_capacity(PARAMETERS);
    for (k, &difference) in DIFFERENCE.iter().enumerate() {
        let mut moved = *p;
        moved[k] += difference;
        let moved = residuals(insertion, &moved)?;
        let column: Vec<f64> = moved.iter().zip(&at).map(|(m, a)| (m - a) / difference).collect();
        columns.push(column);
    }
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    Ok((
        Hessian::from_fn(|i, j| dot(&columns[i], &columns[j])),
        Parameters::from_fn(|i, _| dot(&columns[i], &at)),
        dot(&at, &at),
    ))
}

/// Leaves parameter number `k` out of a fit.
fn hold(hessian: &mut Hessian, k: usize) {
    hessian.row_mut(k).fill(0.0);
    hessian.column_mut(k).fill(0.0);
    hessian[(k, k)] = 1.0;
}

impl TorsionFit {
    /// Least squares of the tip's roll; without a band if none is clear.
    pub(super) fn of(insertions: &[Insertion]) -> Result<Self, CalibrationError> {
        let fit = Self::with(insertions, true)?;
        let clear = |width: f64, sd: f64| width > CLEAR_SD * sd;
        let TorsionConfig { half_width_rad, half_width_rad_per_mm, .. } = fit.torsion;
        let banded = clear(half_width_rad, fit.sd.half_width_rad)
            || clear(half_width_rad_per_mm, fit.sd.half_width_rad_per_mm);
        if banded { Ok(fit) } else { Self::with(insertions, false) }
    }

    /// Levenberg and Marquardt's iteration, kept to what a torsion may be, with or without a band.
    fn with(insertions: &[Insertion], banded: bool) -> Result<Self, CalibrationError> {
        let all = |p: &Parameters| {
            insertions.iter().map(|insertion| normal(insertion, p)).collect::<Result<Vec<_>, _>>()
        };
        let cost = |parts: &[(Hessian, Parameters, f64)]| parts.iter().map(|part| part.2).sum();
        let mut p = Parameters::from(START);
        if !banded {
            p.fixed_rows_mut::<OFFSET>(0).fill(0.0);
        }
        let mut parts = all(&p).map_err(refused)?;
        let (mut damping, mut settled) = (1e-3, false);
        for _ in 0..ITERATIONS_MAX {
            let (mut hessian, mut gradient) = (Hessian::zeros(), Parameters::zeros());
            for (h, g, _) in &parts {
                (hessian, gradient) = (hessian + h, gradient + g);
            }
            hessian += Hessian::from_diagonal(&hessian.diagonal()) * damping;
            // A parameter at its bound that would go below it stays; so does a band that is left out.
            for k in 0..PARAMETERS {
                let held = p[k] <= LEAST[k] && gradient[k] > 0.0;
                if !held && (banded || k >= OFFSET) {
                    continue;
                }
                hold(&mut hessian, k);
                gradient[k] = 0.0;
            }
            let inverse = hessian.try_inverse().ok_or_else(undetermined)?;
            let mut next = p - inverse * gradient;
            next.iter_mut().zip(LEAST).for_each(|(value, least)| *value = value.max(least));
            let tried = all(&next).map_err(refused)?;
            let (before, after): (f64, f64) = (cost(&parts), cost(&tried));
            if after > before {
                damping *= 10.0;
                settled = damping > 1e12;
            } else {
                (p, parts, damping) = (next, tried, (0.1 * damping).max(1e-9));
                settled = before - after <= 1e-9 * before;
            }
            if settled {
                break;
            }
        }
        if !settled {
            return Err(undetermined());
        }
        let mut hessian: Hessian = parts.iter().map(|part| part.0).sum();
        let mut gradients: Vec<Parameters> = parts.iter().map(|part| part.1).collect();
        if !banded {
            (0..OFFSET).for_each(|k| hold(&mut hessian, k));
            gradients.iter_mut().for_each(|g| g.fixed_rows_mut::<OFFSET>(0).fill(0.0));
        }
        let covariance = covariance(&hessian, &gradients).ok_or_else(undetermined)?;
        // Each insertion's own offset, by one Newton step with the other parameters kept.
        let offsets = parts.iter().map(|part| part.1[OFFSET] / part.0[(OFFSET, OFFSET)]);
        let n = insertions.len() as f64;
        let spread = (offsets.map(|off| off * off).sum::<f64>() / (n - 1.0)).sqrt();
        let mut count = 0;
        for insertion in insertions {
            count += residuals(insertion, &p).map_err(refused)?.len();
        }
        let squares: f64 = parts.iter().map(|part| part.2).sum();
        Ok(TorsionFit {
            torsion: config(&p),
            sd: config(&covariance.diagonal().map(|variance| variance.max(0.0).sqrt())),
            offset_spread_rad: spread,
            roll_rms_rad: (squares / count.max(1) as f64).sqrt(),
        })
    }
}
