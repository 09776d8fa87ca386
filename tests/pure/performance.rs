//! The computations of the bench, with invented figures: quantiles, growth, targets, tables and plots; and
//! the pages docs/performance-runs.md and docs/performance.md. Pure: reads files of the project, measures
//! nothing.

use std::collections::BTreeMap;
use std::fs;

use adaptive_bridge_measure::hop::{
    Attempt, Call, Isolation, Large, Latency, Loss, Lossy, Quantiles, Resource, Scale, Soak, SoakSeries,
    Summary, Throughput, figures, fill, large, readme, runs_named, soak_failures,
};
use adaptive_bridge_measure::plot::svg::{WIDTH, text_width};
use adaptive_bridge_measure::statistics::{growth, median, median_interval, quantile};
use support::root;

fn quantiles(p50_us: f64, p999_us: f64) -> Quantiles {
    Quantiles {
        samples: 5_000,
        p50_us: Some(p50_us),
        p99_us: Some(p50_us * 2.0),
        p999_us: Some(p999_us),
        max_us: Some(p999_us * 2.0),
    }
}

fn latency(program: &str, p50_us: f64, hop_us: Option<f64>) -> Latency {
    let mut stages = BTreeMap::new();
    if program == "bridge" {
        stages.insert("shared memory".to_owned(), quantiles(26.0, 90.0));
    }
    Latency {
        scheduling: "other".to_owned(),
        rate_hz: 1_000,
        bytes: 2_948,
        program: program.to_owned(),
        latency: quantiles(p50_us, 900.0),
        from_due: quantiles(p50_us, 950.0),
        repetitions_p50_us: vec![p50_us - 1.0, p50_us + 1.0],
        hop_p50_us: hop_us,
        stages,
        ..Latency::default()
    }
}

/// A run that has something of every section.
fn made_up() -> Summary {
    let resource = |program: &str, process: &str, cpu_ms: f64| Resource {
        program: program.to_owned(),
        process: process.to_owned(),
        rate_hz: 1_000,
        seconds: 5.0,
        samples: 5_000,
        cpu_ms,
        sleeps: 10_000,
        rss_kib: 20_480,
        ..Resource::default()
    };
    let isolation = |condition: &str, against: &str, rounds_p999_us: [f64; 6]| Isolation {
        scheduling: "fifo".to_owned(),
        condition: condition.to_owned(),
        against: against.to_owned(),
        rate_hz: 1_000,
        missing: 2,
        reasons: BTreeMap::from([("critical queue_overflow".to_owned(), 2)]),
        // One round decides over this, and over nothing else.
        latency: quantiles(200.0, 48_000.0),
        rounds_p999_us: rounds_p999_us.to_vec(),
        ..Isolation::default()
    };
    let scale = |of: &str, count: usize, program: &str, p50_us: f64| Scale {
        of: of.to_owned(),
        count,
        program: program.to_owned(),
        rate_hz: 640,
        latency: quantiles(p50_us, 800.0),
        repetitions_p50_us: vec![p50_us],
        cpu_us_per_sample: BTreeMap::from([("ingress".to_owned(), 50.0 + count as f64)]),
        rss_kib: BTreeMap::from([("ingress".to_owned(), 10_240)]),
        ..Scale::default()
    };
    Summary {
        date: "2026-01-02T03-04-05Z".to_owned(),
        latency: vec![
            latency("wake-up", 20.0, None),
            latency("direct", 100.0, None),
            latency("relay", 180.0, Some(80.0)),
            latency("bridge", 176.0, Some(76.0)),
        ],
        loss: vec![Loss {
            scheduling: "other".to_owned(),
            rate_hz: 5_000,
            bytes: 2_948,
            program: "bridge".to_owned(),
            accepted: 50_000,
            received: 49_998,
            lost: 2,
            drops: BTreeMap::from([("critical queue_overflow".to_owned(), 2)]),
            whole: Some(true),
            ..Loss::default()
        }],
        throughput: ["direct", "bridge"]
            .map(|program| Throughput {
                bytes: 2_948,
                program: program.to_owned(),
                rate_hz: Some(if program == "direct" { 20_000.0 } else { 10_000.0 }),
                limit: "12000 Hz: 7 lost".to_owned(),
                attempts: vec![Attempt { rate_hz: 12_000.0, failure: Some("7 lost".to_owned()) }],
                ..Throughput::default()
            })
            .to_vec(),
        resources: vec![
            resource("relay", "relay", 500.0),
            resource("relay", "publisher", 9_000.0),
            resource("bridge", "ingress", 400.0),
            resource("bridge", "critical", 300.0),
            resource("bridge", "control", 100.0),
        ],
        calls: vec![Call {
            program: "bridge".to_owned(),
            process: "ingress".to_owned(),
            rate_hz: 100,
            call: "recvfrom".to_owned(),
            count: 1_500,
            samples: 500,
        }],
        scale: vec![
            scale("routes", 1, "bridge", 100.0),
            scale("routes", 5, "bridge", 108.0),
            scale("lanes", 1, "bridge", 100.0),
            scale("lanes", 3, "bridge", 100.0),
        ],
        isolation: vec![
            isolation("undisturbed", "undisturbed", [500.0; 6]),
            isolation("stopped", "undisturbed", [540.0; 6]),
            isolation("spinning", "undisturbed", [600.0; 6]),
            isolation("killed", "undisturbed", [500.0, 510.0, 520.0, 520.0, 550.0, 48_000.0]),
            isolation("repeat", "undisturbed", [700.0; 6]),
        ],
        soak: Some(Soak {
            seconds: 3_600.0,
            load: "1 kHz of 2,948 B".to_owned(),
            accepted: 3_600_000,
            missing: 7,
            reasons: BTreeMap::from([("critical queue_overflow".to_owned(), 7)]),
            series: vec![series("ingress", 0.0, 3_600.0), series("critical", 1.0, 3_600.0)],
            lossy: vec![Lossy { at_s: 72.4, missing: 7, held_up_ms: 84.2 }],
            held_up_ms: Some(12.3),
        }),
        ..Summary::default()
    }
}

/// A run of the section `large` with one library: every size, the small samples, and the stock buffers. The
/// bridge's hop is a fifth of the relay's, its CPU time four fifths.
fn large_rows(library: &str) -> Vec<Large> {
    let sweep = large::SIZES.map(|bytes| (large::RATE_HZ, bytes, false));
    let small = large::SMALL.map(|(rate_hz, bytes)| (rate_hz, bytes, false));
    let stock = [1 << 18, 1 << 20, 4 << 20].map(|bytes| (large::RATE_HZ, bytes, true));
    let cases = sweep.into_iter().chain(small).chain(stock);
    let row = |(rate_hz, bytes, stock_buffers): (u64, usize, bool),
               (program, hop_us, cpu_us): (&str, f64, f64)| {
        let kib = bytes as f64 / 1024.0;
        Large {
            library: library.to_owned(),
            rate_hz,
            bytes,
            program: program.to_owned(),
            stock_buffers,
            accepted: 180,
            latency: quantiles(300.0 + kib + hop_us, 900.0),
            // The latency of direct differs from repetition to repetition.
            repetitions_p50_us: (0..6).map(|at| 300.0 + kib + f64::from(at) + hop_us).collect(),
            repetitions_cpu_us: vec![cpu_us; 6],
            ..Large::default()
        }
    };
    let programs = [("direct", 0.0, 500.0), ("relay", 500.0, 1_000.0), ("bridge", 100.0, 800.0)];
    cases.flat_map(|case| programs.map(|program| row(case, program))).collect()
}

/// The row of a size between programs of the library.
fn large_row<'a>(rows: &'a mut [Large], bytes: usize, program: &str, stock_buffers: bool) -> &'a mut Large {
    let is_it = |row: &&mut Large| {
        (row.rate_hz, row.bytes) == (large::RATE_HZ, bytes)
            && row.program == program
            && row.stock_buffers == stock_buffers
    };
    rows.iter_mut().find(is_it).unwrap()
}

/// Memory that grows by so many KiB a second.
fn series(name: &str, kib_per_second: f64, seconds: f64) -> SoakSeries {
    let points = (0..=100).map(|point| {
        let at_s = seconds * f64::from(point) / 100.0;
        // An outlier in every 17th point, as a program that reads the memory causes.
        let outlier = if point % 17 == 0 { 3_000.0 } else { 0.0 };
        (at_s, 20_000.0 + at_s * kib_per_second + outlier)
    });
    SoakSeries { name: name.to_owned(), unit: "KiB".to_owned(), points: points.collect() }
}

fn line<'a>(text: &'a str, words: &str) -> &'a str {
    text.lines()
        .find(|line| line.contains(words))
        .unwrap_or_else(|| panic!("no line with {words} in:\n{text}"))
}

/// The cells of a line of a table, without their padding.
fn cells(text: &str, words: &str) -> Vec<String> {
    line(text, words).trim_matches('|').split('|').map(|cell| cell.trim().to_owned()).collect()
}

#[test]
fn quantiles_are_of_the_nearest_rank() {
    let thousand: Vec<f64> = (1..=1_000).rev().map(f64::from).collect();
    assert_eq!(
        [0.0, 0.5, 0.99, 0.999, 1.0].map(|share| quantile(&thousand, share)),
        [1.0, 500.0, 990.0, 999.0, 1_000.0]
    );
    assert_eq!(quantile(&[7.0, f64::NAN], 0.5), 7.0);
    assert!(quantile(&[], 0.5).is_nan() && median(&[f64::NAN]).is_nan());
    assert_eq!([median(&[3.0, 1.0, 2.0]), median(&[4.0, 1.0, 2.0, 3.0])], [2.0, 2.5]);
}

#[test]
fn a_tail_quantile_of_too_few_samples_is_not_printed() {
    let of = |count: u32| Quantiles::of(&(0..count).map(f64::from).collect::<Vec<_>>());
    assert_eq!((of(0).p50_us, of(0).max_us), (None, None));
    assert_eq!((of(99).p99_us, of(99).max_us), (None, Some(98.0)));
    assert_eq!((of(999).p99_us, of(999).p999_us), (Some(989.0), None));
    assert_eq!(of(1_000).p999_us, Some(998.0));
}

#[test]
fn the_median_lies_between_the_values_that_tables_of_the_sign_test_name() {
    let values = |count: usize| (1..=count).map(|value| value as f64).collect::<Vec<_>>();
    let interval = |count| median_interval(&values(count));
    assert_eq!([0, 1, 5].map(interval), [None; 3]);
    assert_eq!(interval(6), Some((1.0, 6.0)));
    assert_eq!(interval(9), Some((2.0, 8.0)));
    assert_eq!(interval(20), Some((6.0, 15.0)));
    assert_eq!(interval(50), Some((18.0, 33.0)));
}

#[test]
fn growth_is_not_moved_by_outliers() {
    let slope = |kib_per_second: f64| growth(&series("", kib_per_second, 3_600.0).points).unwrap().slope;
    assert!(slope(0.0).abs() < 1e-9);
    assert!((slope(0.5) - 0.5).abs() < 0.01, "{}", slope(0.5));
    assert!((slope(-2.0) + 2.0).abs() < 0.02);
    assert_eq!(growth(&[(0.0, 1.0), (1.0, 2.0)]), None);
    // More points than the estimate uses.
    let many: Vec<(f64, f64)> = (0..5_000).map(|at| (f64::from(at), 3.0 * f64::from(at))).collect();
    assert_eq!(growth(&many).map(|growth| growth.slope), Some(3.0));
}

#[test]
fn the_interval_of_a_growth_is_that_of_sen() {
    let points: Vec<(f64, f64)> = [0.0, 1.0, 4.0, 9.0, 16.0, 25.0, 36.0]
        .into_iter()
        .enumerate()
        .map(|(at, value)| (at as f64, value))
        .collect();
    let growth_of_squares = growth(&points).unwrap();
    // The slope between the points i and j of the squares is i + j. Kendall's statistic has the variance
    // 7 * 6 * 19 / 18 = 44.3, so the ranks are (21 - 13.05) / 2 = 3 and (21 + 13.05) / 2 + 1 = 18.
    let mut slopes: Vec<usize> = (0..7).flat_map(|one| (one + 1..7).map(move |other| one + other)).collect();
    slopes.sort_unstable();
    assert_eq!((growth_of_squares.low, growth_of_squares.high), (slopes[2] as f64, slopes[17] as f64));
    assert_eq!(growth_of_squares.slope, slopes[10] as f64);
    let of_noise = |slope: f64| {
        let noise = (0..100).map(|at| (f64::from(at), f64::from(at * 7919 % 101) + slope * f64::from(at)));
        growth(&noise.collect::<Vec<_>>()).unwrap()
    };
    let flat = of_noise(0.0);
    assert!(flat.low < 0.0 && flat.high > 0.0, "{flat:?}");
    assert!(of_noise(1.0).low > 0.0);
}

#[test]
fn memory_is_judged_by_its_slope_if_the_interval_is_narrow_enough() {
    let judged = |kib_per_second: f64, seconds: f64| {
        let soak = Soak { series: vec![series("ingress", kib_per_second, seconds)], ..Soak::default() };
        let summary = Summary { soak: Some(soak), ..Summary::default() };
        let readme = readme(&summary);
        let word = cells(&readme, "| ingress").pop().unwrap();
        (word, soak_failures(&summary).len())
    };
    assert_eq!(judged(0.0, 3_600.0), ("flat".to_owned(), 0));
    // 0.2 KiB/s are 720 KiB in an hour, 0.4 KiB/s 1,440.
    assert_eq!(judged(0.2, 3_600.0), ("grows slowly".to_owned(), 0));
    assert_eq!(judged(0.4, 3_600.0), ("**grows**".to_owned(), 1));
    // In a minute even 4 KiB/s are less than an allocator takes at once.
    assert_eq!(judged(4.0, 60.0), ("too short to tell".to_owned(), 0));
    assert_eq!(judged(40.0, 60.0), ("**grows**".to_owned(), 1));
    let lost = Summary { soak: Some(Soak { missing: 3, ..Soak::default() }), ..Summary::default() };
    assert_eq!(soak_failures(&lost), ["3 samples are missing"]);
    let readme = readme(&made_up());
    assert!(
        readme.contains("samples, missing: 7 (critical queue_overflow 7)."),
        "what became of them: {readme}"
    );
    let delays = "Longest delay of a CPU within 100 ms: 84.2 ms in the period until 72 s, in which 7 samples are \
                  missing; up to 12.3 ms in periods without missing samples.";
    assert!(readme.contains(delays), "the CPU delays: {readme}");
}

#[test]
fn targets_are_met_or_missed() {
    let readme = readme(&made_up());
    let row = |words: &str| {
        let cells = cells(&readme, words);
        (cells[2].clone(), cells[3].clone())
    };
    let met = |value: &str| (value.to_owned(), "met".to_owned());
    let missed = |value: &str| (value.to_owned(), "**missed**".to_owned());
    assert_eq!(row("hop of the bridge / hop of the relay, 1000 Hz"), met("0.95"));
    assert_eq!(row("hop of the bridge, 1000 Hz"), missed("76.0 µs"));
    assert_eq!(row("shared memory / eventfd wake-up, 1000 Hz"), met("1.30"));
    assert_eq!(row("bridge: lost or refused at 5000 Hz"), missed("2.00"));
    // 800 of 500: the publisher's CPU is not the relay's.
    assert_eq!(row("CPU of all processes of the bridge"), missed("1.60"));
    assert_eq!(row("noncritical lane stopped / undisturbed"), met("1.08 (1.08 to 1.08)"));
    assert_eq!(row("noncritical lane spinning / undisturbed"), missed("1.20 (1.20 to 1.20)"));
    let unknown = ("1.04 (1.00 to 96.0)".to_owned(), "not known".to_owned());
    assert_eq!(row("noncritical lane killed / undisturbed"), unknown);
    assert!(!readme.contains("noncritical lane repeat / undisturbed"), "what is no target is one");
    assert_eq!(row("growth of the memory of ingress"), met("0.00 (0.00 to 0.00) KiB/h"));
    assert_eq!(row("growth of the memory of critical").1, "**missed**");
    // A case that was not measured has no target.
    assert!(!readme.contains("100 Hz of 2,948 B, other"));
}

#[test]
fn a_hop_of_many_repetitions_is_met_or_missed_only_when_that_is_certain() {
    let judged = |bridge_us: [f64; 9]| {
        let row = |program: &str, each: Vec<f64>| Latency {
            repetitions_p50_us: each,
            ..latency(program, 100.0, Some(0.0))
        };
        let relay = (0..9).map(|at| 300.0 + f64::from(at)).collect();
        let direct = (0..9).map(|at| 200.0 + f64::from(at)).collect();
        let bridge = bridge_us.iter().zip(0..).map(|(us, at)| us + 200.0 + f64::from(at)).collect();
        let rows = vec![row("direct", direct), row("relay", relay), row("bridge", bridge)];
        let readme = readme(&Summary { latency: rows, ..Summary::default() });
        let cells = cells(&readme, "hop of the bridge / hop of the relay, 1000 Hz");
        (cells[2].clone(), cells[3].clone())
    };
    let expected = |value: &str, met: &str| (value.to_owned(), met.to_owned());
    let met = judged([150.0, 20.0, 98.0, 97.0, 96.0, 95.0, 94.0, 93.0, 92.0]);
    assert_eq!(met, expected("0.95 (0.92 to 0.98)", "met"));
    let unknown = judged([150.0, 20.0, 101.0, 97.0, 96.0, 95.0, 94.0, 93.0, 92.0]);
    assert_eq!(unknown, expected("0.95 (0.92 to 1.01)", "not known"));
    let missed = judged([190.0, 20.0, 109.0, 108.0, 107.0, 106.0, 105.0, 104.0, 103.0]);
    assert_eq!(missed, expected("1.06 (1.03 to 1.09)", "**missed**"));
}

#[test]
fn the_targets_of_large_samples_are_judged_by_library_and_size() {
    let mut rows = large_rows("Fast DDS");
    // 4 MiB: a hop that is certain to be too high, CPU time that is not, and losses, all of them named.
    large_row(&mut rows, 4 << 20, "bridge", false).repetitions_p50_us.iter_mut().for_each(|us| *us += 301.0);
    large_row(&mut rows, 4 << 20, "bridge", false).repetitions_cpu_us =
        vec![880.0, 910.0, 880.0, 880.0, 880.0, 890.0];
    for bytes in [1 << 20, 4 << 20] {
        let row = large_row(&mut rows, bytes, "bridge", true);
        row.missing = 3;
        row.reasons = BTreeMap::from([("ingress lost_upstream".to_owned(), 3)]);
    }
    rows.extend(large_rows("Cyclone DDS"));
    let last = rows.len() - 1;
    (rows[last].missing, rows[last].reasons) = (3, BTreeMap::from([("critical no_reader".to_owned(), 2)]));
    let readme = readme(&Summary { large: rows, ..Summary::default() });
    let table = readme.split("## Large samples").nth(1).unwrap();
    let of_fast = table.split("| Cyclone DDS").next().unwrap();
    let ratio = "0.20 (0.20 to 0.20)";
    assert_eq!(
        cells(of_fast, "hop over the relay's")[..5],
        [
            "Fast DDS",
            "hop over the relay's",
            "0.20 (0.20 to 0.20), limit 0.50: met",
            "0.20 (0.20 to 0.20), limit 0.25: met",
            "0.80 (0.80 to 0.80), limit 0.25: **missed**"
        ]
    );
    // Small samples have no target.
    assert_eq!(cells(of_fast, "hop over the relay's")[5..], [ratio, ratio]);
    assert_eq!(
        cells(of_fast, "| hop, µs")[2..5],
        [
            "100 (100 to 100)",
            "100 (100 to 100), limit 200: met, aim 100: met",
            "401 (401 to 401), limit 300: **missed**"
        ]
    );
    assert_eq!(cells(of_fast, "CPU over the relay's")[4], "0.88 (0.88 to 0.91), limit 0.90: not known");
    assert_eq!(
        cells(of_fast, "lost with 208 KiB buffers")[2..5],
        [
            "0 of 180: met",
            "3 (ingress lost_upstream 3) of 180: **missed**, each named",
            "3 (ingress lost_upstream 3) of 180: met, each named"
        ]
    );
    let of_cyclone = table.split("| Cyclone DDS").nth(1).unwrap();
    let lost = cells(of_cyclone, "lost with 208 KiB buffers")[4].clone();
    assert_eq!(lost, "3 (critical no_reader 2) of 180: **missed**", "one is not named");
    assert_eq!(
        cells(table, "| Cyclone DDS, 30 Hz of 8 MiB, relay")[5..7],
        ["500 (500 to 500)", "1,000 (1,000 to 1,000)"]
    );
    // Half a run.
    let rows = large_rows("RustDDS").into_iter().filter(|row| !row.stock_buffers && row.program != "relay");
    let readme = self::readme(&Summary { large: rows.collect(), ..Summary::default() });
    assert_eq!(cells(&readme, "| RustDDS  ")[2..5], ["–", "–", "–"]);
    assert_eq!(cells(&readme, "lost with 208 KiB buffers")[2], "–");
}

#[test]
fn the_plot_of_sizes_has_a_panel_for_hops_and_one_for_cpu_time() {
    let rows = [large_rows("Fast DDS"), large_rows("RustDDS")].concat();
    let mut summary = Summary { large: rows, ..Summary::default() };
    // A hop that is lost in the noise has no place on the axis.
    large_row(&mut summary.large, 1 << 10, "bridge", false).repetitions_p50_us = vec![200.0; 6];
    let files = figures(&summary);
    let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["large-fast-dds.svg", "large-rustdds.svg"]);
    let document = roxmltree::Document::parse(&files[0].1).unwrap();
    let texts = || document.descendants().filter(|node| node.tag_name().name() == "text");
    let x = |node: &roxmltree::Node| -> f64 { node.attribute("x").unwrap().parse().unwrap() };
    let mut end = 0.0;
    for mark in ["1 KiB", "4 KiB", "16 KiB", "64 KiB", "256 KiB", "1 MiB", "4 MiB"] {
        let node = texts().find(|node| node.text() == Some(mark)).unwrap_or_else(|| panic!("no {mark}"));
        let half = text_width(mark) / 2.0;
        assert!(x(&node) - half > end, "{mark} is over the mark before it");
        end = x(&node) + half;
    }
    // Titles, which begin at the left edge, end before the right one.
    assert!(texts().filter_map(|node| node.text()).all(|text| text_width(text) < WIDTH - 60.0));
    let points = |class: &str| -> Vec<Vec<(f64, f64)>> {
        let lines = document.descendants().filter(|node| node.attribute("class") == Some(class));
        let numbers =
            |point: &str| point.split_once(',').map(|(x, y)| (x.parse().unwrap(), y.parse().unwrap()));
        let lines = lines.filter_map(|node| node.attribute("points"));
        lines.map(|points| points.split(' ').filter_map(numbers).collect()).collect()
    };
    let (bridge, relay, direct) = (points("line a"), points("line b"), points("line c"));
    assert_eq!((bridge.len(), relay.len(), direct.len()), (2, 2, 2));
    assert_eq!((bridge[0].len(), bridge[1].len(), relay[0].len(), direct[0].len()), (6, 7, 7, 7));
    // From the left edge to the right one; a shorter hop is lower, and so is less CPU time.
    assert!(relay[0][0].0 < 60.0 && relay[0][6].0 > 450.0, "{:?}", relay[0]);
    assert!(bridge[0][5].1 > relay[0][6].1 && bridge[1][6].1 > relay[1][6].1);
    // Of direct the latency, which rises with the size.
    assert!(direct[0][6].1 < direct[0][0].1, "{:?}", direct[0]);
}

#[test]
fn cpu_is_judged_by_the_repetitions_of_each_process() {
    let mut summary = made_up();
    for row in &mut summary.resources {
        // In the fifth repetition another program loaded the machine.
        let each = |usual: f64, disturbed: f64| [&[usual; 4][..], &[disturbed], &[usual; 4]].concat();
        row.repetitions_cpu_us = match row.process.as_str() {
            "relay" => each(100.0, 110.0),
            "ingress" => each(70.0, 300.0),
            "critical" => each(60.0, 200.0),
            "control" => each(10.0, 10.0),
            _ => each(900.0, 900.0),
        };
    }
    let readme = readme(&summary);
    let cells = cells(&readme, "CPU of all processes of the bridge");
    assert_eq!(cells[2..4], ["1.40 (1.40 to 1.40)", "met"]);
}

#[test]
fn tables_have_the_figures_of_the_run() {
    let readme = readme(&made_up());
    assert_eq!(
        cells(&readme, "| 1,000 Hz of 2,948 B ")[..7],
        ["1,000 Hz of 2,948 B", "20.0", "100", "80.0", "76.0", "0.95", "900"]
    );
    assert_eq!(cells(&readme, "| 2,948 B, bridge")[1..4], ["10,000", "29.5", "0.50"]);
    assert_eq!(cells(&readme, "1,000 Hz, bridge: ingress")[1..5], ["8.00", "80.0", "2,000", "2.00"]);
    assert_eq!(cells(&readme, "1,000 Hz, relay ")[1..5], ["10.0", "100", "–", "2.00"]);
    assert_eq!(cells(&readme, "1,000 Hz, all of the bridge")[1..5], ["16.0", "160", "1.60", "6.00"]);
    assert_eq!(cells(&readme, "| bridge: ingress, 100 Hz")[2..], ["3.00", "recvfrom 3.00"]);
    assert!(
        line(&readme, "Each further route costs").contains("2.00 µs of p50 and 1.00 µs of CPU"),
        "{readme}"
    );
    assert!(line(&readme, "Each further lane costs").contains("0.00 µs of p50"), "{readme}");
    assert_eq!(
        cells(&readme, "| killed, 1,000 Hz")[6..10],
        ["500 to 48,000", "520", "1.04 (1.00 to 96.0)", "2 (critical queue_overflow 2)"]
    );
    assert!(cells(&readme, "5,000 Hz of 2,948 B, bridge").contains(&"critical queue_overflow 2".to_owned()));
}

#[test]
fn plots_are_well_formed_and_show_every_program() {
    let files = figures(&made_up());
    let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(
        names,
        [
            "latency-other.svg",
            "isolation-fifo.svg",
            "throughput.svg",
            "cpu.svg",
            "routes.svg",
            "lanes.svg",
            "soak.svg"
        ]
    );
    for (name, svg) in &files {
        let document = roxmltree::Document::parse(svg).unwrap_or_else(|error| panic!("{name}: {error}"));
        let drawn = document
            .descendants()
            .filter(|node| ["polyline", "rect"].contains(&node.tag_name().name()))
            .filter(|node| node.attribute("class") != Some("back"));
        assert!(drawn.count() >= 1, "{name} shows nothing");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{name}");
        for node in document.descendants().filter(|node| node.tag_name().name() == "polyline") {
            for number in node.attribute("points").unwrap().split([' ', ',']) {
                let at: f64 = number.parse().unwrap();
                assert!((0.0..=2_000.0).contains(&at), "{name}: {at}");
            }
        }
    }
    let latency = &files[0].1;
    for program in ["wake-up", "direct", "relay", "bridge"] {
        assert!(latency.contains(&format!(">{program}</text>")), "{program}");
    }
    // Taller bars are higher up: throughput of direct above that of the bridge.
    let throughput = roxmltree::Document::parse(&files[2].1).unwrap();
    let top = |class: &str| -> f64 {
        let mut bars = throughput.descendants().filter(|node| node.attribute("class") == Some(class));
        bars.next_back().unwrap().attribute("y").unwrap().parse().unwrap()
    };
    assert!(top("fill c") < top("fill a"), "{} {}", top("fill c"), top("fill a"));
    assert!(figures(&Summary::default()).is_empty());
}

const PAGE: &str = "# P\n\nWords.\n\n<!-- figures:runs -->\nold\n<!-- end -->\n\n<!-- figures:throughput -->\n\
                    <!-- end -->\nMore words.\n";

#[test]
fn filling_the_page_keeps_its_text_and_replaces_its_figures() {
    let run = ("2026-01-02T03-04-05Z".to_owned(), made_up());
    let filled = fill(PAGE, std::slice::from_ref(&run)).unwrap();
    assert!(filled.starts_with("# P\n\nWords.\n\n<!-- figures:runs -->\n"), "{filled}");
    assert!(filled.ends_with("<!-- end -->\nMore words.\n"), "{filled}");
    assert!(!filled.contains("old"));
    assert!(filled.contains("(../benches/runs/2026-01-02T03-04-05Z/throughput.svg)"), "{filled}");
    assert_eq!(runs_named(&filled), ["2026-01-02T03-04-05Z"]);
    // Filled again, with the same run or another one, the page has none of the former figures.
    assert_eq!(fill(&filled, std::slice::from_ref(&run)).unwrap(), filled);
    let empty = fill(&filled, &[]).unwrap();
    assert!(empty.contains("Not measured yet.") && runs_named(&empty).is_empty(), "{empty}");
    // Of two runs, the first one with the section is used.
    let second = ("b".to_owned(), made_up());
    let first = ("a".to_owned(), Summary { throughput: Vec::new(), ..made_up() });
    let filled = fill(PAGE, &[first, second]).unwrap();
    assert!(filled.contains("(../benches/runs/b/throughput.svg)"), "{filled}");
    assert_eq!(runs_named(&filled), ["a", "b"]);
}

#[test]
fn the_summary_of_large_samples_has_room_on_its_page() {
    let libraries = ["Fast DDS", "Cyclone DDS", "RustDDS"];
    let large = libraries.into_iter().flat_map(large_rows).collect();
    let run = ("2026-01-02T03-04-05Z".to_owned(), Summary { large, ..Summary::default() });
    let page = fs::read_to_string(root().join("docs/performance.md")).unwrap();
    let filled = fill(&page, std::slice::from_ref(&run)).unwrap();
    assert!(filled.contains("(../benches/runs/2026-01-02T03-04-05Z/large-fast-dds.svg)"), "{filled}");
    assert!(filled.lines().count() <= 150, "{} lines with the figures", filled.lines().count());
    // Each of its figures is among those of the other page.
    let runs = fill("<!-- figures:large -->\n<!-- end -->\n", &[run]).unwrap();
    let section = filled.split("<!-- figures:large-targets -->").nth(1).unwrap();
    let section = estimates(section.split("<!-- end -->").next().unwrap());
    assert!(section.len() > 30, "{section:?}");
    assert!(section.iter().all(|estimate| runs.contains(estimate)), "{runs}");
}

#[test]
fn a_page_that_cannot_be_filled_is_refused() {
    for (page, what) in [
        ("<!-- figures:thruput -->\n<!-- end -->\n", "thruput is not a section"),
        ("<!-- figures:loss -->\n", "loss has no end"),
        ("<!-- figures:loss -->\n<!-- figures:soak -->\n<!-- end -->\n", "loss has no end"),
    ] {
        let error = fill(page, &[("a".to_owned(), made_up())]).unwrap_err();
        assert!(error.contains(what), "{page}: {error}");
    }
}

#[test]
fn a_run_is_read_as_it_was_written() {
    let text = serde_json::to_string(&made_up()).unwrap();
    let read: Summary = serde_json::from_str(&text).unwrap();
    assert_eq!(readme(&read), readme(&made_up()));
}

#[test]
fn the_figures_of_the_pages_are_those_of_their_runs() {
    let page = fs::read_to_string(root().join("docs/performance-runs.md")).unwrap();
    let runs: Vec<(String, Summary)> = runs_named(&page)
        .into_iter()
        .map(|name| {
            let path = root().join("benches/runs").join(&name).join("summary.json");
            let text =
                fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            (name, serde_json::from_str(&text).unwrap())
        })
        .collect();
    let filled = fill(&page, &runs).unwrap();
    assert!(filled == page, "docs/performance-runs.md: run `cargo bench -- --page` with its runs");
    for section in
        ["runs", "targets", "latency-other", "large", "throughput", "resources", "isolation", "soak"]
    {
        assert!(page.contains(&format!("<!-- figures:{section} -->")), "the page has no {section}");
    }
    let summary = fs::read_to_string(root().join("docs/performance.md")).unwrap();
    let filled = fill(&summary, &runs).unwrap();
    assert!(filled == summary, "docs/performance.md: run `cargo bench -- --page`");
}

/// All medians with their intervals, such as `0.68 (0.59 to 0.76)`.
fn estimates(text: &str) -> Vec<String> {
    let is_of_number = |c: char| c.is_ascii_digit() || ".,".contains(c);
    let is_number = |word: &str| !word.is_empty() && word.chars().all(is_of_number);
    let estimate = |(at, _): (usize, &str)| {
        let median = text[..at].rsplit(|c| !is_of_number(c)).next()?;
        let interval = text[at + 2..].split(')').next()?;
        let (low, high) = interval.split_once(" to ")?;
        let is_one = [median, low, high].into_iter().all(is_number);
        is_one.then(|| format!("{median} ({interval})"))
    };
    text.match_indices(" (").filter_map(estimate).collect()
}

#[test]
fn the_summary_has_only_intervals_of_the_page_of_the_runs() {
    let text = "a 1.0 (0.9 to 1.1), b (c to d), µ (1 to 2) and 2,000 (1,000 to 3,000).";
    assert_eq!(estimates(text), ["1.0 (0.9 to 1.1)", "2,000 (1,000 to 3,000)"]);
    // A figure may be broken over two lines.
    let read = |name: &str| {
        let page = fs::read_to_string(root().join(name)).unwrap();
        page.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let runs = read("docs/performance-runs.md");
    let summary = estimates(&read("docs/performance.md"));
    assert!(summary.len() > 20, "{summary:?}");
    for estimate in summary.into_iter().chain(estimates(&read("README.md"))) {
        assert!(runs.contains(&estimate), "{estimate}");
    }
}
