//! `units`: prints or writes the systemd drop-ins that a configuration needs beside the installed units.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;

use super::{ConfigArguments, EXIT_USAGE, failed, print};
use crate::config::{
    self, Lane, MetricsListener, Scheduling, SchedulingPolicy, SecretSource, Settings, Standby,
};
use crate::model::TrafficClass;
use crate::process::MemoryNeeds;

/// The folder of the administrator's units (systemd.unit(5)).
pub(super) const FOLDER: &str = "/etc/systemd/system";

const INGRESS: &str = "adaptive-bridge-ingress.service";
const CONTROL: &str = "adaptive-bridge-control.service";

/// The services of the standbys. Without a standby in the configuration they end at once.
const INGRESS_STANDBY: &str = "adaptive-bridge-standby-ingress.service";
const CRITICAL_STANDBY: &str = "adaptive-bridge-standby-critical.service";

/// The first line of each written drop-in, by which a later run recognises it.
const HEADER: &str =
    "# Written by `adaptive-bridge units`, and to be written anew after a change of the configuration.\n";

/// The file name of each drop-in. It sorts after those of the package (10 and 50), so that it overrides them.
const FILE: &str = "60-configuration.conf";

const MIB: u64 = 1 << 20;

/// The highest real-time priority that the installed units of the critical path allow.
const MAX_PRIORITY: u8 = 50;

/// The arguments of `units`.
///
/// The installed units run ingress, the lanes critical and noncritical, and control, with
/// /etc/adaptive-bridge/config.yaml. Drop-ins add what a configuration needs beside them: further lanes, and
/// settings for scheduling, paths and another configuration file, and the limit of memory of each process.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Write the drop-ins, and remove obsolete ones of an earlier configuration
    #[arg(long)]
    write: bool,
    /// The folder of the drop-ins
    #[arg(long, value_name = "DIR", default_value = FOLDER)]
    folder: PathBuf,
    #[command(flatten)]
    config: ConfigArguments,
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    if !arguments.config.parameters.is_empty() {
        failed(&"--parameter: services read the configuration file only; write the value into it");
        return Err(ExitCode::from(EXIT_USAGE));
    }
    let settings = arguments.config.load()?;
    let wanted = DropIns::of(&settings, &arguments.config.file());
    let text = if arguments.write {
        wanted.write(&arguments.folder).map_err(|error| failed(&error))?
    } else {
        wanted.print(&arguments.folder)
    };
    print(text)?;
    Ok(ExitCode::SUCCESS)
}

/// The slice of all noncritical lanes.
const NONCRITICAL_SLICE: &str = "adaptive-bridge-noncritical.slice";

/// The memory of that slice in which the kernel lets its processes grow unhindered, in quarters of the limit.
/// Beyond it they are slowed down, as in the installed unit.
const UNHINDERED_QUARTERS: u64 = 3;

/// The limit of memory (`MemoryMax`) of each unit, in bytes: what the configuration may need.
pub(super) fn memory_limits(settings: &Settings) -> BTreeMap<String, u64> {
    let needs = MemoryNeeds::of(settings);
    let lanes = || settings.lanes.iter().zip(&needs.lanes).filter(|(lane, _)| lane.is_used());
    let of_lanes = lanes().map(|(lane, need)| (egress(lane.name.as_str()), need.limit_bytes()));
    let noncritical = lanes().filter(|(lane, _)| lane.class() == TrafficClass::Noncritical);
    let noncritical: Vec<u64> = noncritical.map(|(_, need)| need.limit_bytes()).collect();
    let mut limits = BTreeMap::from_iter(of_lanes);
    limits.insert(INGRESS.to_owned(), needs.ingress.limit_bytes());
    limits.insert(CONTROL.to_owned(), needs.control.limit_bytes());
    for (unit, standby) in standbys(settings) {
        limits.insert(standby.to_owned(), limits[&unit]);
    }
    if !noncritical.is_empty() {
        limits.insert(NONCRITICAL_SLICE.to_owned(), noncritical.into_iter().fold(0, u64::saturating_add));
    }
    limits
}

/// The services that have a standby, each with that of the standby.
fn standbys(settings: &Settings) -> Vec<(String, &'static str)> {
    let warm = |lane: &&Lane| lane.standby == Standby::Warm && lane.is_used();
    let lanes = settings.lanes.iter().filter(warm);
    let ingress = (settings.ingress_standby == Standby::Warm).then(|| (INGRESS.to_owned(), INGRESS_STANDBY));
    ingress.into_iter().chain(lanes.map(|lane| (egress(lane.name.as_str()), CRITICAL_STANDBY))).collect()
}

/// The drop-ins that a configuration needs, by unit.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct DropIns(BTreeMap<String, String>);

impl DropIns {
    /// The drop-ins that `settings`, read from the file `config`, need.
    pub fn of(settings: &Settings, config: &Path) -> Self {
        let mut drop_ins = BTreeMap::new();
        let mut add = |unit: String, section: &str, lines: Vec<String>| {
            if !lines.is_empty() {
                drop_ins.insert(unit, format!("{HEADER}[{section}]\n{}\n", lines.join("\n")));
            }
        };
        let installed = ["critical", "noncritical"];
        let lanes = settings.lanes.iter().filter(|lane| !installed.contains(&lane.name.as_str()));
        let standbys = standbys(settings);
        let wants = lanes.map(|lane| format!("Wants={}", egress(lane.name.as_str())));
        add("adaptive-bridge.target".to_owned(), "Unit", wants.collect());

        let limits = memory_limits(settings);
        if let Some(bytes) = limits.get(NONCRITICAL_SLICE) {
            let high = bytes / 4 * UNHINDERED_QUARTERS;
            let lines = vec![format!("MemoryHigh={}M", high / MIB), memory_max(*bytes)];
            add(NONCRITICAL_SLICE.to_owned(), "Slice", lines);
        }
        let common = common(settings, config);
        let mut service = |unit: String, configured: &Scheduling, critical: bool, own: Option<String>| {
            let standby =
                standbys.iter().find(|(of, _)| *of == unit).map(|(_, standby)| (*standby).to_owned());
            let limit = limits.get(&unit).map(|bytes| memory_max(*bytes));
            let own = own.into_iter().chain(limit).collect();
            let lines = [common.clone(), scheduling(configured, critical), own].concat();
            // Either of the two may have the role.
            for unit in [unit].into_iter().chain(standby) {
                add(unit, "Service", lines.clone());
            }
        };
        service(INGRESS.to_owned(), &settings.ingress_scheduling, true, None);
        for lane in &settings.lanes {
            let critical = lane.class() == TrafficClass::Critical;
            service(egress(lane.name.as_str()), &lane.scheduling, critical, None);
        }
        let own = match &settings.diagnostics.metrics {
            Some(MetricsListener::Unix(socket)) => socket.parent().map(read_write),
            _ => None,
        };
        service(CONTROL.to_owned(), &settings.control_scheduling, false, own);
        Self(drop_ins)
    }

    /// Whether `folder` has exactly these drop-ins, whatever their limits of memory.
    pub fn match_folder(&self, folder: &Path) -> bool {
        let is_there = |(unit, text): (&String, &String)| {
            let present = fs::read_to_string(path(folder, unit)).unwrap_or_default();
            without_memory(&present) == without_memory(text)
        };
        self.0.iter().all(is_there) && self.obsolete(folder).is_ok_and(|obsolete| obsolete.is_empty())
    }

    fn print(&self, folder: &Path) -> String {
        let text = |(unit, drop_in): (&String, _)| format!("# {}\n{drop_in}\n", path(folder, unit).display());
        self.0.iter().map(text).collect()
    }

    /// Writes the drop-ins and removes obsolete ones; returns a report of it with the command to run next.
    fn write(&self, folder: &Path) -> Result<String, String> {
        let at = |path: &Path, error: io::Error| format!("{}: {error}", path.display());
        let mut text = String::new();
        let mut done = |what: &str, path: &Path| text += &format!("{what} {}\n", path.display());
        for path in self.obsolete(folder).map_err(|error| at(folder, error))? {
            fs::remove_file(&path).map_err(|error| at(&path, error))?;
            // Fails while the folder has drop-ins of the administrator.
            let _ = path.parent().map(fs::remove_dir);
            done("removed", &path);
        }
        for (unit, drop_in) in &self.0 {
            let path = path(folder, unit);
            if is_written(&path, drop_in) {
                continue;
            }
            path.parent().map_or(Ok(()), fs::create_dir_all).map_err(|error| at(&path, error))?;
            fs::write(&path, drop_in).map_err(|error| at(&path, error))?;
            done("written", &path);
        }
        text.push_str(if text.is_empty() {
            "the drop-ins already match the configuration\n"
        } else {
            "next: systemctl daemon-reload && systemctl restart adaptive-bridge.target\n"
        });
        Ok(text)
    }

    /// Drop-ins that were written for an earlier configuration and are no longer needed.
    fn obsolete(&self, folder: &Path) -> io::Result<Vec<PathBuf>> {
        let entries = match fs::read_dir(folder) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries?,
        };
        let mut obsolete = Vec::new();
        for entry in entries {
            let entry = entry?;
            let name = entry.file_name();
            let Some(unit) = name.to_str().and_then(|name| name.strip_suffix(".d")) else { continue };
            let path = entry.path().join(FILE);
            let is_ours = || fs::read_to_string(&path).is_ok_and(|text| text.starts_with(HEADER));
            if unit.starts_with("adaptive-bridge") && !self.0.contains_key(unit) && is_ours() {
                obsolete.push(path);
            }
        }
        obsolete.sort();
        Ok(obsolete)
    }
}

/// The settings of a drop-in other than limits of memory.
fn without_memory(drop_in: &str) -> Vec<&str> {
    let is_setting =
        |line: &&str| line.contains('=') && !line.starts_with('#') && !line.starts_with("Memory");
    drop_in.lines().filter(is_setting).collect()
}

fn memory_max(bytes: u64) -> String {
    format!("MemoryMax={}M", bytes / MIB)
}

fn path(folder: &Path, unit: &str) -> PathBuf {
    folder.join(format!("{unit}.d")).join(FILE)
}

fn is_written(path: &Path, text: &str) -> bool {
    fs::read_to_string(path).is_ok_and(|present| present == text)
}

fn egress(lane: &str) -> String {
    format!("adaptive-bridge-egress@{lane}.service")
}

/// The lines that every service needs.
fn common(settings: &Settings, config: &Path) -> Vec<String> {
    let mut lines = Vec::new();
    let mut read = vec![config];
    if config != Path::new(config::DEFAULT_PATH) {
        let variable = format!("{}={}", config::PATH_VARIABLE, config.display());
        lines.push(format!("Environment={}", quoted(Path::new(&variable))));
    }
    if let Some(SecretSource::File(secret)) = &settings.security.secret {
        read.push(secret);
    }
    let is_home = |path: &&Path| ["/home", "/root", "/run/user"].iter().any(|home| path.starts_with(home));
    if read.iter().any(is_home) {
        lines.push("ProtectHome=read-only".to_owned());
    }
    lines.extend(settings.shared_memory.root_path.as_deref().map(read_write));
    lines
}

fn read_write(folder: &Path) -> String {
    format!("ReadWritePaths={}", quoted(folder))
}

/// A quoted word of a unit file, with special characters escaped (systemd.syntax(7)).
fn quoted(word: &Path) -> String {
    let escaped = word.display().to_string().replace('\\', r"\\").replace('"', "\\\"").replace('%', "%%");
    format!("\"{escaped}\"")
}

/// The lines that allow the configured scheduling where the installed unit does not.
fn scheduling(configured: &Scheduling, critical: bool) -> Vec<String> {
    let mut lines = Vec::new();
    let is_real_time = configured.policy != SchedulingPolicy::Other;
    if is_real_time && (!critical || configured.priority > MAX_PRIORITY) {
        lines.push(format!("LimitRTPRIO={}", configured.priority));
    }
    if is_real_time && !critical {
        lines.extend(["RestrictRealtime=no", "LimitRTTIME=500ms:1s"].map(str::to_owned));
    }
    if configured.lock_memory && !critical {
        lines.push("LimitMEMLOCK=infinity".to_owned());
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(yaml: &str) -> Settings {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), yaml).unwrap();
        config::load(Some(file.path()), &|_| None).unwrap()
    }

    const PLAIN: &str = "topics: [{id: scan, input_topic: /scan}]\n";
    const LANES: &str = "topics: [{id: scan, input_topic: /scan}]\n\
        lanes: {rviz: {}, noncritical: {scheduling: {policy: rr, priority: 7, lock_memory: true}}, \
        critical: {scheduling: {policy: fifo, priority: 80}}}\n\
        shared_memory: {root_path: /srv/bridge}\n\
        diagnostics: {metrics: 'unix:/run/metrics/bridge.sock'}\n";

    #[test]
    fn a_plain_configuration_gets_limits_of_memory_and_nothing_else() {
        let drop_ins = DropIns::of(&settings(PLAIN), Path::new(config::DEFAULT_PATH));
        let units: Vec<&str> = drop_ins.0.keys().map(String::as_str).collect();
        let [critical, noncritical] = ["critical", "noncritical"].map(egress);
        let standbys = [CRITICAL_STANDBY, INGRESS_STANDBY];
        assert_eq!(
            units,
            [&[CONTROL, &critical, &noncritical, INGRESS, NONCRITICAL_SLICE], &standbys[..]].concat()
        );
        for (unit, text) in &drop_ins.0 {
            assert!(without_memory(text).is_empty() && text.contains("\nMemoryMax="), "{unit}: {text}");
            assert_eq!(text.contains("\nMemoryHigh="), unit == NONCRITICAL_SLICE, "{unit}: {text}");
        }
        assert!(drop_ins.match_folder(Path::new("/nonexistent")));
    }

    #[test]
    fn the_installed_limits_are_enough_for_a_plain_configuration() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd");
        let installed_mib = |unit: &str| {
            let text = fs::read_to_string(folder.join(unit)).unwrap();
            let limit = text.lines().find_map(|line| line.strip_prefix("MemoryMax="));
            limit.map(|limit| limit.strip_suffix('M').unwrap().parse::<u64>().unwrap())
        };
        let limits = memory_limits(&settings(PLAIN));
        for unit in [CONTROL, NONCRITICAL_SLICE] {
            assert!(
                installed_mib(unit) >= Some(limits[unit] / MIB),
                "{unit} needs {} MiB",
                limits[unit] / MIB
            );
        }
        let responder = MemoryNeeds::of_responder().limit_bytes() / MIB;
        assert!(installed_mib("adaptive-bridge-responder@.service") >= Some(responder), "{responder} MiB");
        // A limit that is not made for the configuration could end the critical lane.
        let without = [INGRESS, "adaptive-bridge-egress@critical.service.d/50-critical.conf"];
        assert!(without.iter().all(|unit| installed_mib(unit).is_none()));
    }

    #[test]
    fn the_slice_of_noncritical_lanes_has_room_for_all_of_them() {
        let limits = memory_limits(&settings(LANES));
        assert_eq!(limits[NONCRITICAL_SLICE], limits[&egress("noncritical")] + limits[&egress("rviz")]);
        let unused = "topics: [{id: scan, input_topic: /scan, lanes: [critical]}]\n";
        assert!(!memory_limits(&settings(unused)).contains_key(NONCRITICAL_SLICE));
    }

    #[test]
    fn drop_ins_add_the_lanes_rights_and_paths_of_a_configuration() {
        let drop_ins = DropIns::of(&settings(LANES), Path::new("/home/robot/100% \"bridge\".yaml"));
        let lines = |unit: &str| {
            let lines = drop_ins.0[unit].lines().skip(1).filter(|line| !line.starts_with("MemoryMax="));
            lines.map(str::to_owned).collect::<Vec<_>>()
        };
        assert_eq!(lines("adaptive-bridge.target"), ["[Unit]", "Wants=adaptive-bridge-egress@rviz.service"]);
        let common = [
            "[Service]",
            r#"Environment="ADAPTIVE_BRIDGE_CONFIG=/home/robot/100%% \"bridge\".yaml""#,
            "ProtectHome=read-only",
            r#"ReadWritePaths="/srv/bridge""#,
        ];
        assert_eq!(lines("adaptive-bridge-ingress.service"), common);
        assert_eq!(lines(&egress("rviz")), common);
        assert_eq!(lines(&egress("critical"))[4..], ["LimitRTPRIO=80"]);
        let real_time =
            ["LimitRTPRIO=7", "RestrictRealtime=no", "LimitRTTIME=500ms:1s", "LimitMEMLOCK=infinity"];
        assert_eq!(lines(&egress("noncritical"))[4..], real_time);
        assert_eq!(lines("adaptive-bridge-control.service")[4..], [r#"ReadWritePaths="/run/metrics""#]);
    }

    #[test]
    fn a_standby_has_what_the_service_has() {
        let without = format!("{PLAIN}processes: {{ingress: {{standby: none}}}}\n");
        let drop_ins = DropIns::of(&settings(&without), Path::new("/srv/bridge.yaml")).0;
        let [standby, critical] = [CRITICAL_STANDBY, &egress("critical")].map(|unit| &drop_ins[unit]);
        assert_eq!(standby, critical);
        for line in ["Environment=", "MemoryMax="] {
            assert!(standby.contains(line), "{standby}");
        }
        assert!(!drop_ins.contains_key(INGRESS_STANDBY));
    }

    #[test]
    fn only_drop_ins_of_an_earlier_configuration_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let rich = DropIns::of(&settings(LANES), Path::new(config::DEFAULT_PATH));
        let plain = DropIns::of(&settings(PLAIN), Path::new(config::DEFAULT_PATH));
        assert!(plain.match_folder(folder.path()) && !rich.match_folder(folder.path()));
        assert!(rich.write(folder.path()).unwrap().contains("daemon-reload"));
        assert!(!plain.match_folder(folder.path()) && rich.match_folder(folder.path()));
        assert_eq!(rich.write(folder.path()).unwrap(), "the drop-ins already match the configuration\n");
        let own = folder.path().join("adaptive-bridge.target.d/mine.conf");
        fs::write(&own, "").unwrap();
        plain.write(folder.path()).unwrap();
        assert!(plain.match_folder(folder.path()) && own.exists());
        assert!(!path(folder.path(), &egress("rviz")).exists());
        // Only what doctor reports as a limit of memory differs.
        let limit = path(folder.path(), INGRESS);
        fs::write(&limit, format!("{HEADER}[Service]\nMemoryMax=1M\n")).unwrap();
        assert!(plain.match_folder(folder.path()));
        assert!(plain.write(folder.path()).unwrap().contains("written"));
    }
}
