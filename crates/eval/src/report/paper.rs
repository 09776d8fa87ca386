//! The paper's own figures: "Adaptive Bridge: A Proxy-Based Decoupling Layer for Mitigating DDS
//! Backpressure in ROS 2", Tables I to IV and the text of section V. No other module of the report contains
//! the paper's figures.

use crate::impairment::Level;

/// A row of Table I, in percent.
pub struct Impaired {
    pub level: Level,
    /// From good to bad, from bad to good, loss in good, loss in bad; `None` in the clean row.
    pub parameters: Option<[f64; 4]>,
    /// The column "Avg loss".
    pub loss_percent: f64,
}

/// Table I, "Gilbert-Elliott Impairment Parameters".
pub const TABLE_I: [Impaired; 4] = [
    Impaired { level: Level::Clean, parameters: None, loss_percent: 0.0 },
    Impaired { level: Level::Mild, parameters: Some([1.0, 15.0, 0.5, 30.0]), loss_percent: 2.3 },
    Impaired { level: Level::Moderate, parameters: Some([3.0, 15.0, 0.5, 40.0]), loss_percent: 7.1 },
    Impaired { level: Level::Strong, parameters: Some([2.0, 10.0, 1.0, 50.0]), loss_percent: 9.2 },
];

/// The loss that the links of the paper's harness applied, by the counters that it saved.
pub const LOSS_AS_RUN_PERCENT: [f64; 4] = [0.0, 28.0, 33.0, 42.0];

/// A row of Table II or III, on Fast DDS.
pub struct Row {
    /// The scenario's name in this harness.
    pub scenario: &'static str,
    /// The scenario's name in the paper.
    pub title: &'static str,
    pub p50_ms: f64,
    pub p95_ms: f64,
    pub rate_hz: f64,
    /// From Table II; for Table III, section V-B gives 0.0 for all.
    pub rate_std_hz: f64,
    /// From Table III.
    pub transitions: Option<u64>,
}

const fn baseline(
    scenario: &'static str,
    title: &'static str,
    p50_ms: f64,
    p95_ms: f64,
    rate: [f64; 2],
) -> Row {
    Row { scenario, title, p50_ms, p95_ms, rate_hz: rate[0], rate_std_hz: rate[1], transitions: None }
}

const fn bridge(
    scenario: &'static str,
    title: &'static str,
    p50_ms: f64,
    p95_ms: f64,
    transitions: u64,
) -> Row {
    Row { scenario, title, p50_ms, p95_ms, rate_hz: 30.0, rate_std_hz: 0.0, transitions: Some(transitions) }
}

/// Table II, "Baseline Results (No Bridge)".
pub const TABLE_II: [Row; 4] = [
    baseline("baseline_clean", "Clean", 0.65, 0.95, [30.0, 0.0]),
    baseline("baseline_mild", "Mild", 0.97, 15_013.0, [21.4, 8.5]),
    baseline("baseline_moderate", "Moderate", 0.97, 11_666.0, [21.4, 8.7]),
    baseline("baseline_strong", "Strong", 1.02, 15_043.0, [19.2, 8.7]),
];

/// Table III, "Bridge Results (Adaptive Bridge Enabled)".
pub const TABLE_III: [Row; 6] = [
    bridge("bridge_clean", "Clean", 1.07, 1.51, 5),
    bridge("bridge_mild", "Mild", 1.09, 1.55, 2),
    bridge("bridge_moderate", "Moderate", 1.10, 1.55, 2),
    bridge("bridge_strong", "Strong", 1.09, 1.55, 2),
    bridge("bridge_toggle", "Toggle", 1.11, 1.57, 9),
    bridge("bridge_ablation", "Ablation", 1.09, 1.57, 0),
];

/// A row of Table IV, "Cross-RMW Validation: Bridge Scenarios".
pub struct CrossRow {
    pub scenario: &'static str,
    pub fast_p99_ms: f64,
    pub cyclone_p99_ms: f64,
    /// The rate with both libraries.
    pub rate_hz: f64,
}

const fn cross(scenario: &'static str, fast_p99_ms: f64, cyclone_p99_ms: f64) -> CrossRow {
    CrossRow { scenario, fast_p99_ms, cyclone_p99_ms, rate_hz: 30.0 }
}

/// Table IV, "Cross-RMW Validation: Bridge Scenarios".
pub const TABLE_IV: [CrossRow; 4] = [
    cross("bridge_clean", 1.7, 1.9),
    cross("bridge_mild", 1.8, 1.9),
    cross("bridge_moderate", 1.8, 1.6),
    cross("bridge_strong", 1.8, 1.6),
];

/// The share of the noncritical bandwidth that the classifier saves, section V-E.
pub const SAVED_PERCENT: f64 = 70.0;

/// The increase of the clean p95 by the bridge, Tables II and III, in milliseconds.
pub const CLEAN_P95_ADDED_MS: f64 = 1.51 - 0.95;

/// The longest time from a toggle to the classifier's reaction, section V-E, in seconds.
pub const REACTION_S: f64 = 20.0;

/// Finds the row of Table II or III of a scenario.
pub fn row(scenario: &str) -> Option<&'static Row> {
    TABLE_II.iter().chain(&TABLE_III).find(|row| row.scenario == scenario)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::impairment::Reading;

    /// The links use the parameters of Table I, and these give the printed loss.
    #[test]
    fn the_links_use_the_parameters_of_table_i() {
        for (row, as_run) in TABLE_I.iter().zip(LOSS_AS_RUN_PERCENT) {
            let printed = row.level.model(Reading::AsPrinted);
            if let Some(percent) = row.parameters {
                let model = [printed.p(), printed.r(), printed.loss_good(), printed.loss_bad()];
                assert!(model.iter().zip(percent).all(|(one, other)| (one * 100.0 - other).abs() < 1e-9));
            }
            assert!((printed.stationary_loss() * 100.0 - row.loss_percent).abs() < 0.06);
            let run = row.level.model(Reading::AsRun);
            assert!((run.stationary_loss() * 100.0 - as_run).abs() < 0.6);
        }
    }

    /// Checks figures that the abstract and the text repeat.
    #[test]
    fn the_tables_agree_with_the_text() {
        let strong = row("baseline_strong").unwrap();
        assert_eq!((strong.p95_ms / row("bridge_strong").unwrap().p95_ms / 100.0).round() * 100.0, 9_700.0);
        let drops: Vec<f64> = TABLE_II[1..].iter().map(|row| (1.0 - row.rate_hz / 30.0) * 100.0).collect();
        assert_eq!((drops[0].round(), drops[2].round()), (29.0, 36.0));
        assert!(TABLE_III.iter().all(|row| row.p95_ms <= 1.57 && row.rate_hz == 30.0));
        assert!((CLEAN_P95_ADDED_MS - 0.56).abs() < 1e-9);
        assert_eq!(row("link_flap").map(|row| row.title), None);
    }
}
