//! Plain loops, compiled for the widest vectors that the machine has.

/// Runs `op`, whose [`pulp::NullaryFnOnce::call`] and all that it calls are marked `#[inline(always)]`, with AVX-512, AVX2, or what every machine has.
/// The same operations in the same order: the result does not depend on the machine.
pub fn on_widest_vectors<Op: pulp::NullaryFnOnce>(op: Op) -> Op::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(avx512) = pulp::x86::V4::try_new() {
        return avx512.vectorize(op);
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(avx2) = pulp::x86::V3::try_new() {
        return avx2.vectorize(op);
    }
    op.call()
}
