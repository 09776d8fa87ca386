//! Tests of control's policy in virtual time: random links, random overload, the paper's toggled impairment,
//! recorded probe traces, replays and floods. No I/O and no sleeping.

mod classifier;
mod safety;
mod traces;
mod trust;
mod window;

use adaptive_bridge::model::MonotonicNs;
use proptest::prelude::ProptestConfig;
use proptest::test_runner::FileFailurePersistence;

const MS: u64 = 1_000_000;

fn config(cases: u32) -> ProptestConfig {
    let persistence = FileFailurePersistence::WithSource("proptest-regressions");
    ProptestConfig { failure_persistence: Some(Box::new(persistence)), ..ProptestConfig::with_cases(cases) }
}

fn at_ms(ms: u64) -> MonotonicNs {
    MonotonicNs(ms * MS)
}
