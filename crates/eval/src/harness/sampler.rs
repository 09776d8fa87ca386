//! Samples kernel counters once a second during a run: ports of the switch, fragments and sockets of hosts,
//! CPU time and memory of processes.

use std::fmt::Display;
use std::fs;
use std::path::Path;

use adaptive_bridge::model::MonotonicNs;
use nix::unistd::{SysconfVar, sysconf};

use super::capture::{Capture, Tally};
use super::counters::{Interface, ProcFile, cpu_ticks, fragments, rss_bytes, snmp};
use super::csv::Csv;
use crate::bed::{Bed, Network};
use crate::error::EvalError;

/// The open `/proc` files of a host.
struct HostFiles {
    name: String,
    snmp: ProcFile,
    sockstat: ProcFile,
}

impl HostFiles {
    fn open(name: &str, network: &Network) -> Result<Self, EvalError> {
        let (snmp, sockstat) =
            (ProcFile::of_network(network, "snmp")?, ProcFile::of_network(network, "sockstat")?);
        Ok(Self { name: name.to_owned(), snmp, sockstat })
    }
}

/// Reads counters and writes them to the CSV files of a run.
pub(super) struct Sampler {
    ports: Vec<(String, String)>,
    interfaces: ProcFile,
    hosts: Vec<HostFiles>,
    captures: Vec<Capture>,
    tick_ms: u64,
    wire: Csv,
    kernel: Csv,
    processes: Csv,
    rtps: Csv,
}

impl Sampler {
    /// Opens the files of all hosts of a bed, and packet captures at the remote ones.
    pub fn open(bed: &Bed, remotes: &[&str], folder: &Path) -> Result<Self, EvalError> {
        let mut hosts = vec![HostFiles::open("switch", bed.switch())?];
        for host in bed.hosts() {
            hosts.push(HostFiles::open(&host.name, &host.network)?);
        }
        let captures: Result<Vec<Capture>, EvalError> =
            remotes.iter().map(|remote| Capture::open(remote, &bed.host(remote)?.network)).collect();
        let ticks_per_s =
            sysconf(SysconfVar::CLK_TCK).ok().flatten().and_then(|ticks| u64::try_from(ticks).ok());
        Ok(Self {
            ports: bed.hosts().iter().map(|host| (host.name.clone(), host.port.clone())).collect(),
            interfaces: ProcFile::of_network(bed.switch(), "dev")?,
            hosts,
            captures: captures?,
            tick_ms: 1_000 / ticks_per_s.unwrap_or(100).clamp(1, 1_000),
            wire: Csv::create(
                folder,
                "wire.csv",
                "time_ns,port,to_host_bytes,to_host_packets,from_host_bytes,from_host_packets,to_host_dropped",
            )?,
            kernel: Csv::create(
                folder,
                "kernel.csv",
                "time_ns,host,fragment_queues,fragment_memory_bytes,reassembled,reassembly_failed,\
                 reassembly_timed_out,udp_in_errors,udp_buffer_errors",
            )?,
            processes: Csv::create(folder, "processes.csv", "time_ns,process,pid,cpu_ms,rss_bytes")?,
            rtps: Csv::create(folder, "rtps.csv", &format!("time_ns,port,direction,{}", Tally::COLUMNS))?,
        })
    }

    /// Counts the packets captured since the last call. Must be called often, as the kernel's buffer is
    /// limited.
    pub fn count_packets(&mut self) {
        self.captures.iter_mut().for_each(Capture::count_packets);
    }

    /// Reads and records all counters once. `queue_drops` are the packets that caps have dropped, by port.
    pub fn sample(
        &mut self,
        now: MonotonicNs,
        processes: &[(String, i32)],
        queue_drops: &[(String, u64)],
    ) -> Result<(), EvalError> {
        let interfaces = self.interfaces.read();
        for (host, port) in &self.ports {
            let Some(seen) = Interface::find(interfaces, port) else { continue };
            let in_queue = queue_drops.iter().find(|(of, _)| of == port).map_or(0, |(_, drops)| *drops);
            self.wire.row(&[
                &now.0,
                host,
                &seen.sent_bytes,
                &seen.sent_packets,
                &seen.received_bytes,
                &seen.received_packets,
                &(seen.sent_dropped + in_queue),
            ])?;
        }
        for host in &mut self.hosts {
            let (queues, memory) = fragments(host.sockstat.read()).unwrap_or_default();
            let text = host.snmp.read();
            let [whole, failed, late] =
                ["ReasmOKs", "ReasmFails", "ReasmTimeout"].map(|name| snmp(text, "Ip", name).unwrap_or(0));
            let [errors, buffer] =
                ["InErrors", "RcvbufErrors"].map(|name| snmp(text, "Udp", name).unwrap_or(0));
            self.kernel
                .row(&[&now.0, &host.name, &queues, &memory, &whole, &failed, &late, &errors, &buffer])?;
        }
        for capture in &self.captures {
            for (direction, tally) in capture.tallies() {
                let counts = tally.row();
                let mut row: Vec<&dyn Display> = vec![&now.0, &capture.port, &direction];
                row.extend(counts.iter().map(|count| count as &dyn Display));
                self.rtps.row(&row)?;
            }
        }
        for (name, pid) in processes {
            let read = |file: &str| fs::read_to_string(format!("/proc/{pid}/{file}")).unwrap_or_default();
            // A process that has just ended is left out.
            if let (Some(ticks), Some(rss)) = (cpu_ticks(&read("stat")), rss_bytes(&read("status"))) {
                self.processes.row(&[&now.0, name, pid, &(ticks * self.tick_ms), &rss])?;
            }
        }
        Ok(())
    }

    /// Flushes the files.
    pub fn end(mut self) -> Result<(), EvalError> {
        self.wire.flush()?;
        self.kernel.flush()?;
        self.rtps.flush()?;
        self.processes.flush()
    }
}

/// Parses the packets that a cap has dropped from the output of `tc -s -j qdisc show dev PORT`.
pub(super) fn queue_drops(json: &str) -> u64 {
    let queues: serde_json::Value = serde_json::from_str(json).unwrap_or_default();
    let list = queues.as_array().map(Vec::as_slice).unwrap_or_default();
    let roots = list.iter().filter(|queue| queue["kind"] == "tbf");
    roots.filter_map(|queue| queue["drops"].as_u64()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_drops_of_a_cap_are_those_of_its_token_bucket() {
        let json = "[{\"kind\":\"tbf\",\"root\":true,\"drops\":7},{\"kind\":\"noqueue\",\"drops\":1}]";
        assert_eq!(queue_drops(json), 7);
        assert_eq!(queue_drops(""), 0);
    }
}
