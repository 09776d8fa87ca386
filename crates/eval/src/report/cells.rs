//! Groups runs: the repetitions of a scenario in the same setting are a cell.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};

use super::measures::Measures;
use super::paper;
use super::record::{Folder, Run};
use crate::statistics::{Distribution, Estimate};

/// The part of a setting that does not depend on the scenario: library, test bed and switch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// `fast`, `cyclone` or `rust`.
    pub library: String,
    /// `netns` or `docker`.
    pub bed: String,
    /// `plain` or `reassembling`.
    pub switch: String,
}

/// Orders the paper's library first, and the paper's kind of test bed before network namespaces.
impl Ord for Place {
    fn cmp(&self, other: &Self) -> Ordering {
        let rank = |place: &Self| {
            let known =
                |list: &[&str], name: &str| list.iter().position(|one| *one == name).unwrap_or(list.len());
            let library = known(&["fast", "cyclone", "rust"], &place.library);
            (
                library,
                known(&["docker", "netns"], &place.bed),
                known(&["plain", "reassembling"], &place.switch),
            )
        };
        let texts = |place: &Self| (place.library.clone(), place.bed.clone(), place.switch.clone());
        rank(self).cmp(&rank(other)).then_with(|| texts(self).cmp(&texts(other)))
    }
}

impl PartialOrd for Place {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Place {
    /// The product name of the library.
    pub fn library_name(&self) -> &str {
        match self.library.as_str() {
            "fast" => "Fast DDS",
            "cyclone" => "Cyclone DDS",
            "rust" => "RustDDS",
            other => other,
        }
    }

    /// The test bed and the switch, in words.
    pub fn bed_name(&self) -> String {
        let bed = match self.bed.as_str() {
            "netns" => "network namespaces",
            "docker" => "Docker",
            other => other,
        };
        let switch = match self.switch.as_str() {
            "plain" => "plain switch",
            "reassembling" => "switch that reassembles fragments",
            other => other,
        };
        format!("{bed}, {switch}")
    }

    /// Library, test bed and switch, in words.
    pub fn name(&self) -> String {
        format!("{}, {}", self.library_name(), self.bed_name())
    }
}

/// The name of a reading of Table I, in words.
pub fn reading_name(reading: &str) -> &str {
    match reading {
        "as-printed" => "as printed",
        "as-run" => "as run",
        other => other,
    }
}

/// A scenario in a setting, with all its repetitions.
#[derive(Clone, Debug)]
pub struct Cell {
    pub scenario: String,
    pub title: String,
    pub place: Place,
    /// `None` if no link loses packets by Table I.
    pub reading: Option<String>,
    /// Whether the scenario has the bridge.
    pub bridge: bool,
    pub level: String,
    /// Whether a run of the cell is a smoke run.
    pub quick: bool,
    /// Indices of its runs in [`Results::runs`].
    pub runs: Vec<usize>,
    /// The figures of these runs, in the same order.
    pub measures: Vec<Measures>,
}

impl Cell {
    /// A figure's median over the repetitions with its confidence interval; `None` if no run has the figure.
    pub fn estimate(&self, figure: impl Fn(&Measures) -> Option<f64>) -> Option<Estimate> {
        Estimate::of(self.measures.iter().filter_map(figure))
    }

    /// The median of a figure over the repetitions.
    pub fn median(&self, figure: impl Fn(&Measures) -> Option<f64>) -> Option<f64> {
        self.estimate(figure).map(|estimate| estimate.median)
    }

    /// The largest value of a figure in any repetition.
    pub fn max(&self, figure: impl Fn(&Measures) -> Option<f64>) -> Option<f64> {
        self.measures.iter().filter_map(figure).max_by(f64::total_cmp)
    }

    /// A quantile of the critical latency in milliseconds, as the median over repetitions.
    pub fn critical_ms(&self, q: f64) -> Option<f64> {
        self.median(|one| one.critical_ms.quantile(q))
    }

    /// The sum of a count over all repetitions.
    pub fn total(&self, count: impl Fn(&Measures) -> usize) -> usize {
        self.measures.iter().map(count).sum()
    }
}

/// All runs of a folder of results, grouped into cells.
pub struct Results {
    pub runs: Vec<Run>,
    pub unusable: Vec<(String, String)>,
    cells: BTreeMap<(Place, Option<String>, String), Cell>,
}

impl Results {
    /// Groups the runs of a folder and computes their figures.
    pub fn new(folder: Folder) -> Self {
        let mut cells: BTreeMap<(Place, Option<String>, String), Cell> = BTreeMap::new();
        for (index, run) in folder.runs.iter().enumerate() {
            let manifest = &run.manifest;
            let place = Place {
                library: manifest.library.clone(),
                bed: manifest.bed.clone(),
                switch: manifest.switch.clone(),
            };
            let key = (place.clone(), manifest.reading.clone(), manifest.scenario.clone());
            let cell = cells.entry(key).or_insert_with(|| Cell {
                scenario: manifest.scenario.clone(),
                title: manifest.title.clone(),
                place,
                reading: manifest.reading.clone(),
                bridge: manifest.variant == "bridge",
                level: manifest.level.clone(),
                quick: false,
                runs: Vec::new(),
                measures: Vec::new(),
            });
            cell.quick |= manifest.quick;
            cell.runs.push(index);
            cell.measures.push(Measures::of(run));
        }
        Self { runs: folder.runs, unusable: folder.unusable, cells }
    }

    /// All cells, sorted by place, reading and scenario.
    pub fn cells(&self) -> impl Iterator<Item = &Cell> {
        self.cells.values()
    }

    /// The places of all runs.
    pub fn places(&self) -> BTreeSet<&Place> {
        self.cells.keys().map(|(place, _, _)| place).collect()
    }

    /// The readings that were run at a place. If only scenarios without loss were run, the reading as
    /// printed.
    pub fn readings(&self, place: &Place) -> Vec<String> {
        let of_place = self.cells.keys().filter(|(known, _, _)| known == place);
        let mut readings: Vec<String> = of_place.filter_map(|(_, reading, _)| reading.clone()).collect();
        readings.sort();
        readings.dedup();
        if readings.is_empty() {
            readings.push("as-printed".to_owned());
        }
        readings
    }

    /// Finds the cell of a scenario; a scenario without loss belongs to every reading.
    pub fn cell(&self, place: &Place, reading: &str, scenario: &str) -> Option<&Cell> {
        let key = |reading: Option<&str>| (place.clone(), reading.map(str::to_owned), scenario.to_owned());
        self.cells.get(&key(Some(reading))).or_else(|| self.cells.get(&key(None)))
    }

    /// The cells at a place in a reading, including those without a reading: in the order of the paper's
    /// tables, then by name.
    pub fn cells_of(&self, place: &Place, reading: &str) -> Vec<&Cell> {
        let of_setting =
            |cell: &&Cell| cell.place == *place && cell.reading.as_deref().unwrap_or(reading) == reading;
        let mut cells: Vec<&Cell> = self.cells().filter(of_setting).collect();
        let rank = |cell: &Cell| {
            let rows = paper::TABLE_II.iter().chain(&paper::TABLE_III);
            let row = rows.into_iter().position(|row| row.scenario == cell.scenario);
            (row.is_none(), row, cell.bridge)
        };
        cells.sort_by(|one, other| {
            rank(one).cmp(&rank(other)).then_with(|| one.scenario.cmp(&other.scenario))
        });
        cells
    }

    /// The setting of the results that is nearest to the paper's: Fast DDS, Table I as run, a switch that
    /// reassembles fragments.
    pub fn nearest_to_paper(&self) -> Option<(&Place, String)> {
        let settings = self
            .places()
            .into_iter()
            .flat_map(|place| self.readings(place).into_iter().map(move |reading| (place, reading)));
        settings.min_by_key(|(place, reading)| {
            (place.library != "fast", reading != "as-run", place.switch != "reassembling")
        })
    }

    /// The critical latencies of all repetitions of a cell.
    pub fn pooled_critical_ms(&self, cell: &Cell) -> Distribution {
        let all = cell.measures.iter().flat_map(|one| one.critical_ms.values());
        Distribution::new(all.copied())
    }

    /// Whether any run is a smoke run.
    pub fn any_quick(&self) -> bool {
        self.cells().any(|cell| cell.quick)
    }

    /// Whether any run is synthetic test data.
    pub fn any_synthetic(&self) -> bool {
        self.runs.iter().any(|run| run.manifest.synthetic)
    }
}
