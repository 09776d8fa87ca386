//! The impaired links of a run: an `impair` process for each direction, and bandwidth caps on the ports of
//! the switch.

use std::fmt::Display;
use std::path::Path;
use std::time::Duration;

use serde_json::Value;

use super::csv::Csv;
use super::manifest::LinkEntry;
use super::plan::Plan;
use super::program::Program;
use super::settings::Settings;
use crate::bed::Bed;
use crate::error::EvalError;
use crate::impairment::Level;
use crate::scenario::{Action, FORWARD, RETURN, Remote, Scenario};

/// Burst size and queue length of a cap's token bucket, similar to a router of a slow radio link. A longer
/// queue delays more packets and drops fewer.
const CAP_QUEUE: &str = "burst 16kb latency 200ms";

/// Niceness of link processes, so that they do not wait for the CPU behind the publishers: beside ten senders
/// at normal priority, 85 % of 1.9 million packets were dropped before the link saw them, and none at this
/// one (docs/decisions/0005-impaired-link.md). Without the right to it, `nice` warns and runs the program
/// anyway.
const NICENESS: &str = "-20";

const COLUMNS: &str = "time_ns,link,state,seen,fragments,judged,lost,cut,held,passed,kernel_dropped,overflowed,\
                       lost_expected,trace_row";

/// A process that impairs the packets that a host receives from another.
struct Link {
    remote: String,
    entry: LinkEntry,
    program: Program,
}

/// A token bucket on the switch's port towards a remote subscriber.
struct Cap {
    remote: String,
    port: String,
    kbit_per_s: u64,
    on: bool,
}

/// All links of a run. They start clean (`off`).
pub(super) struct Links {
    links: Vec<Link>,
    caps: Vec<Cap>,
    csv: Csv,
}

/// The impairment of one direction of a link.
struct Direction<'a> {
    direction: &'static str,
    host: &'a str,
    source: &'a str,
    level: Level,
    delay_ms: f64,
    jitter_ms: f64,
}

impl Links {
    /// Starts the processes of all links.
    pub fn open(plan: &Plan, settings: &Settings, bed: &Bed, folder: &Path) -> Result<Self, EvalError> {
        let scenario = &plan.scenario;
        let mut links = Vec::new();
        let mut caps = Vec::new();
        for remote in &scenario.remotes {
            for direction in directions(scenario, remote) {
                let number = u16::try_from(links.len()).unwrap_or(u16::MAX);
                links.push(open(plan, settings, bed, folder, remote, &direction, number)?);
            }
            if let Some(kbit_per_s) = remote.cap_kbit_per_s {
                let port = bed.host(&remote.name)?.port.clone();
                caps.push(Cap { remote: remote.name.clone(), port, kbit_per_s, on: false });
            }
        }
        Ok(Self { links, caps, csv: Csv::create(folder, "links.csv", COLUMNS)? })
    }

    /// Whether all links are in place.
    pub fn are_ready(&mut self) -> bool {
        self.links.iter_mut().all(|link| link.program.latest("ready").is_some())
    }

    /// Applies an event's action to a remote subscriber's link.
    pub fn switch(&mut self, bed: &Bed, remote: &str, action: Action) -> Result<(), EvalError> {
        let command = match action {
            Action::LinkOn => "on",
            Action::LinkDown => "down",
            _ => "off",
        };
        for link in self.links.iter_mut().filter(|link| link.remote == remote) {
            link.program.send_line(command);
        }
        for cap in self.caps.iter_mut().filter(|cap| cap.remote == remote) {
            let on = action != Action::LinkOff;
            if on != cap.on {
                let verb = if on { "add" } else { "del" };
                let (port, rate) = (&cap.port, cap.kbit_per_s);
                let bucket = if on { format!("tbf rate {rate}kbit {CAP_QUEUE}") } else { String::new() };
                bed.switch().run(&format!("tc qdisc {verb} dev {port} root {bucket}"))?;
                cap.on = on;
            }
        }
        Ok(())
    }

    /// Ports with an active cap.
    pub fn capped_ports(&self) -> impl Iterator<Item = &str> {
        self.caps.iter().filter(|cap| cap.on).map(|cap| cap.port.as_str())
    }

    /// Records the counters that the links have returned to the last request, and requests them again.
    pub fn sample(&mut self) -> Result<(), EvalError> {
        for link in &mut self.links {
            if let Some((time, counters)) = link.program.take_latest("counters") {
                let number = |key: &str| counters[key].as_u64().unwrap_or(0);
                let state = counters["state"].as_str().unwrap_or("");
                let counts = [
                    "seen",
                    "fragments",
                    "judged",
                    "lost",
                    "cut",
                    "held",
                    "passed",
                    "kernel_dropped",
                    "overflowed",
                ];
                let counts = counts.map(number);
                let expected = counters["lost_expected"].as_f64().unwrap_or(0.0);
                let trace_row =
                    counters["trace"]["row"].as_u64().map_or(String::new(), |row| row.to_string());
                let mut row: Vec<&dyn Display> = vec![&time.0, &link.entry.name, &state];
                row.extend(counts.iter().map(|count| count as &dyn Display));
                row.extend([&expected as &dyn Display, &trace_row]);
                self.csv.row(&row)?;
            }
            link.program.send_line("counters");
        }
        Ok(())
    }

    /// The processes of all links.
    pub fn programs(&mut self) -> impl Iterator<Item = &mut Program> {
        self.links.iter_mut().map(|link| &mut link.program)
    }

    /// Removes all links; returns their manifest entries with the final counters, and the problems.
    pub fn end(mut self) -> Result<(Vec<LinkEntry>, Vec<String>), EvalError> {
        let mut entries = Vec::new();
        let mut problems = Vec::new();
        for link in &mut self.links {
            let name = link.entry.name.clone();
            if !link.program.end(Duration::from_secs(10)) {
                problems.push(format!("the link {name} did not end cleanly on SIGTERM"));
            }
            let last = link.program.wait_for_last("ended");
            problems.extend(last.as_ref().and_then(|last| lost_beside_the_model(&name, last)));
            entries.push(LinkEntry { impairment: last, ..link.entry.clone() });
        }
        for cap in &self.caps {
            match entries.iter_mut().find(|entry| entry.host == cap.remote && entry.direction == "forward") {
                Some(entry) => entry.cap_kbit_per_s = Some(cap.kbit_per_s),
                None => entries.push(LinkEntry {
                    name: format!("{}<-*", cap.remote),
                    direction: "forward",
                    host: cap.remote.clone(),
                    source: "*".to_owned(),
                    before_switch: false,
                    cap_kbit_per_s: Some(cap.kbit_per_s),
                    impairment: None,
                }),
            }
        }
        self.csv.flush()?;
        Ok((entries, problems))
    }
}

/// The problem of packets that a link lost although its model did not, by the link's last output; `None` if
/// there are none.
fn lost_beside_the_model(name: &str, last: &Value) -> Option<String> {
    let [seen, unseen, no_room] =
        ["seen", "kernel_dropped", "overflowed"].map(|key| last[key].as_u64().unwrap_or(0));
    let lost = unseen + no_room;
    let percent = 100.0 * lost as f64 / (seen + unseen).max(1) as f64;
    (lost > 0).then(|| {
        format!(
            "the link {name} lost {lost} packets ({percent:.2} %) that its model did not lose: {unseen} in \
             the kernel, because its process did not keep up, and {no_room} because too many were in transit"
        )
    })
}

/// The directions of a remote subscriber's link that need a process: those that are impaired or cut.
fn directions<'a>(scenario: &Scenario, remote: &'a Remote) -> Vec<Direction<'a>> {
    let sender = scenario.variant.sender();
    let is_cut =
        scenario.events.iter().any(|event| event.action == Action::LinkDown && event.to == remote.name);
    let mut directions = Vec::new();
    if remote.is_impaired() || is_cut {
        let (delay_ms, jitter_ms) = (remote.delay_ms, remote.jitter_ms);
        let (host, source) = (remote.name.as_str(), sender);
        let level = remote.level;
        directions.push(Direction { direction: FORWARD, host, source, level, delay_ms, jitter_ms });
    }
    if remote.is_impaired_back() || is_cut {
        let (delay_ms, jitter_ms) = (remote.return_delay_ms, remote.return_jitter_ms);
        let (host, source) = (sender, remote.name.as_str());
        let level = Level::Clean;
        directions.push(Direction { direction: RETURN, host, source, level, delay_ms, jitter_ms });
    }
    directions
}

/// Starts the process of one direction; `number` is different for each link of a run.
fn open(
    plan: &Plan,
    settings: &Settings,
    bed: &Bed,
    folder: &Path,
    remote: &Remote,
    to: &Direction,
    number: u16,
) -> Result<Link, EvalError> {
    let (host, source) = (bed.host(to.host)?, bed.host(to.source)?);
    let uplink = source.uplink.as_ref();
    let mut command = uplink.unwrap_or(&host.network).command(Path::new("nice"));
    command.args(["-n", NICENESS]).arg(&settings.harness);
    command.args(["impair", "--json", "--state", "off"]);
    if uplink.is_some() {
        command.args(["--destination", &host.address.to_string()]);
    }
    command.args(["--backend", settings.backend_name(), "--queue", &number.to_string()]);
    command.args(["--source", &source.address.to_string()]);
    if let Some(trace) = remote.trace_of(to.direction) {
        command.arg("--trace").arg(folder.join(remote.trace_name(to.direction)));
        command.args(["--trace-speed", &plan.speed(settings.quick).to_string()]);
        if trace.repeat {
            command.arg("--trace-repeat");
        }
    } else {
        command.args(["--level", to.level.name()]);
        if let Some(reading) = plan.reading {
            command.args(["--reading", reading.name()]);
        }
        command.args(["--delay-ms", &to.delay_ms.to_string(), "--jitter-ms", &to.jitter_ms.to_string()]);
    }
    command.args(["--seed", &settings.link_seed(plan.repetition, number).to_string()]);
    let name = format!("{}<-{}", to.host, to.source);
    let program = Program::start(&format!("link-{}-{}", to.host, to.source), command, &folder.join("logs"))?;
    let entry = LinkEntry {
        name,
        direction: to.direction,
        host: to.host.to_owned(),
        source: to.source.to_owned(),
        before_switch: uplink.is_some(),
        cap_kbit_per_s: None,
        impairment: None,
    };
    Ok(Link { remote: remote.name.clone(), entry, program })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn packets_lost_in_addition_to_the_model_are_a_problem() {
        let problem = |unseen: u64, no_room: u64| {
            let last = json!({"seen": 300, "lost": 50, "kernel_dropped": unseen, "overflowed": no_room});
            lost_beside_the_model("slow<-publisher", &last)
        };
        assert_eq!(problem(0, 0), None);
        assert_eq!(
            problem(100, 20).as_deref(),
            Some(
                "the link slow<-publisher lost 120 packets (30.00 %) that its model did not lose: 100 in the \
                 kernel, because its process did not keep up, and 20 because too many were in transit"
            )
        );
    }
}
