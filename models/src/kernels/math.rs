//! Elementary functions that compile to vectors: no branches, no tables, no calls.

use super::lanes::Lanes;

/// `e^x` for x from -87 to 0 (below, as if it were -87), to about one unit in the last place.
#[inline(always)]
pub(super) fn exp_negative<L: Lanes>(x: f32) -> f32 {
    /// Adding it rounds to whole numbers, which are then the low bits.
    const ROUND: f32 = 12_582_912.0;
    let x = if x < -87.0 { -87.0 } else { x };
    let shifted = L::fused(x, std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    // ln 2 in two parts, so that the remainder is exact.
    let r = L::fused(n, -1.428_606_8e-6, L::fused(n, -0.693_145_75, x));
    // Cephes' polynomial for (e^r - 1 - r) / r².
    let p = L::fused(1.987_569_1e-4, r, 1.398_2e-3);
    let p = L::fused(p, r, 8.333_452e-3);
    let p = L::fused(p, r, 4.166_579_6e-2);
    let p = L::fused(p, r, 1.666_666_5e-1);
    let p = L::fused(p, r, 0.5);
    let p = L::fused(p, r * r, r) + 1.0;
    let power = f32::from_bits((shifted.to_bits() << 23).wrapping_add(1.0f32.to_bits()));
    p * power
}

/// ELU and CELU with alpha 1.
#[inline(always)]
pub(super) fn elu<L: Lanes>(x: f32) -> f32 {
    let negative = exp_negative::<L>(if x > 0.0 { 0.0 } else { x }) - 1.0;
    if x > 0.0 { x } else { negative }
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub(super) fn sigmoid<L: Lanes>(x: f32) -> f32 {
    let e = exp_negative::<L>(-x.abs());
    let smaller = e / (1.0 + e);
    if x < 0.0 { smaller } else { 1.0 - smaller }
}

/// `ln(1 + e)` for e from 0 to 1, by the series of the area tangent.
#[inline(always)]
pub(super) fn ln_1p<L: Lanes>(e: f32) -> f32 {
    let s = e / (2.0 + e);
    let square = s * s;
    let p = L::fused(1.0 / 13.0, square, 1.0 / 11.0);
    let p = L::fused(p, square, 1.0 / 9.0);
    let p = L::fused(p, square, 1.0 / 7.0);
    let p = L::fused(p, square, 1.0 / 5.0);
    let p = L::fused(p, square, 1.0 / 3.0);
    let p = L::fused(p, square, 1.0);
    2.0 * s * p
}

#[cfg(test)]
mod tests {
    use super::{super::lanes::Plain, *};

    #[test]
    fn functions_agree_with_double_precision() {
        for i in -3000..=3000 {
            let x = i as f32 * 0.03;
            let exact = f64::from(x);
            let close = |found: f32, expected: f64, what: &str| {
                let error = (f64::from(found) - expected).abs();
                assert!(error < 2e-7 * expected.abs().max(1e-3), "{what}({x}): {error}");
            };
            if x <= 0.0 && x > -87.0 {
                close(exp_negative::<Plain>(x), exact.exp(), "exp");
                let e = exact.exp() as f32;
                close(ln_1p::<Plain>(e), f64::from(e).ln_1p(), "ln_1p");
            }
            let expected = if exact > 0.0 { exact } else { exact.exp_m1() };
            assert!((f64::from(elu::<Plain>(x)) - expected).abs() < 2e-7 * expected.abs().max(1.0));
            close(sigmoid::<Plain>(x), 1.0 / (1.0 + (-exact).exp()), "sigmoid");
        }
        assert!((elu::<Plain>(-1e9) + 1.0).abs() < 1e-6);
        assert!(elu::<Plain>(f32::NAN).is_nan() && sigmoid::<Plain>(f32::NAN).is_nan());
    }
}
