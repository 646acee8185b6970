//! Eight f32 lanes on three instruction sets, one source for all kernels.
//!
//! A kernel is a [`SimdKernel`]: its `run` is generic over [`Simd`] and inlined into a function compiled for the
//! instruction set selected at run time. Every operation is IEEE-exact and none is fused, so all three paths give the
//! same bytes.

use std::sync::OnceLock;

/// Which instruction set the kernels run on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    /// What the compiler's baseline target offers.
    Plain,
    /// x86-64 with AVX2.
    Avx2,
    /// x86-64 with AVX-512 F, VL, DQ and BW.
    Avx512,
}

impl Isa {
    /// The widest set this processor has. `SEGWILD_ISA=plain|avx2|avx512` selects another one; a set that the processor
    /// does not have is never used.
    pub fn detect() -> Isa {
        let requested = std::env::var("SEGWILD_ISA").ok().and_then(|name| match name.as_str() {
            "plain" => Some(Isa::Plain),
            "avx2" => Some(Isa::Avx2),
            "avx512" => Some(Isa::Avx512),
            _ => None,
        });
        match requested {
            Some(isa) if isa.available() => isa,
            _ => [Isa::Avx512, Isa::Avx2].into_iter().find(|isa| isa.available()).unwrap_or(Isa::Plain),
        }
    }

    /// [`Isa::detect`], evaluated once per process.
    pub fn detect_once() -> Isa {
        static ISA: OnceLock<Isa> = OnceLock::new();
        *ISA.get_or_init(Isa::detect)
    }

    /// Whether this processor has the set.
    pub fn available(self) -> bool {
        match self {
            Isa::Plain => true,
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => is_x86_feature_detected!("avx2"),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => {
                is_x86_feature_detected!("avx2")
                    && is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512bw")
            }
            #[cfg(not(target_arch = "x86_64"))]
            _ => false,
        }
    }
}

/// Number of lanes.
pub const LANES: usize = 8;

/// Adding and subtracting it rounds to the nearest integer (ties to even), whose low bits it then holds.
const ROUND: f32 = 12_582_912.0;

/// Eight lanes of f32. A value of the implementing type proves that the processor has the instructions.
pub trait Simd: Copy {
    /// Eight numbers.
    type F: Copy;
    /// Eight truth values.
    type M: Copy;

    /// A lane-wise copy of one number.
    fn splat(self, x: f32) -> Self::F;
    /// # Safety
    /// `p` points to eight readable numbers.
    unsafe fn load(self, p: *const f32) -> Self::F;
    /// # Safety
    /// `p` points to eight writable numbers.
    unsafe fn store(self, p: *mut f32, x: Self::F);
    /// `a + b`.
    fn add(self, a: Self::F, b: Self::F) -> Self::F;
    /// `a - b`.
    fn sub(self, a: Self::F, b: Self::F) -> Self::F;
    /// `a b`.
    fn mul(self, a: Self::F, b: Self::F) -> Self::F;
    /// `a / b`.
    fn div(self, a: Self::F, b: Self::F) -> Self::F;
    /// Square root.
    fn sqrt(self, a: Self::F) -> Self::F;
    /// `a < b ? a : b`.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// `a > b ? a : b`.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    /// Absolute value.
    fn abs(self, a: Self::F) -> Self::F;
    /// Lanes where `a >= b`.
    fn ge(self, a: Self::F, b: Self::F) -> Self::M;
    /// Lanes where `a < b`.
    fn lt(self, a: Self::F, b: Self::F) -> Self::M;
    /// Lanes that are in both.
    fn both(self, a: Self::M, b: Self::M) -> Self::M;
    /// `a` where the mask holds, 0 elsewhere.
    fn keep(self, a: Self::F, m: Self::M) -> Self::F;
    /// One bit per lane.
    fn bits(self, m: Self::M) -> u32;
    /// Stores the nearest integers, ties to even; for small numbers.
    fn round(self, a: Self::F, to: &mut [i32; LANES]);
    /// `x * 2^n`, where `n` is the integer that `n + ROUND` holds in its low bits.
    fn scale_exponent(self, x: Self::F, rounded: Self::F) -> Self::F;
    /// Sum of the lanes by a fixed tree: i with i+4, then i+2, then i+1.
    fn sum(self, a: Self::F) -> f32;

    /// Prefetches the memory of a reference that will be read soon.
    #[inline(always)]
    fn prefetch<T>(self, _soon: &T) {}

    /// 0, 1, .. 7.
    #[inline(always)]
    fn iota(self) -> Self::F {
        const IOTA: [f32; LANES] = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];
        // SAFETY: the array has eight numbers.
        unsafe { self.load(IOTA.as_ptr()) }
    }

    /// `2^x` for x in -120..120, to 1e-7 relative (minimax polynomial of degree 5 on [-1/2, 1/2]).
    #[inline(always)]
    fn exp2(self, x: Self::F) -> Self::F {
        const C: [f32; 6] = COEFFICIENTS;
        let rounded = self.add(x, self.splat(ROUND));
        let f = self.sub(x, self.sub(rounded, self.splat(ROUND)));
        // Pairs first (Estrin): half the latency of Horner's chain, which the kernels wait for.
        let f2 = self.mul(f, f);
        let high = self.add(self.splat(C[4]), self.mul(self.splat(C[5]), f));
        let middle = self.add(self.splat(C[2]), self.mul(self.splat(C[3]), f));
        let low = self.add(self.splat(C[0]), self.mul(self.splat(C[1]), f));
        let p = self.add(low, self.mul(f2, self.add(middle, self.mul(f2, high))));
        self.scale_exponent(p, rounded)
    }
}

const COEFFICIENTS: [f32; 6] =
    [1.000000119e+00, 6.931469440e-01, 2.402212024e-01, 5.550713465e-02, 9.675540961e-03, 1.327646896e-03];

/// Work that [`run`] compiles for each instruction set.
pub trait SimdKernel {
    /// What it returns.
    type Out;
    /// The work; implementations are `#[inline(always)]`.
    fn run<S: Simd>(self, s: S) -> Self::Out;
}

/// Runs a kernel on an instruction set. A set that the processor lacks falls back to the plain path.
#[inline]
pub fn run<K: SimdKernel>(isa: Isa, kernel: K) -> K::Out {
    #[cfg(target_arch = "x86_64")]
    {
        match isa {
            // SAFETY: `available` has found the features the function is compiled for.
            Isa::Avx2 if isa.available() => return unsafe { x86::avx2(kernel) },
            // SAFETY: as above.
            Isa::Avx512 if isa.available() => return unsafe { x86::avx512(kernel) },
            _ => {}
        }
    }
    let _ = isa;
    kernel.run(Plain)
}

/// Eight lanes as an array, for any processor.
#[derive(Clone, Copy)]
pub struct Plain;

#[inline(always)]
fn zip(a: [f32; LANES], b: [f32; LANES], f: impl Fn(f32, f32) -> f32) -> [f32; LANES] {
    let mut out = [0.0; LANES];
    for i in 0..LANES {
        out[i] = f(a[i], b[i]);
    }
    out
}

#[inline(always)]
fn test(a: [f32; LANES], b: [f32; LANES], f: impl Fn(f32, f32) -> bool) -> [u32; LANES] {
    let mut out = [0; LANES];
    for i in 0..LANES {
        out[i] = if f(a[i], b[i]) { u32::MAX } else { 0 };
    }
    out
}

impl Simd for Plain {
    type F = [f32; LANES];
    type M = [u32; LANES];

    #[inline(always)]
    fn splat(self, x: f32) -> Self::F {
        [x; LANES]
    }
    #[inline(always)]
    unsafe fn load(self, p: *const f32) -> Self::F {
        // SAFETY: the caller promises eight readable numbers; no alignment is assumed.
        unsafe { p.cast::<[f32; LANES]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(self, p: *mut f32, x: Self::F) {
        // SAFETY: the caller promises eight writable numbers; no alignment is assumed.
        unsafe { p.cast::<[f32; LANES]>().write_unaligned(x) }
    }
    #[inline(always)]
    fn add(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a * b)
    }
    #[inline(always)]
    fn div(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a / b)
    }
    #[inline(always)]
    fn sqrt(self, a: Self::F) -> Self::F {
        a.map(f32::sqrt)
    }
    #[inline(always)]
    fn min(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn abs(self, a: Self::F) -> Self::F {
        a.map(|x| f32::from_bits(x.to_bits() & 0x7fff_ffff))
    }
    #[inline(always)]
    fn ge(self, a: Self::F, b: Self::F) -> Self::M {
        test(a, b, |a, b| a >= b)
    }
    #[inline(always)]
    fn lt(self, a: Self::F, b: Self::F) -> Self::M {
        test(a, b, |a, b| a < b)
    }
    #[inline(always)]
    fn both(self, a: Self::M, b: Self::M) -> Self::M {
        let mut out = [0; LANES];
        for i in 0..LANES {
            out[i] = a[i] & b[i];
        }
        out
    }
    #[inline(always)]
    fn keep(self, a: Self::F, m: Self::M) -> Self::F {
        let mut out = [0.0; LANES];
        for i in 0..LANES {
            out[i] = f32::from_bits(a[i].to_bits() & m[i]);
        }
        out
    }
    #[inline(always)]
    fn bits(self, m: Self::M) -> u32 {
        let mut out = 0;
        for i in 0..LANES {
            out |= (m[i] & 1) << i;
        }
        out
    }
    #[inline(always)]
    fn round(self, a: Self::F, to: &mut [i32; LANES]) {
        for i in 0..LANES {
            to[i] = ((a[i] + ROUND).to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32);
        }
    }
    #[inline(always)]
    fn scale_exponent(self, x: Self::F, rounded: Self::F) -> Self::F {
        let mut out = [0.0; LANES];
        for i in 0..LANES {
            out[i] = f32::from_bits(x[i].to_bits().wrapping_add(rounded[i].to_bits() << 23));
        }
        out
    }
    #[inline(always)]
    fn sum(self, a: Self::F) -> f32 {
        let b = [a[0] + a[4], a[1] + a[5], a[2] + a[6], a[3] + a[7]];
        (b[0] + b[2]) + (b[1] + b[3])
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{LANES, Simd, SimdKernel};
    use std::arch::x86_64::*;

    // Loads and stores go through a packed type: the intrinsics for unaligned access are memory copies, whose
    // checks in builds with debug assertions cost more than the kernels' arithmetic.
    #[derive(Clone, Copy)]
    #[repr(C, packed)]
    struct Unaligned(__m256);

    /// # Safety
    /// The processor has AVX2.
    #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt")]
    pub(super) unsafe fn avx2<K: SimdKernel>(kernel: K) -> K::Out {
        kernel.run(Avx2(()))
    }

    /// # Safety
    /// The processor has AVX2 and AVX-512 F, VL, DQ, BW.
    #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt,avx512f,avx512vl,avx512dq,avx512bw")]
    pub(super) unsafe fn avx512<K: SimdKernel>(kernel: K) -> K::Out {
        kernel.run(Avx512(()))
    }

    /// One 256-bit register. Made only by [`avx2`].
    #[derive(Clone, Copy)]
    pub struct Avx2(());

    /// One 256-bit register and twice as many of them. Made only by [`avx512`].
    #[derive(Clone, Copy)]
    pub struct Avx512(());

    // The same intrinsics serve both: compiled with AVX-512 VL, compares and masks become mask registers.
    macro_rules! registers {
        ($name:ident) => {
            // SAFETY (all blocks below): a value of this type is made only where the processor has AVX2, and the
            // methods are inlined into a function compiled for it.
            impl Simd for $name {
                type F = __m256;
                type M = __m256;

                #[inline(always)]
                fn splat(self, x: f32) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_set1_ps(x) }
                }
                #[inline(always)]
                unsafe fn load(self, p: *const f32) -> __m256 {
                    // SAFETY: see above; the caller promises eight readable numbers.
                    unsafe { (*p.cast::<Unaligned>()).0 }
                }
                #[inline(always)]
                unsafe fn store(self, p: *mut f32, x: __m256) {
                    // SAFETY: see above; the caller promises eight writable numbers.
                    unsafe { *p.cast::<Unaligned>() = Unaligned(x) }
                }
                #[inline(always)]
                fn add(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_add_ps(a, b) }
                }
                #[inline(always)]
                fn sub(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_sub_ps(a, b) }
                }
                #[inline(always)]
                fn mul(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_mul_ps(a, b) }
                }
                #[inline(always)]
                fn div(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_div_ps(a, b) }
                }
                #[inline(always)]
                fn sqrt(self, a: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_sqrt_ps(a) }
                }
                #[inline(always)]
                fn min(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_min_ps(a, b) }
                }
                #[inline(always)]
                fn max(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_max_ps(a, b) }
                }
                #[inline(always)]
                fn abs(self, a: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), a) }
                }
                #[inline(always)]
                fn ge(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_cmp_ps::<_CMP_GE_OQ>(a, b) }
                }
                #[inline(always)]
                fn lt(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_cmp_ps::<_CMP_LT_OQ>(a, b) }
                }
                #[inline(always)]
                fn both(self, a: __m256, b: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_and_ps(a, b) }
                }
                #[inline(always)]
                fn keep(self, a: __m256, m: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe { _mm256_and_ps(a, m) }
                }
                #[inline(always)]
                fn bits(self, m: __m256) -> u32 {
                    // SAFETY: see above.
                    unsafe { _mm256_movemask_ps(m) as u32 }
                }
                #[inline(always)]
                fn prefetch<T>(self, soon: &T) {
                    // SAFETY: see above; a prefetch reads nothing.
                    unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(soon).cast()) }
                }
                #[inline(always)]
                fn round(self, a: __m256, to: &mut [i32; LANES]) {
                    // SAFETY: see above; the array has the size of the register.
                    unsafe {
                        let rounded = _mm256_castsi256_ps(_mm256_cvtps_epi32(a));
                        *to.as_mut_ptr().cast::<Unaligned>() = Unaligned(rounded);
                    }
                }
                #[inline(always)]
                fn scale_exponent(self, x: __m256, rounded: __m256) -> __m256 {
                    // SAFETY: see above.
                    unsafe {
                        let n = _mm256_slli_epi32::<23>(_mm256_castps_si256(rounded));
                        _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(x), n))
                    }
                }
                #[inline(always)]
                fn sum(self, a: __m256) -> f32 {
                    // SAFETY: see above.
                    unsafe {
                        let b = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps::<1>(a));
                        let c = _mm_add_ps(b, _mm_movehl_ps(b, b));
                        _mm_cvtss_f32(_mm_add_ss(c, _mm_shuffle_ps::<1>(c, c)))
                    }
                }
            }
        };
    }
    registers!(Avx2);
    registers!(Avx512);
}
