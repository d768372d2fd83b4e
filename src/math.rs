//! The transcendental functions: the same bits on every machine.
//!
//! `f64::sin` and similar methods call the system's C library, whose results differ in the last bit or
//! two between libraries, versions and processors. This module uses the `libm` crate, which computes
//! them by sums and products in Rust. Square root, rounding, remainder and products are exactly defined by
//! IEEE 754, so their methods are used; `powi(2)` is one product. See `docs/decisions/0015`.

pub use libm::{acos, asin, atan2, cos, erfc, exp, expm1 as exp_m1, hypot, log as ln, log10};
pub use libm::{log1p as ln_1p, sin, sincos as sin_cos, tan};

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::ComplexField;

    /// Do not edit the snapshot: recorded runs replay to these bits. At these arguments other libraries differ in
    /// the last bit.
    #[test]
    fn functions_return_the_recorded_bits() {
        let x = [1e-3, 0.1, 0.7, 0.9999, 2.0, 3.7, 41.3, 1e5];
        let one = |f: fn(f64) -> f64| x.map(|x| f(x).to_bits());
        let digest =
            |f: fn(f64) -> f64| one(f).iter().fold(0u64, |sum, bits| sum.rotate_left(7) ^ bits);
        type Function = fn(f64) -> f64;
        let functions: [(&str, Function); 12] = [
            ("sin", sin),
            ("cos", cos),
            ("tan", tan),
            ("asin", |x| asin(1.0 / (1.0 + x))),
            ("acos", |x| acos(1.0 / (1.0 + x))),
            ("atan2", |x| atan2(x, -0.3)),
            ("exp", |x| exp(-x)),
            ("exp_m1", |x| exp_m1(-x)),
            ("ln", ln),
            ("ln_1p", ln_1p),
            ("erfc", |x| erfc(0.1 * x)),
            ("hypot", |x| hypot(x, 0.7)),
        ];
        let text = functions.map(|(name, f)| format!("{name} {:016x}", digest(f))).join("\n");
        insta::assert_snapshot!(text);
        assert_eq!(sin_cos(0.7), (sin(0.7), cos(0.7)));
    }

    /// nalgebra computes rotations by these functions.
    #[test]
    fn nalgebra_returns_the_same_bits() {
        for x in (1..1000).map(|n| 0.01 * f64::from(n)) {
            assert_eq!(ComplexField::sin(x).to_bits(), sin(x).to_bits());
            assert_eq!(ComplexField::cos(x).to_bits(), cos(x).to_bits());
            assert_eq!(ComplexField::ln(x).to_bits(), ln(x).to_bits());
        }
    }
}
