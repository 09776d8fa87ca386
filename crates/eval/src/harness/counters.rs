//! Parses the kernel's counters of interfaces, fragments and processes from files of `/proc`.

use std::fs::File;
use std::io::{Read, Seek};

use crate::bed::Network;
use crate::error::EvalError;

/// An open file of `/proc` that is read repeatedly. It stays in the network namespace it was opened in.
pub(super) struct ProcFile {
    file: File,
    text: String,
}

impl ProcFile {
    /// Opens `/proc/thread-self/net/NAME` in a namespace.
    pub fn of_network(network: &Network, name: &str) -> Result<Self, EvalError> {
        let path = format!("/proc/thread-self/net/{name}");
        let open = || File::open(&path).map_err(|error| EvalError::file(path.as_ref(), &error));
        Ok(Self { file: network.within(open)?, text: String::new() })
    }

    /// Reads the current text; empty if that fails.
    pub fn read(&mut self) -> &str {
        self.text.clear();
        if self.file.rewind().and_then(|()| self.file.read_to_string(&mut self.text)).is_err() {
            self.text.clear();
        }
        &self.text
    }
}

/// Counters of an interface; sent and received are from the interface's point of view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Interface {
    pub received_bytes: u64,
    pub received_packets: u64,
    pub sent_bytes: u64,
    pub sent_packets: u64,
    pub sent_dropped: u64,
}

impl Interface {
    /// Parses the counters of an interface from `net/dev`.
    pub fn find(text: &str, name: &str) -> Option<Self> {
        let mut lines = text.lines().filter_map(|line| line.split_once(':'));
        let (_, values) = lines.find(|(interface, _)| interface.trim() == name)?;
        let values: Vec<u64> = values.split_whitespace().map_while(|value| value.parse().ok()).collect();
        Some(Self {
            received_bytes: *values.first()?,
            received_packets: *values.get(1)?,
            sent_bytes: *values.get(8)?,
            sent_packets: *values.get(9)?,
            sent_dropped: *values.get(11)?,
        })
    }
}

/// Parses a value from `net/snmp`, in which a line of names precedes each line of values.
pub(super) fn snmp(text: &str, protocol: &str, name: &str) -> Option<u64> {
    let mut lines = text.lines().filter_map(|line| line.split_once(": "));
    let (_, names) = lines.find(|(found, _)| *found == protocol)?;
    let (_, values) = lines.find(|(found, _)| *found == protocol)?;
    let at = names.split_whitespace().position(|found| found == name)?;
    values.split_whitespace().nth(at)?.parse().ok()
}

/// Parses the number of incomplete datagrams and their memory from `net/sockstat`.
pub(super) fn fragments(text: &str) -> Option<(u64, u64)> {
    let line = text.lines().find_map(|line| line.strip_prefix("FRAG: "))?;
    let mut words = line.split_whitespace();
    let queues = words.nth(1)?.parse().ok()?;
    Some((queues, words.nth(1)?.parse().ok()?))
}

/// Parses the CPU time in clock ticks from `/proc/PID/stat`.
pub(super) fn cpu_ticks(stat: &str) -> Option<u64> {
    // The second field is the name in parentheses; it may contain any character.
    let (_, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_whitespace().skip(11);
    let user: u64 = fields.next()?.parse().ok()?;
    Some(user + fields.next()?.parse::<u64>().ok()?)
}

/// Parses the resident memory in bytes from `/proc/PID/status`.
pub(super) fn rss_bytes(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(line.split_whitespace().next()?.parse::<u64>().ok()? * 1_024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interfaces_are_read_by_name() {
        let text = "Inter-|   Receive  |  Transmit\n face |bytes packets\n    lo: 1 2 0 0 0 0 0 0 1 2 0 0 0 0 0 0\n  \
                    p12: 100 3 0 0 0 0 0 7 200 4 0 5 0 0 0 0\n";
        let expected = Interface {
            received_bytes: 100,
            received_packets: 3,
            sent_bytes: 200,
            sent_packets: 4,
            sent_dropped: 5,
        };
        assert_eq!(Interface::find(text, "p12"), Some(expected));
        assert_eq!(Interface::find(text, "p1"), None);
        assert_eq!(Interface::find("p1: 1 2", "p1"), None);
    }

    #[test]
    fn protocol_counters_are_read_by_name() {
        let text = "Ip: Forwarding ReasmTimeout ReasmOKs\nIp: 1 7 9\nUdp: InErrors\nUdp: 3\n";
        assert_eq!(snmp(text, "Ip", "ReasmTimeout"), Some(7));
        assert_eq!(snmp(text, "Udp", "InErrors"), Some(3));
        assert_eq!(snmp(text, "Udp", "ReasmOKs"), None);
        assert_eq!(snmp("", "Ip", "ReasmOKs"), None);
        assert_eq!(fragments("UDP: inuse 1\nFRAG: inuse 5 memory 4096\n"), Some((5, 4096)));
        assert_eq!(fragments("FRAG: inuse"), None);
    }

    #[test]
    fn processes_are_read_with_any_name() {
        assert_eq!(cpu_ticks("12 (a) b) S 1 2 3 4 5 6 7 8 9 10 100 20 0 0"), Some(120));
        assert_eq!(cpu_ticks("12"), None);
        assert_eq!(rss_bytes("Name: a\nVmRSS:\t  10 kB\n"), Some(10_240));
        let own = std::fs::read_to_string("/proc/self/stat").expect("Linux has it");
        assert!(cpu_ticks(&own).is_some());
    }
}
