//! The memory that a configuration may need, from which the limits of the services are made.

use adaptive_bridge::config::{self, Settings};
use adaptive_bridge::process::{MemoryNeed, MemoryNeeds};
use adaptive_bridge::shm::{DEFAULT_BUDGET_BYTES, RouteChannel};

const MIB: u64 = 1 << 20;

fn settings(yaml: &str) -> Settings {
    config::parse(yaml, "the test", &|_| None).unwrap_or_else(|error| panic!("{yaml}: {error}"))
}

fn needs(yaml: &str) -> MemoryNeeds {
    MemoryNeeds::of(&settings(yaml))
}

fn routes(count: usize, more: &str) -> String {
    let route = |number| format!("  - {{id: r{number}, input_topic: /r{number}{more}}}\n");
    format!("topics:\n{}", (0..count).map(route).collect::<String>())
}

/// The need of each process. Lanes come last, because their number varies.
fn all(needs: &MemoryNeeds) -> Vec<MemoryNeed> {
    [vec![needs.ingress, needs.control], needs.lanes.clone()].concat()
}

/// Asserts that no part of a process needs less than with the configuration before.
fn assert_none_shrinks(configurations: impl IntoIterator<Item = String>) {
    let mut before: Option<Vec<MemoryNeed>> = None;
    for yaml in configurations {
        let now = all(&needs(&yaml));
        for (old, new) in before.iter().flatten().zip(&now) {
            for ((name, old), (_, new)) in old.parts().into_iter().zip(new.parts()) {
                assert!(old <= new, "{name} shrinks from {old} to {new} with {yaml}");
            }
            assert!(old.limit_bytes() <= new.limit_bytes());
        }
        before = Some(now);
    }
}

#[test]
fn the_need_grows_with_routes_sample_sizes_windows_depths_and_lanes() {
    assert_none_shrinks((1..=40).map(|count| routes(count, "")));
    let sizes = (0..=26).flat_map(|power| [1_usize << power, (1 << power) + 1, 3 << power]);
    let mut sizes: Vec<usize> = sizes.filter(|size| *size <= 64 << 20).collect();
    sizes.sort_unstable();
    // By default a route of larger samples retains fewer.
    let sized = |size: &usize| routes(2, &format!(", retained_samples: 8, max_sample_bytes: {size}"));
    assert_none_shrinks(sizes.iter().map(sized));
    for lane in ["critical", "noncritical"] {
        let windows = [1, 2, 10, 33, 256, 1_000, 100_000];
        assert_none_shrinks(windows.iter().map(|window| {
            routes(1, ", max_sample_bytes: 100000")
                + &format!("lanes: {{{lane}: {{window_samples: {window}}}}}\n")
        }));
    }
    let depths = [1, 10, 100, 10_000];
    assert_none_shrinks(depths.iter().map(|depth| {
        routes(1, &format!(", qos_overrides: {{input: {{history: KEEP_LAST, depth: {depth}}}}}"))
    }));
    assert_none_shrinks((0..8).map(|taps| routes(1, "") + &format!("shared_memory: {{max_taps: {taps}}}\n")));
    let lanes = |count: usize| (0..count).map(|lane| format!("l{lane}: {{}}")).collect::<Vec<_>>().join(", ");
    assert_none_shrinks((0..8).map(|count| routes(1, "") + &format!("lanes: {{{}}}\n", lanes(count))));
}

#[test]
fn a_need_is_of_the_process_that_has_it() {
    let plain = needs(&routes(1, ""));
    let window =
        needs(&(routes(1, ", max_sample_bytes: 1000") + "lanes: {critical: {window_samples: 100000}}\n"));
    let small = needs(&routes(1, ", max_sample_bytes: 1000"));
    assert!(window.lanes[0].history_bytes > small.lanes[0].history_bytes);
    assert_eq!(
        (window.ingress, window.lanes[1], window.control),
        (small.ingress, small.lanes[1], small.control)
    );
    // Ingress allocates the pools, and a killed one leaves its own.
    let pool = RouteChannel::of(&settings(&routes(1, "")), 0).pool_size().bytes.min(DEFAULT_BUDGET_BYTES);
    assert!(plain.ingress.shared_memory_bytes >= 2 * pool);
    assert!(plain.lanes[0].shared_memory_bytes < pool && plain.control.shared_memory_bytes < pool);
    // Control joins each network once.
    let other = needs(&(routes(1, "") + "lanes: {noncritical: {domain_id: 7}}\n"));
    assert_eq!(other.control.discovery_bytes, 2 * plain.control.discovery_bytes);
    assert_eq!(other.ingress, plain.ingress);
}

#[test]
fn a_limit_is_all_parts_and_a_margin() {
    let plain = needs(&routes(1, ""));
    for need in all(&plain) {
        let sum: u64 = need.parts().iter().map(|(_, bytes)| bytes).sum();
        let margin = (sum - need.shared_memory_bytes) / 4 + 32 * MIB;
        let limit = need.limit_bytes();
        assert!((sum + margin..sum + margin + 16 * MIB).contains(&limit), "{limit}: {need:?}");
        assert_eq!(limit % MIB, 0);
    }
    // As in docs/hardening.md: fragments of 16 samples, for the publishers of each reliability.
    let fragments_mib = |count, more: &str| needs(&routes(count, more)).ingress.fragments_bytes / MIB;
    let reliable = ", qos_overrides: {input: {reliability: RELIABLE}}";
    assert_eq!(fragments_mib(1, ", max_sample_bytes: 1048576"), 2 * 16);
    assert_eq!(fragments_mib(1, &format!(", max_sample_bytes: 1048576{reliable}")), 16);
    assert_eq!(fragments_mib(1, reliable), 128);
    assert_eq!(fragments_mib(1, ""), 2 * 128);
    // All routes together have no more, and each keeps 64 MiB, and 16 MiB that wait for an earlier sample.
    let sixty = needs(&routes(60, "")).ingress;
    assert_eq!((sixty.fragments_bytes / MIB, sixty.waiting_bytes / MIB), (2 * 128, 60 * (64 + 16)));
}
