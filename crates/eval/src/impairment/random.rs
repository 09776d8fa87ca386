//! Seeded random numbers of a PCG (`rand_pcg`), whose algorithm and seeding are fixed: a seed that is
//! recorded with results gives the same numbers on every machine and in every later version. `fastrand` and
//! the standard generator of `rand` do not guarantee this.

use rand_distr::{Distribution, StandardUniform};
use rand_pcg::Pcg64;
use rand_pcg::rand_core::SeedableRng;

/// Creates the generator that decides which packets are lost.
pub(super) fn of_loss(seed: u64) -> Pcg64 {
    generators(seed).0
}

/// Creates the generator of delays. It is separate, so that delays do not change which packets are lost.
pub(super) fn of_delay(seed: u64) -> Pcg64 {
    generators(seed).1
}

fn generators(seed: u64) -> (Pcg64, Pcg64) {
    let mut root = Pcg64::seed_from_u64(seed);
    (Pcg64::from_rng(&mut root), Pcg64::from_rng(&mut root))
}

/// Decides at random whether an event with this probability happens. It always draws one number, so that
/// models that differ only in their probabilities draw the same numbers.
pub(super) fn happens(random: &mut Pcg64, probability: f64) -> bool {
    let uniform: f64 = StandardUniform.sample(random);
    uniform < probability
}
