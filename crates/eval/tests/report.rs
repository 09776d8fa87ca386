//! The report of results that the harness recorded (tests/data: smoke runs), read with a real XML parser, and
//! of damaged folders. Reads and writes files.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use roxmltree::{Document, Node, ParsingOptions};
use tempfile::TempDir;

/// The width of every plot in its own units, and the smallest text in them.
const PLOT_WIDTH: f64 = 480.0;
const TEXT_PX: f64 = 13.0;

/// Unpacks the recorded results into a new folder, which the caller may change.
fn recorded() -> TempDir {
    let archive = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/runs.tar.xz");
    let folder = tempfile::tempdir().unwrap();
    let status = Command::new("tar").arg("-xJf").arg(&archive).arg("-C").arg(folder.path()).status();
    assert!(status.expect("tar").success(), "{}: tar or xz failed", archive.display());
    folder
}

fn report(results: &Path, out: &Path) -> Output {
    let program = env!("CARGO_BIN_EXE_adaptive-bridge-eval");
    Command::new(program).arg("report").arg(results).arg("--out").arg(out).output().unwrap()
}

/// Makes the report of a folder, which must succeed.
fn report_of(results: &Path) -> (TempDir, String) {
    let out = tempfile::tempdir().unwrap();
    let output = report(results, out.path());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = fs::read_to_string(out.path().join("report.html")).unwrap();
    (out, page)
}

fn parse(page: &str) -> Document<'_> {
    Document::parse_with_options(page, ParsingOptions { allow_dtd: true, ..ParsingOptions::default() })
        .unwrap()
}

fn runs(results: &Path) -> Vec<PathBuf> {
    let mut runs: Vec<PathBuf> =
        fs::read_dir(results.join("runs")).unwrap().map(|entry| entry.unwrap().path()).collect();
    runs.sort();
    runs
}

fn replace(path: &Path, from: &str, to: &str) {
    let text = fs::read_to_string(path).unwrap();
    assert!(text.contains(from), "{}: no '{from}'", path.display());
    fs::write(path, text.replace(from, to)).unwrap();
}

fn texts<'a>(document: &'a Document, tag: &str) -> Vec<String> {
    let named = |node: &Node| node.tag_name().name() == tag;
    let text = |node: Node<'a, '_>| {
        node.descendants().filter_map(|one| one.text().filter(|_| one.is_text())).collect()
    };
    document.descendants().filter(named).map(text).collect()
}

#[test]
fn the_page_is_well_formed_and_needs_nothing_from_elsewhere() {
    let (_out, page) = report_of(recorded().path());
    let document = parse(&page);
    let ids: BTreeSet<&str> = document.descendants().filter_map(|node| node.attribute("id")).collect();
    for node in document.descendants().filter(Node::is_element) {
        let name = node.tag_name().name();
        assert!(!["script", "link", "img", "iframe", "object", "image", "use"].contains(&name), "<{name}>");
        for attribute in node.attributes() {
            assert!(
                !attribute.name().starts_with("on") && attribute.name() != "src",
                "{name} {}",
                attribute.name()
            );
            if attribute.name() == "href" {
                let target =
                    attribute.value().strip_prefix('#').unwrap_or_else(|| panic!("{}", attribute.value()));
                assert!(ids.contains(target), "#{target} leads nowhere");
            }
        }
    }
    // A browser does not fetch the addresses of XML namespaces.
    let rest = page.replace("http://www.w3.org/1999/xhtml", "").replace("http://www.w3.org/2000/svg", "");
    for foreign in ["http:", "https:", "url(", "@import", "//"] {
        assert!(!rest.contains(foreign), "{foreign}");
    }
    assert!(page.contains("<meta name=\"viewport\"") && page.contains("prefers-color-scheme: dark"));
}

#[test]
fn text_in_plots_can_be_read_on_a_phone_and_stays_within() {
    let (_out, page) = report_of(recorded().path());
    let document = parse(&page);
    let style = texts(&document, "style").concat();
    assert!(style.contains(&format!("svg .t {{ font: {TEXT_PX}px")), "the size of text in plots");
    let plots: Vec<Node> = document.descendants().filter(|node| node.tag_name().name() == "svg").collect();
    assert!(plots.len() >= 8, "{} plots", plots.len());
    for plot in plots {
        let size: Vec<f64> =
            plot.attribute("viewBox").unwrap().split(' ').map(|one| one.parse().unwrap()).collect();
        assert_eq!((size[0], size[1], size[2]), (0.0, 0.0, PLOT_WIDTH));
        assert!((150.0..1500.0).contains(&size[3]), "{size:?}");
        assert!(!plot.attribute("aria-label").unwrap().is_empty());
        for node in plot.descendants().filter(Node::is_element) {
            let number = |name| node.attribute(name).map(|value| value.parse::<f64>().unwrap());
            for (x, y) in [("x", "y"), ("x1", "y1"), ("x2", "y2")] {
                let (Some(x), Some(y)) = (number(x), number(y)) else { continue };
                assert!((0.0..=size[2]).contains(&x) && (0.0..=size[3]).contains(&y), "{x} {y} of {size:?}");
            }
            if node.tag_name().name() == "text" {
                assert!(node.attribute("class").unwrap().split(' ').any(|class| class == "t"));
                // Assumes half the font size for each character. A text may extend beyond a frame, not a
                // plot.
                let width = node.text().unwrap_or_default().chars().count() as f64 * TEXT_PX * 0.5;
                let x = number("x").unwrap();
                let (left, right) = match node.attribute("text-anchor").unwrap() {
                    "start" => (x, x + width),
                    "end" => (x - width, x),
                    _ => (x - width / 2.0, x + width / 2.0),
                };
                assert!(
                    left >= -4.0 && right <= PLOT_WIDTH + 4.0,
                    "'{}' at {left} to {right}",
                    node.text().unwrap()
                );
            }
            // A class without a style is invisible or black on black.
            for class in
                node.attribute("class").unwrap_or_default().split(' ').filter(|class| !class.is_empty())
            {
                assert!(style.contains(&format!(".{class}")), "no style for {class}");
            }
        }
        for points in plot.descendants().filter_map(|node| node.attribute("points")) {
            for point in points.split(' ') {
                let (x, y) = point.split_once(',').unwrap();
                let (x, y): (f64, f64) = (x.parse().unwrap(), y.parse().unwrap());
                assert!((0.0..=size[2]).contains(&x) && (0.0..=size[3]).contains(&y), "{point}");
            }
        }
    }
}

#[test]
fn it_shows_what_was_run_and_what_was_not() {
    let (out, page) = report_of(recorded().path());
    let document = parse(&page);
    let headings = texts(&document, "h3").concat();
    for title in
        ["Table I, as printed", "Table I, as run", "Table II", "Table III", "Table IV", "H1", "H2", "H3"]
    {
        assert!(headings.contains(title), "{title}");
    }
    let captions = texts(&document, "figcaption").concat();
    assert!(
        captions.contains("Figure 4") && captions.contains("Figure 5") && captions.contains("bridge_toggle")
    );
    // The paper's value is beside ours, also where no run was made.
    let cells = texts(&document, "td");
    assert!(
        cells.iter().any(|cell| cell.starts_with("not run") && cell.contains("paper 11,666")),
        "Table II, moderate"
    );
    assert!(
        cells.iter().any(|cell| cell.contains("paper 15,043") && !cell.contains("not run")),
        "Table II, strong"
    );
    // Smoke runs are no evidence: the page shows each hypothesis as not tested.
    let badges: Vec<Node> =
        document.descendants().filter(|node| node.attribute("class") == Some("badge")).collect();
    assert_eq!(badges.len(), 5);
    assert!(badges.iter().all(|badge| badge.text() == Some("not tested")));
    assert!(page.contains("Smoke runs"));
    let manifest = fs::read_to_string(runs(recorded().path())[0].join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    for (group, key) in
        [("machine", "kernel"), ("machine", "cpu"), ("software", "version"), ("software", "peer")]
    {
        let value = manifest[group][key].as_str().unwrap();
        assert!(page.contains(value), "{key}: {value}");
    }
    assert!(page.contains("nfqueue") && page.contains("--quick"));

    let markdown = fs::read_to_string(out.path().join("report.md")).unwrap();
    assert!(markdown.contains("- **H2: not tested.**") && markdown.contains("paper 15,043"), "{markdown}");
    assert!(!markdown.contains("(README.md)"));
    fs::write(out.path().join("README.md"), "# Notes\n").unwrap();
    assert!(report(recorded().path(), out.path()).status.success());
    let markdown = fs::read_to_string(out.path().join("report.md")).unwrap();
    assert!(markdown.contains("[Notes](README.md): how to read the tables."), "{markdown}");
}

#[test]
fn csv_files_have_a_line_for_each_run_and_figure() {
    let (out, _page) = report_of(recorded().path());
    let lines = |name: &str| -> Vec<Vec<String>> {
        let mut reader =
            csv::ReaderBuilder::new().has_headers(false).from_path(out.path().join(name)).unwrap();
        reader.deserialize().map(|line| line.unwrap()).collect()
    };
    let by_run = lines("runs.csv");
    assert_eq!(by_run.len(), runs(recorded().path()).len() + 1);
    assert!(by_run.iter().all(|line| line.len() == by_run[0].len()));
    let column = |name: &str| by_run[0].iter().position(|column| column == name).unwrap();
    for line in &by_run[1..] {
        let rate: f64 = line[column("publisher_rate_hz")].parse().unwrap();
        assert!((1.0..=31.0).contains(&rate), "{rate} Hz");
        let bridge = line[column("scenario")].starts_with("bridge");
        assert_eq!(line[column("classifier_transitions")].is_empty(), !bridge);
        assert_eq!(line[column("history_outstanding_max")].is_empty(), bridge);
    }
    let figures = lines("figures.csv");
    let paper = |scenario: &str, figure: &str| {
        let line = figures.iter().find(|line| line[0] == scenario && line[5] == figure).unwrap();
        line[13].clone()
    };
    assert_eq!(paper("baseline_strong", "critical_p95_ms"), "15043");
    assert_eq!(paper("bridge_clean", "critical_p99_ms"), "1.7");
    assert_eq!(paper("bridge_clean", "critical_gap_ms"), "");
}

#[test]
fn every_figure_is_documented() {
    let (out, _page) = report_of(recorded().path());
    let mut runs = csv::Reader::from_path(out.path().join("runs.csv")).unwrap();
    let page = fs::read_to_string(support::root().join("docs/eval-report.md")).unwrap();
    // Those from p50 to max are named by their ends.
    let between = ["critical_p95_ms", "critical_p99_ms"];
    for figure in runs.headers().unwrap().iter().skip(9).filter(|name| !between.contains(name)) {
        assert!(page.contains(&format!("`{figure}`")), "{figure}");
    }
}

#[test]
fn two_reports_of_the_same_results_are_the_same() {
    let results = recorded();
    let (_one, first) = report_of(results.path());
    let (_other, second) = report_of(results.path());
    assert!(first == second, "the page depends on more than the results");
}

#[test]
fn a_run_that_cannot_be_read_is_told_and_the_others_are_shown() {
    let results = recorded();
    let broken = runs(results.path());
    replace(&broken[0].join("publisher.csv"), "seq,time_ns", "seq,when");
    replace(&broken[1].join("manifest.json"), "\"format\": 1", "\"format\": 2");
    fs::create_dir_all(results.path().join("failed/bridge_mild.fast.none.netns.plain.r1")).unwrap();
    fs::write(results.path().join("failed/bridge_mild.fast.none.netns.plain.r1/reason.txt"), "no <luck>\n")
        .unwrap();
    let (_out, page) = report_of(results.path());
    parse(&page);
    assert!(page.contains("publisher.csv:1: there is no column time_ns"));
    assert!(page.contains("format 2, but this program reads format 1"));
    assert!(page.contains("failed: no &lt;luck&gt;"));
    assert!(page.contains("3 runs failed or could not be read"));
}

#[test]
fn names_from_the_results_are_no_markup() {
    let results = recorded();
    for run in runs(results.path()) {
        replace(
            &run.join("manifest.json"),
            "\"title\": \"",
            "\"title\": \"</b><script>alert(1)</script>&amp;",
        );
    }
    let (_out, page) = report_of(results.path());
    let document = parse(&page);
    assert!(texts(&document, "script").is_empty());
    assert!(texts(&document, "figcaption").concat().contains("<script>alert(1)</script>&amp;"));
}

#[test]
fn a_folder_without_runs_is_an_error() {
    let empty = tempfile::tempdir().unwrap();
    let output = report(empty.path(), empty.path());
    assert_eq!(output.status.code(), Some(1));
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        stderr.contains("has no finished run; first record some with `adaptive-bridge-eval run` or `matrix`"),
        "{stderr}"
    );
    assert_eq!(fs::read_dir(empty.path()).unwrap().count(), 0);
}
