//! Which runs there are to make.

use std::rc::Rc;

use super::settings::Library;
use crate::eval::bed::BedKind;
use crate::eval::impairment::Reading;
use crate::eval::scenario::{Scenario, Switch};

/// One run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// What is run.
    pub scenario: Rc<Scenario>,
    /// On whose DDS.
    pub library: Library,
    /// Of Table I; `None` where nothing is lost by it.
    pub reading: Option<Reading>,
    /// On what hosts.
    pub bed: BedKind,
    /// With what between them.
    pub switch: Switch,
    /// Which of several.
    pub repetition: u32,
}

/// All that a scenario is to be combined with.
#[derive(Clone, Debug)]
pub struct Dimensions {
    /// Libraries.
    pub libraries: Vec<Library>,
    /// Readings of Table I, for scenarios that have them.
    pub readings: Vec<Reading>,
    /// Beds.
    pub beds: Vec<BedKind>,
    /// Hosts between; none: those of the scenario.
    pub switches: Vec<Switch>,
    /// How often.
    pub repetitions: u32,
}

impl Dimensions {
    /// Every combination, the repetitions outermost, so that an interrupted matrix has the first of each. A
    /// docker bed is run with the one switch that it has.
    pub fn plans(&self, scenarios: &[Rc<Scenario>], docker_switch: Switch) -> Vec<Plan> {
        let mut plans = Vec::new();
        for repetition in 1..=self.repetitions {
            for scenario in scenarios {
                let readings: Vec<Option<Reading>> = match scenario.has_readings() {
                    true => self.readings.iter().copied().map(Some).collect(),
                    false => vec![None],
                };
                for &library in &self.libraries {
                    for &reading in &readings {
                        for &bed in &self.beds {
                            for switch in self.switches(scenario, bed, docker_switch) {
                                let scenario = Rc::clone(scenario);
                                plans.push(Plan { scenario, library, reading, bed, switch, repetition });
                            }
                        }
                    }
                }
            }
        }
        plans
    }

    fn switches(&self, scenario: &Scenario, bed: BedKind, docker_switch: Switch) -> Vec<Switch> {
        match (bed, self.switches.as_slice()) {
            (BedKind::Docker, []) => vec![docker_switch],
            (BedKind::Netns, []) => scenario.switches.clone(),
            (_, asked) => asked.to_vec(),
        }
    }
}

impl Plan {
    /// The name of its folder.
    pub fn name(&self) -> String {
        format!(
            "{}.{}.{}.{}.{}.r{}",
            self.scenario.name,
            self.library.name(),
            self.reading.map_or("none", Reading::name),
            self.bed.name(),
            self.switch.name(),
            self.repetition
        )
    }

    /// The measured window, in seconds.
    pub fn duration_s(&self, quick: bool) -> f64 {
        if quick { self.scenario.quick_s } else { self.scenario.duration_s }
    }

    /// When an event is due, in seconds from the beginning of the window.
    pub fn at_s(&self, at_s: f64, quick: bool) -> f64 {
        at_s * self.duration_s(quick) / self.scenario.duration_s
    }
}
