//! Seeded random numbers. PCG by way of `rand_pcg`, as its algorithm and seeding are fixed: a seed that is
//! written down beside results means the same on every machine and in every later version. `fastrand` and
//! the standard generator of `rand` promise neither.

use rand_distr::{Distribution, StandardUniform};
use rand_pcg::Pcg64;
use rand_pcg::rand_core::SeedableRng;

/// The generator that decides which packets are lost.
pub(super) fn of_loss(seed: u64) -> Pcg64 {
    generators(seed).0
}

/// The generator of delays. It is one of its own, so that a delay changes nothing about which packets are
/// lost.
pub(super) fn of_delay(seed: u64) -> Pcg64 {
    generators(seed).1
}

fn generators(seed: u64) -> (Pcg64, Pcg64) {
    let mut root = Pcg64::seed_from_u64(seed);
    (Pcg64::from_rng(&mut root), Pcg64::from_rng(&mut root))
}

/// Whether something of this probability happens. It takes one number whatever the probability is, so that
/// models that differ only in their probabilities see the same numbers.
pub(super) fn happens(random: &mut Pcg64, probability: f64) -> bool {
    let uniform: f64 = StandardUniform.sample(random);
    uniform < probability
}
