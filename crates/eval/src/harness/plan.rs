//! The plan of a matrix: which runs to execute.

use std::rc::Rc;

use super::settings::Library;
use crate::bed::BedKind;
use crate::impairment::Reading;
use crate::scenario::{Scenario, Switch};

/// A run: a scenario in one setting.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The scenario.
    pub scenario: Rc<Scenario>,
    /// The DDS library of the publishers and subscribers.
    pub library: Library,
    /// The reading of Table I; `None` if no link loses packets by it.
    pub reading: Option<Reading>,
    /// The kind of test bed.
    pub bed: BedKind,
    /// The switch between the hosts.
    pub switch: Switch,
    /// The number of the repetition, from 1.
    pub repetition: u32,
}

/// The settings that each scenario is combined with.
#[derive(Clone, Debug)]
pub struct Dimensions {
    /// DDS libraries.
    pub libraries: Vec<Library>,
    /// Readings of Table I, for scenarios to which they make a difference.
    pub readings: Vec<Reading>,
    /// Kinds of test beds.
    pub beds: Vec<BedKind>,
    /// Switches between the hosts; empty for those of the scenario.
    pub switches: Vec<Switch>,
    /// The number of repetitions of each run.
    pub repetitions: u32,
}

impl Dimensions {
    /// Returns every combination. Repetitions are the outermost loop, so that an interrupted matrix has the
    /// first repetition of each. A docker bed has only the switch that docker provides.
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
            (_, chosen) => chosen.to_vec(),
        }
    }
}

impl Plan {
    /// The name of the run and of its folder.
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

    /// The length of the measured window, in seconds.
    pub fn duration_s(&self, quick: bool) -> f64 {
        if quick { self.scenario.quick_s } else { self.scenario.duration_s }
    }

    /// The factor by which a smoke run is faster than the scenario.
    pub fn speed(&self, quick: bool) -> f64 {
        self.scenario.duration_s / self.duration_s(quick)
    }

    /// Scales an event's time, in seconds from the beginning of the window, to this run.
    pub fn at_s(&self, at_s: f64, quick: bool) -> f64 {
        at_s * self.duration_s(quick) / self.scenario.duration_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenario(name: &str, level: &str) -> Rc<Scenario> {
        let text = format!(
            "title: a\nvariant: baseline\nduration_s: 180\nquick_s: 9\nswitches: [plain, reassembling]\n\
             remotes:\n  - {{name: slow, level: {level}}}\n"
        );
        Rc::new(Scenario::parse(name, &text).unwrap_or_else(|problems| panic!("{problems:?}")))
    }

    fn dimensions() -> Dimensions {
        Dimensions {
            libraries: vec![Library::Fast, Library::Cyclone],
            readings: vec![Reading::AsPrinted, Reading::AsRun],
            beds: vec![BedKind::Netns],
            switches: Vec::new(),
            repetitions: 2,
        }
    }

    #[test]
    fn every_combination_is_planned_once_and_the_first_repetition_first() {
        let scenarios = [scenario("clean", "clean"), scenario("mild", "mild")];
        let plans = dimensions().plans(&scenarios, Switch::Reassembling);
        // Two libraries, two switches, two repetitions; the scenario without loss has no readings.
        assert_eq!(plans.len(), 2 * 2 * 2 * (1 + 2));
        let mut names: Vec<String> = plans.iter().map(Plan::name).collect();
        assert_eq!(names[0], "clean.fast.none.netns.plain.r1");
        assert!(names[..12].iter().all(|name| name.ends_with(".r1")));
        assert!(names.contains(&"mild.cyclone.as-run.netns.reassembling.r2".to_owned()));
        names.sort();
        names.dedup();
        assert_eq!(names.len(), plans.len());
    }

    #[test]
    fn switches_are_those_given_or_the_scenarios_and_docker_has_one() {
        let scenarios = [scenario("mild", "mild")];
        let count = |dimensions: &Dimensions| dimensions.plans(&scenarios, Switch::Reassembling).len();
        let one = Dimensions { switches: vec![Switch::Plain], ..dimensions() };
        let docker = Dimensions { beds: vec![BedKind::Docker], ..dimensions() };
        assert_eq!((count(&dimensions()), count(&one), count(&docker)), (16, 8, 8));
    }

    #[test]
    fn times_of_events_scale_with_the_window() {
        let scenarios = [scenario("mild", "mild")];
        let plan = &dimensions().plans(&scenarios, Switch::Plain)[0];
        assert_eq!((plan.duration_s(false), plan.at_s(60.0, false)), (180.0, 60.0));
        assert_eq!((plan.duration_s(true), plan.at_s(60.0, true)), (9.0, 3.0));
        assert_eq!((plan.speed(false), plan.speed(true)), (1.0, 20.0));
    }
}
