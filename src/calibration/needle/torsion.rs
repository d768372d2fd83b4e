//! Fits the torsion from the recorded rotations of base and tip.

use super::insertion::{ENTRY_MM, RecordedInsertion};
use super::{Part, jackknife_covariance, needle_error};
use crate::keys::Range;
use crate::needle::{Play, Torsion, TorsionConfig};
use nalgebra::{SMatrix, SVector};

/// w₀, w₁, c, L₀, L₁: half-width of the band and its growth with depth, offset, creep and its growth.
const PARAMETERS: usize = 5;
/// Index of the offset. The parameters before it are those of the band.
const OFFSET: usize = 2;
type Parameters = SVector<f64, PARAMETERS>;
type Hessian = SMatrix<f64, PARAMETERS, PARAMETERS>;

/// The start of the fit, and the steps of its numerical derivatives.
const START: [f64; PARAMETERS] = [0.2, 0.002, 0.0, 0.5, 0.002];
const DERIVATIVE_STEP: [f64; PARAMETERS] = [1e-5, 1e-7, 1e-5, 1e-5, 1e-7];
/// A band narrower than this many of its standard errors counts as no band.
const CLEAR_SD: f64 = 2.0;
/// The lower bounds of the parameters: a creep shorter than the distance between rows is no creep.
const MIN: [f64; PARAMETERS] = [0.0, 0.0, f64::NEG_INFINITY, 0.02, 0.0];
const ITERATIONS_MAX: usize = 100;
/// The tip's roll may be this far off the fit, RMS, deg: more is no torsion of a needle, but a wrong recording.
const ROLL_RMS_MAX_DEG: f64 = 45.0;

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

fn undetermined() -> String {
    needle_error(
        "the insertions do not determine the torsion: is rotation_rad in rad, its sign right, are the rows in order, \
         and does the base turn both ways, by more than the tip lags, at several depths?",
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
fn residuals(insertion: &RecordedInsertion, p: &Parameters) -> Result<Vec<f64>, String> {
    // A fit that diverges leaves the range of a needle's torsion.
    let torsion = Torsion::new(config(p)).map_err(|_| undetermined())?;
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

/// The least-squares problem of one insertion, linearised at `p`, and its cost `rᵀr`. Unless it `has_band`, the band's
/// parameters are excluded.
fn linearised(
    p: &Parameters,
    insertion: &RecordedInsertion,
    has_band: bool,
) -> Result<(Part<PARAMETERS>, f64), String> {
    let residuals_at_p = residuals(insertion, p)?;
    let mut columns = Vec::with_capacity(PARAMETERS);
    for (k, &step) in DERIVATIVE_STEP.iter().enumerate() {
        let mut moved = *p;
        moved[k] += step;
        let moved = residuals(insertion, &moved)?;
        let column: Vec<f64> =
            moved.iter().zip(&residuals_at_p).map(|(m, r)| (m - r) / step).collect();
        columns.push(column);
    }
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut part = Part {
        hessian: Hessian::from_fn(|i, j| dot(&columns[i], &columns[j])),
        gradient: Parameters::from_fn(|i, _| dot(&columns[i], &residuals_at_p)),
    };
    if !has_band {
        (0..OFFSET).for_each(|k| exclude(&mut part, k));
    }
    Ok((part, dot(&residuals_at_p, &residuals_at_p)))
}

/// Excludes parameter number `k` from a fit.
fn exclude(part: &mut Part<PARAMETERS>, k: usize) {
    part.hessian.row_mut(k).fill(0.0);
    part.hessian.column_mut(k).fill(0.0);
    part.hessian[(k, k)] = 1.0;
    part.gradient[k] = 0.0;
}

impl TorsionFit {
    /// The least-squares fit to the tip's roll; without a band unless the band is clear.
    pub(super) fn of(insertions: &[RecordedInsertion]) -> Result<Self, String> {
        let fit = Self::fit(insertions, true)?;
        let is_clear = |width: f64, sd: f64| width > CLEAR_SD * sd;
        let TorsionConfig { half_width_rad, half_width_rad_per_mm, .. } = fit.torsion;
        let has_band = is_clear(half_width_rad, fit.sd.half_width_rad)
            || is_clear(half_width_rad_per_mm, fit.sd.half_width_rad_per_mm);
        let fit = if has_band { fit } else { Self::fit(insertions, false)? };
        match fit.fault() {
            None => Ok(fit),
            Some(fault) => Err(needle_error(format!(
                "{fault}: is rotation_rad in rad, and are the rows in the order of the insertion?"
            ))),
        }
    }

    /// The reason why this cannot be a needle's torsion, in words; `None` if it can.
    pub(super) fn fault(&self) -> Option<String> {
        let values = self.torsion.in_keys();
        let outside = TorsionConfig::KEYS.iter().zip(values).find_map(|(key, (name, value))| {
            let Range { low, high, .. } =
                key.kind.range(&key.rule).filter(|range| !range.contains(value))?;
            Some(format!("the torsion fits with {name} = {value:.1} (limits {low} to {high})"))
        });
        let roll_rms_deg = self.roll_rms_rad.to_degrees();
        let roll_is_off = roll_rms_deg > ROLL_RMS_MAX_DEG || roll_rms_deg.is_nan();
        let off = roll_is_off.then(|| {
            format!("the tip's roll is {roll_rms_deg:.0} deg RMS off the fit (limit {ROLL_RMS_MAX_DEG:.0})")
        });
        let sds = self.sd.in_keys().map(|(_, sd)| sd);
        let is_unknown = !(sds.iter().sum::<f64>() + self.offset_spread_rad).is_finite();
        let unknown =
            is_unknown.then(|| "the torsion fits with no finite standard errors".to_owned());
        outside.or(off).or(unknown)
    }

    /// Levenberg-Marquardt iteration within the bounds of the parameters, with or without a band.
    fn fit(insertions: &[RecordedInsertion], has_band: bool) -> Result<Self, String> {
        let linearise = |p: &Parameters| {
            let parts = insertions.iter().map(|insertion| linearised(p, insertion, has_band));
            parts.collect::<Result<Vec<_>, _>>()
        };
        let cost = |parts: &[(Part<PARAMETERS>, f64)]| parts.iter().map(|(_, cost)| cost).sum();
        let mut p = Parameters::from(START);
        if !has_band {
            p.fixed_rows_mut::<OFFSET>(0).fill(0.0);
        }
        let mut parts = linearise(&p)?;
        let (mut damping, mut settled) = (1e-3, false);
        for _ in 0..ITERATIONS_MAX {
            let mut whole = Part { hessian: Hessian::zeros(), gradient: Parameters::zeros() };
            for (part, _) in &parts {
                whole.hessian += part.hessian;
                whole.gradient += part.gradient;
            }
            whole.hessian += Hessian::from_diagonal(&whole.hessian.diagonal()) * damping;
            for k in 0..PARAMETERS {
                // A parameter at its bound must not pass it.
                if p[k] <= MIN[k] && whole.gradient[k] > 0.0 {
                    exclude(&mut whole, k);
                }
            }
            let inverse = whole.hessian.try_inverse().ok_or_else(undetermined)?;
            let mut next = p - inverse * whole.gradient;
            next.iter_mut().zip(MIN).for_each(|(value, min)| *value = value.max(min));
            let tried = linearise(&next)?;
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
        let fitted: Vec<_> = parts.iter().map(|(part, _)| *part).collect();
        let covariance = jackknife_covariance(&fitted).ok_or_else(undetermined)?;
        // Each insertion's own offset, by one Newton step with the other parameters fixed.
        let offsets =
            fitted.iter().map(|part| part.gradient[OFFSET] / part.hessian[(OFFSET, OFFSET)]);
        let n = insertions.len() as f64;
        let spread = (offsets.map(|off| off * off).sum::<f64>() / (n - 1.0)).sqrt();
        let mut count = 0;
        for insertion in insertions {
            count += residuals(insertion, &p)?.len();
        }
        let squares: f64 = cost(&parts);
        Ok(TorsionFit {
            torsion: config(&p),
            sd: config(&covariance.diagonal().map(|variance| variance.max(0.0).sqrt())),
            offset_spread_rad: spread,
            roll_rms_rad: (squares / count.max(1) as f64).sqrt(),
        })
    }
}
