//! Choice of the vector instructions that native kernels use.

use std::env;
use std::sync::OnceLock;

/// Environment variable that limits the instructions.
const VARIABLE: &str = "FLYRIG_VECTORS";

/// Runs `work` compiled for the best vector instructions that the processor has. The work must be inlined into the call to
/// benefit from them.
///
/// `FLYRIG_VECTORS=avx2` leaves AVX-512 out, `FLYRIG_VECTORS=none` leaves all of them out: for tests and benchmarks of other
/// processors. It is read once and limits x86 processors only. Products that a library
/// computes for the networks are not limited.
#[inline]
pub fn vectorized<W: pulp::WithSimd>(work: W) -> W::Output {
    instructions().dispatch(work)
}

/// Returns the value of `FLYRIG_VECTORS` if it is not one that limits the instructions.
#[must_use]
pub fn wrong_vectors_limit() -> Option<String> {
    let value = env::var_os(VARIABLE)?.to_string_lossy().into_owned();
    limited(&value).is_none().then_some(value)
}

fn instructions() -> pulp::Arch {
    static CHOSEN: OnceLock<pulp::Arch> = OnceLock::new();
    *CHOSEN.get_or_init(|| env::var(VARIABLE).ok().and_then(|value| limited(&value)).unwrap_or_default())
}

/// Returns the best instructions within a limit; `None` for an unknown one.
fn limited(limit: &str) -> Option<pulp::Arch> {
    match limit {
        "none" => Some(scalar()),
        "avx2" => Some(without_avx512()),
        _ => None,
    }
}

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
fn scalar() -> pulp::Arch {
    pulp::Arch::Scalar
}

#[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
fn scalar() -> pulp::Arch {
    // Vector instructions belong to the least of these processors.
    pulp::Arch::new()
}

#[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
fn without_avx512() -> pulp::Arch {
    pulp::x86::V3::try_new().map_or_else(scalar, pulp::Arch::V3)
}

#[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
fn without_avx512() -> pulp::Arch {
    pulp::Arch::new()
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Sum<'a>(&'a [f32]);

    impl pulp::NullaryFnOnce for Sum<'_> {
        type Output = f32;

        #[inline(always)]
        fn call(self) -> f32 {
            self.0.iter().sum()
        }
    }

    #[test]
    fn every_limit_computes_the_same_and_others_are_none() {
        let numbers = [1.0, 2.5, -0.5, 4.0];
        for limit in ["avx2", "none"] {
            let sum = limited(limit).map(|instructions| instructions.dispatch(Sum(&numbers)).to_bits());
            assert_eq!(sum, Some(vectorized(Sum(&numbers)).to_bits()), "{limit}");
        }
        assert!(limited("avx3").is_none() && limited("").is_none());
    }
}
