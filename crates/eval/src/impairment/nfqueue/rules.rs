//! The iptables rule that sends packets to the queue. It is in the table `mangle`, chain `PREROUTING`, where
//! IP fragments are still separate packets, unless connection tracking has reassembled them before.

use std::collections::BTreeSet;
use std::fs;
use std::net::Ipv4Addr;

use super::super::error::ImpairmentError;
use super::super::system::{run, words};

/// The comment that marks the harness's rules.
const MARK: &str = "adaptive-bridge-eval";
const TABLE: &str = "iptables -w 5 -t mangle";

/// The kernel's list of the queues in the current network namespace that have a listener.
const QUEUES: &str = "/proc/self/net/netfilter/nfnetlink_queue";

/// An installed rule; dropping it removes the rule.
pub(super) struct Rule {
    removal: Vec<String>,
}

impl Rule {
    /// Installs a rule that sends packets from `source` (and for `destination`, if there is one) to `queue`.
    pub(super) fn install(
        source: Ipv4Addr,
        destination: Option<Ipv4Addr>,
        queue: u16,
    ) -> Result<Self, ImpairmentError> {
        let line = |verb| words(&command_line(verb, source, destination, queue));
        run(&line("-A"))?;
        Ok(Self { removal: line("-D") })
    }
}

impl Drop for Rule {
    fn drop(&mut self) {
        if let Err(error) = run(&self.removal) {
            tracing::warn!(%error, "could not remove an iptables rule; the next run will remove it");
        }
    }
}

/// The command line of a rule. `--queue-bypass` lets packets pass when no program listens, so that a killed
/// harness does not cut off the host.
fn command_line(verb: &str, source: Ipv4Addr, destination: Option<Ipv4Addr>, queue: u16) -> String {
    let to = destination.map_or(String::new(), |destination| format!(" -d {destination}/32"));
    format!(
        "{TABLE} {verb} PREROUTING -s {source}/32{to} -m comment --comment {MARK} -j NFQUEUE \
         --queue-num {queue} --queue-bypass"
    )
}

/// Removes rules that killed processes of the harness have left: those whose queue has no listener.
pub(super) fn remove_stale() -> Result<(), ImpairmentError> {
    let rules = run(&words(&format!("{TABLE} -S PREROUTING")))?;
    let listened = listened_queues();
    for rule in rules.lines().filter(|rule| is_stale(rule, &listened)) {
        let removal = rule.replacen("-A", "-D", 1).replace('"', "");
        run(&words(&format!("{TABLE} {removal}")))?;
        tracing::info!(rule, "removed the iptables rule of a process that no longer runs");
    }
    Ok(())
}

/// Whether a line of `iptables -S` is a rule of the harness whose queue has no listener.
fn is_stale(rule: &str, listened: &BTreeSet<u16>) -> bool {
    let mut words = rule.split_whitespace().map(|word| word.trim_matches('"'));
    let is_ours = words.clone().any(|word| word == MARK);
    let queue = words.find(|word| *word == "--queue-num").and_then(|_| words.next()?.parse().ok());
    is_ours && rule.starts_with("-A ") && queue.is_some_and(|queue| !listened.contains(&queue))
}

fn listened_queues() -> BTreeSet<u16> {
    // Without the file, the kernel does not support queues or no program has used one yet.
    let list = fs::read_to_string(QUEUES).unwrap_or_default();
    list.lines().filter_map(|line| column(line, 0)?.try_into().ok()).collect()
}

/// Whether a process listens on a queue in the current network namespace.
pub(super) fn is_listened(queue: u16) -> bool {
    listened_queues().contains(&queue)
}

/// Packets that the kernel has dropped because the queue or the listener's socket was full.
pub(super) fn dropped_by_kernel(queue: u16) -> Result<u64, ImpairmentError> {
    let list = fs::read_to_string(QUEUES).map_err(|error| ImpairmentError::system(QUEUES, error))?;
    dropped_in(&list, queue)
        .ok_or_else(|| ImpairmentError::Unexpected { what: format!("queue {queue} in {QUEUES}: {list}") })
}

/// Parses the drops of a queue. The columns of the list are: queue, port, waiting, copy mode, copy range,
/// dropped (queue full), dropped (socket full), last number, 1.
fn dropped_in(list: &str, queue: u16) -> Option<u64> {
    let line = list.lines().find(|line| column(line, 0) == Some(u64::from(queue)))?;
    Some(column(line, 5)? + column(line, 6)?)
}

fn column(line: &str, at: usize) -> Option<u64> {
    line.split_whitespace().nth(at)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_harness_rules_to_a_queue_without_a_listener_are_stale() {
        let ours = "-A PREROUTING -s 10.1.2.3/32 -m comment --comment adaptive-bridge-eval -j NFQUEUE \
                    --queue-num 7 --queue-bypass";
        let quoted = ours.replace("adaptive-bridge-eval", "\"adaptive-bridge-eval\"");
        let others = ours.replace("adaptive-bridge-eval", "firewall");
        let free = BTreeSet::from([1, 8]);
        let taken = BTreeSet::from([7]);
        for (rule, listened, stale) in [
            (ours, &free, true),
            (&quoted, &free, true),
            (ours, &taken, false),
            (&others, &free, false),
            ("-P PREROUTING ACCEPT", &free, false),
            ("-A PREROUTING -m comment --comment adaptive-bridge-eval -j DROP", &free, false),
        ] {
            assert_eq!(is_stale(rule, listened), stale, "{rule}");
        }
    }

    #[test]
    fn the_drops_of_the_kernel_are_parsed() {
        let list = "    1  12345     0 2    20     1     2      99  1\n    7   4242     3 2    20    10    \
                    5     123  1\n";
        assert_eq!(dropped_in(list, 7), Some(15));
        assert_eq!(dropped_in(list, 1), Some(3));
        assert_eq!(dropped_in(list, 2), None);
        assert_eq!(dropped_in("", 2), None);
    }

    #[test]
    fn a_rule_has_source_queue_and_the_harness_comment() {
        assert_eq!(
            command_line("-A", Ipv4Addr::new(10, 1, 2, 3), None, 7),
            "iptables -w 5 -t mangle -A PREROUTING -s 10.1.2.3/32 -m comment --comment adaptive-bridge-eval \
             -j NFQUEUE --queue-num 7 --queue-bypass"
        );
        let to = Some(Ipv4Addr::new(10, 1, 2, 4));
        let line = command_line("-D", Ipv4Addr::new(10, 1, 2, 3), to, 7);
        assert!(line.contains(" -D PREROUTING -s 10.1.2.3/32 -d 10.1.2.4/32 -m comment "), "{line}");
    }
}
