//! Vectors of numbers as processors have them, and the choice between processors.
//!
//! A kernel is written once, generic over [`Lanes`], and compiled for each of them by [`versions`]. Every product that is
//! added is fused and every sum has a fixed order, so a number does not depend on where in a tile it was computed.

use std::sync::OnceLock;

/// Vectors of one kind of processor.
pub(super) trait Lanes: Copy {
    /// Numbers in a vector.
    const WIDTH: usize;
    /// Pixels of a tile that is two vectors wide; as many sums as registers can hold.
    const TILE: usize;
    /// A vector.
    type Vector: Copy;

    /// The same number in every lane.
    fn splat(x: f32) -> Self::Vector;

    /// # Safety
    /// `at` points to [`Lanes::WIDTH`] numbers.
    #[expect(unsafe_code, reason = "the compiler cannot see that tiles lie within their images")]
    unsafe fn load(at: *const f32) -> Self::Vector;

    /// # Safety
    /// `at` points to room for [`Lanes::WIDTH`] numbers.
    #[expect(unsafe_code, reason = "the compiler cannot see that tiles lie within their images")]
    unsafe fn store(at: *mut f32, x: Self::Vector);

    /// `a b + c` in every lane.
    fn multiply_add(a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector;

    /// `a b + c`.
    fn fused(a: f32, b: f32, c: f32) -> f32;
}

/// Any processor.
#[derive(Clone, Copy)]
pub(super) struct Plain;

#[expect(unsafe_code, reason = "the trait's loads and stores are")]
impl Lanes for Plain {
    const WIDTH: usize = 8;
    const TILE: usize = 4;
    type Vector = [f32; 8];

    #[inline(always)]
    fn splat(x: f32) -> [f32; 8] {
        [x; 8]
    }

    #[inline(always)]
    unsafe fn load(at: *const f32) -> [f32; 8] {
        // SAFETY: the caller's.
        unsafe { at.cast::<[f32; 8]>().read_unaligned() }
    }

    #[inline(always)]
    unsafe fn store(at: *mut f32, x: [f32; 8]) {
        // SAFETY: the caller's.
        unsafe { at.cast::<[f32; 8]>().write_unaligned(x) }
    }

    #[inline(always)]
    fn multiply_add(a: [f32; 8], b: [f32; 8], c: [f32; 8]) -> [f32; 8] {
        let mut sum = c;
        for ((sum, a), b) in sum.iter_mut().zip(a).zip(b) {
            *sum = Self::fused(a, b, *sum);
        }
        sum
    }

    #[inline(always)]
    fn fused(a: f32, b: f32, c: f32) -> f32 {
        // Without an instruction for it, fusing is a slow call.
        if cfg!(any(target_arch = "aarch64", target_feature = "fma")) {
            a.mul_add(b, c)
        } else {
            a * b + c
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::{
        __m256, __m512, _mm256_fmadd_ps, _mm256_loadu_ps, _mm256_set1_ps, _mm256_storeu_ps,
        _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_set1_ps, _mm512_storeu_ps,
    };

    use super::Lanes;

    /// x86-64 with AVX2 and fused multiply-add.
    #[derive(Clone, Copy)]
    pub(in crate::kernels) struct Avx2;

    /// x86-64 with AVX-512.
    #[derive(Clone, Copy)]
    pub(in crate::kernels) struct Avx512;

    macro_rules! lanes {
        ($name:ident, $vector:ty, $width:literal, $tile:literal, $splat:ident, $load:ident, $store:ident, $fma:ident) => {
            #[expect(unsafe_code, reason = "intrinsics of a processor that `level` has found")]
            impl Lanes for $name {
                const WIDTH: usize = $width;
                const TILE: usize = $tile;
                type Vector = $vector;

                #[inline(always)]
                fn splat(x: f32) -> $vector {
                    // SAFETY: `versions` calls this only where the processor has it.
                    unsafe { $splat(x) }
                }

                #[inline(always)]
                unsafe fn load(at: *const f32) -> $vector {
                    // SAFETY: the caller's, and as above.
                    unsafe { $load(at) }
                }

                #[inline(always)]
                unsafe fn store(at: *mut f32, x: $vector) {
                    // SAFETY: the caller's, and as above.
                    unsafe { $store(at, x) }
                }

                #[inline(always)]
                fn multiply_add(a: $vector, b: $vector, c: $vector) -> $vector {
                    // SAFETY: as above.
                    unsafe { $fma(a, b, c) }
                }

                #[inline(always)]
                fn fused(a: f32, b: f32, c: f32) -> f32 {
                    a.mul_add(b, c)
                }
            }
        };
    }
    lanes!(Avx2, __m256, 8, 6, _mm256_set1_ps, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_fmadd_ps);
    lanes!(
        Avx512,
        __m512,
        16,
        12,
        _mm512_set1_ps,
        _mm512_loadu_ps,
        _mm512_storeu_ps,
        _mm512_fmadd_ps
    );
}

/// What this processor has.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Level {
    /// Nothing that matters here.
    Plain,
    /// [`Avx2`].
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// [`Avx512`].
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Level {
    /// Numbers in a vector.
    pub(super) fn width(self) -> usize {
        match self {
            Self::Plain => Plain::WIDTH,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => Avx2::WIDTH,
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => Avx512::WIDTH,
        }
    }
}

/// The best that this processor has.
pub(super) fn level() -> Level {
    static LEVEL: OnceLock<Level> = OnceLock::new();
    *LEVEL.get_or_init(|| {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl") {
                return Level::Avx512;
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                return Level::Avx2;
            }
        }
        Level::Plain
    })
}

/// Defines a function that runs `$body`, generic over [`Lanes`] and always inlined, as compiled for this processor.
macro_rules! versions {
    ($(#[$doc:meta])* $visibility:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?) $(-> $result:ty)? = $body:ident) => {
        $(#[$doc])*
        #[cfg_attr(
            target_arch = "x86_64",
            expect(unsafe_code, reason = "functions for processors that have certain instructions")
        )]
        $visibility fn $name($($argument: $type),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($argument: $type),*) $(-> $result)? {
                $body::<$crate::kernels::lanes::Avx2>($($argument),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
            fn avx512($($argument: $type),*) $(-> $result)? {
                $body::<$crate::kernels::lanes::Avx512>($($argument),*)
            }
            match $crate::kernels::lanes::level() {
                $crate::kernels::lanes::Level::Plain => {
                    $body::<$crate::kernels::lanes::Plain>($($argument),*)
                }
                // SAFETY: `level` has seen that the processor has the instructions.
                #[cfg(target_arch = "x86_64")]
                $crate::kernels::lanes::Level::Avx2 => unsafe { avx2($($argument),*) },
                // SAFETY: as above.
                #[cfg(target_arch = "x86_64")]
                $crate::kernels::lanes::Level::Avx512 => unsafe { avx512($($argument),*) },
            }
        }
    };
}
pub(super) use versions;
