//! Chaos: processes of the bridge are killed and stopped at random, its configuration file is edited and
//! reloaded, a second publisher comes and goes, and malformed datagrams and announcements of participants
//! that do not exist arrive all along. At the end every sample of the publisher is forwarded, or dropped with
//! a named reason, and all sums agree. With standbys and without.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN, STANDBYS, outputs};
use support::bridge::refused;
use support::netns::udp_ports;
use support::peer::{Peer, Received, RunningPeer, Sent};

use super::forged_participants;
use super::hostile::{self, Random};

/// How long the chaos lasts, in seconds; half an hour in `make soak`.
const SECONDS: u64 = 40;
const SECONDS_VARIABLE: &str = "ADAPTIVE_BRIDGE_TEST_CHAOS_S";
const RATE_HZ: f64 = 200.0;
/// Some 1,000 forged announcements a second in all, 260 for each of four processes, which admits 32: few
/// enough to leave the CPUs to the chaos.
const FORGED_DIVISOR: u32 = 16;
const ROLES: [&str; 4] = ["ingress", "egress-critical", "egress-noncritical", "control"];
/// The second processes of the roles that have a standby.
const SECOND: [&str; 2] = ["ingress-2", "egress-critical-2"];

/// Sends a signal to a process that may have ended already.
fn try_signal(pid: i32, signal: Signal) {
    let _ = kill(Pid::from_raw(pid), signal);
}

fn number(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("not a number: {value}"))
}

fn sum(counters: &Value) -> u64 {
    counters.as_object().unwrap().values().map(number).sum()
}

/// The account of the publisher that sent most.
fn account_of(status: &Value) -> Value {
    let accounts = status["routes"][0]["publishers"].as_array().unwrap();
    accounts.iter().max_by_key(|account| number(&account["received"])).unwrap().clone()
}

struct Chaos<'b> {
    bed: &'b Bed,
    with_standbys: bool,
    random: Random,
    /// The publisher that comes and goes.
    visitor: Option<RunningPeer>,
    visitors: u64,
    events: BTreeMap<&'static str, u32>,
}

impl Chaos<'_> {
    fn event(&mut self) {
        const EVENTS: [&str; 4] = ["kill", "stop", "reload", "publisher"];
        let event = EVENTS[self.random.below(EVENTS.len())];
        *self.events.entry(event).or_default() += 1;
        let second = if self.with_standbys { &SECOND[..] } else { &[] };
        let children = [&ROLES[..], second].concat();
        let process = self.bed.pid(children[self.random.below(children.len())]);
        match event {
            "kill" => try_signal(process, Signal::SIGKILL),
            "stop" => {
                // Up to 3 s: the watchdog of `up` restarts a process that is stopped for longer than 2 s.
                try_signal(process, Signal::SIGSTOP);
                self.pause(100, 3_000);
                try_signal(process, Signal::SIGCONT);
            }
            "reload" => self.edit_and_reload(),
            _ => self.toggle_publisher(),
        }
    }

    fn pause(&mut self, min_ms: usize, max_ms: usize) {
        let pause_ms = min_ms + self.random.below(max_ms - min_ms);
        std::thread::sleep(Duration::from_millis(pause_ms as u64));
    }

    fn edit_and_reload(&mut self) {
        let rate_hz = 1 + self.random.below(30);
        let edited = [
            format!("noncritical: {{max_rate_hz: {rate_hz}}}"),
            // One more lane, which waits for a restart.
            "noncritical: {}, rviz: {class: noncritical}".to_owned(),
            "noncritical: {max_rate_hz: fast}".to_owned(),
            "noncritical: [".to_owned(),
        ];
        let edited = &edited[self.random.below(edited.len())];
        self.write_and_reload(&self.yaml(edited));
    }

    /// The configuration with these lanes beside the critical one.
    fn yaml(&self, lanes: &str) -> String {
        let standby = if self.with_standbys { "{standby: warm}" } else { "{}" };
        format!("{SCAN}processes: {{ingress: {standby}}}\nlanes: {{critical: {standby}, {lanes}}}\n")
    }

    fn write_and_reload(&self, yaml: &str) {
        self.bed.bridge.write_config(&format!("instance: {{instance}}\n{yaml}"));
        let output = self.bed.bridge.run("reload");
        let code = output.status.code();
        assert!(code.is_some_and(|code| code != 101), "reload: {output:?}");
    }

    /// Ends or kills the second publisher if it runs, else starts it; every other one is BEST_EFFORT.
    fn toggle_publisher(&mut self) {
        if let Some(mut visitor) = self.visitor.take() {
            if self.random.below(2) == 0 {
                visitor.kill9();
            } else {
                let _: Sent = visitor.end();
            }
            return;
        }
        self.visitors += 1;
        // Numbers that no other publisher uses: the subscriber recognises a repeated sample by its number.
        let peer = Peer::cyclone().keep_last(1_000).rate_hz(50.0).first_seq(self.visitors << 32);
        let peer = if self.visitors.is_multiple_of(2) { peer.best_effort() } else { peer };
        self.visitor = Some(self.bed.publish(peer, INPUT));
    }

    /// Ends the chaos, and waits until all processes run.
    fn end(mut self) {
        if self.visitor.is_some() {
            self.toggle_publisher();
        }
        self.write_and_reload(&self.yaml("noncritical: {}"));
        self.bed.bridge.wait_status("all processes running", |status| {
            let processes = status["processes"].as_array().unwrap();
            let is_running =
                |role| processes.iter().any(|one| one["name"] == role && one["state"] == "running");
            ROLES.into_iter().all(is_running)
        });
        println!("{:?}, {} more publishers", self.events, self.visitors);
    }
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn in_chaos_every_sample_is_forwarded_or_dropped_with_a_named_reason() {
        chaos("in_chaos_every_sample_is_forwarded_or_dropped_with_a_named_reason", false);
    }

    #[test]
    fn in_chaos_with_standbys_every_sample_is_forwarded_or_dropped_with_a_named_reason() {
        chaos("in_chaos_with_standbys_every_sample_is_forwarded_or_dropped_with_a_named_reason", true);
    }

    fn chaos(test: &str, with_standbys: bool) {
        let _alone = support::exclusive();
        let standbys = if with_standbys { STANDBYS } else { "" };
        let Some(bed) = Bed::start(test, &format!("{SCAN}{standbys}")) else { return };
        let subscriber = bed.subscribe("critical", Peer::cyclone().keep_last(4_000), CRITICAL);
        let publisher = bed.publish(Peer::cyclone().keep_last(1_000).rate_hz(RATE_HZ), INPUT);
        subscriber.wait_received(200);
        let first_sequence = account_of(&bed.bridge.status())["first_sequence"].clone();

        let seconds = std::env::var(SECONDS_VARIABLE).map_or(SECONDS, |text| text.parse().unwrap());
        let seed = u64::from(std::process::id()) | 1;
        println!("seed {seed}");
        let ports = udp_ports(bed.pid("ingress"));
        let ended = AtomicBool::new(false);
        let (address, attacker) = (bed.host("bridge").address(), bed.host("slow"));
        let (socket, processes) = (attacker.udp_socket(), bed.discovery_addresses());
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let go_on = || !ended.load(Ordering::Relaxed);
                attacker.within(|| hostile::send(address, &ports, seed, &[], go_on))
            });
            let goes_on = |_| !ended.load(Ordering::Relaxed);
            scope.spawn(move || forged_participants::announce(&socket, &processes, FORGED_DIVISOR, goes_on));
            let random = Random(seed);
            let (visitor, events) = (None, BTreeMap::new());
            let mut chaos = Chaos { bed: &bed, with_standbys, random, visitor, visitors: 0, events };
            let until = Instant::now() + Duration::from_secs(seconds);
            while Instant::now() < until {
                chaos.event();
                chaos.pause(200, 1_500);
            }
            ended.store(true, Ordering::Relaxed);
            chaos.end();
        });
        subscriber.wait_received(subscriber.received() + 400);

        let sent: Sent = publisher.end();
        sent.assert_not_blocked();
        bed.bridge.wait_status("the last sample received by ingress", |status| {
            account_of(status)["last_sequence"].as_u64() == Some(sent.ok)
        });
        let status = bed.wait_accounted();
        let refused = ROLES.map(|role| refused(&status, role, "too_many_participants"));
        assert!(refused.iter().any(|refused| *refused > 0), "no forged announcement has arrived");
        let account = account_of(&status);
        // What it sent before it had discovered ingress: no fault adds to it.
        assert_eq!(account["first_sequence"], first_sequence, "{account}");
        let before_first = number(&first_sequence) - 1;
        let taken = number(&account["received"]) + number(&account["lost_upstream"]);
        assert_eq!(before_first + taken, sent.ok, "{sent:?} {account}");
        // The publisher keeps what it sends in 5 s, and no restart takes that long.
        assert_eq!(account["lost_upstream"], 0, "{account}");
        let route = &status["routes"][0];
        let published = number(&route["received"]) - sum(&route["drops"]);
        assert_eq!(number(&route["published"]), published, "{route}");
        for lane in outputs(&status) {
            assert_eq!(number(&lane["received"]), published, "{lane}");
            assert_eq!(number(&lane["forwarded"]) + sum(&lane["drops"]), published, "{lane}");
        }
        let critical = outputs(&status).find(|output| output["lane"] == "critical").unwrap();
        let forwarded = number(&critical["forwarded"]);
        subscriber.wait_received(forwarded);
        let received: Received = subscriber.end();
        assert_eq!((received.bad, received.duplicates), (0, 0), "{received:?}");
        // What a restarted lane writes before it has matched its subscribers counts as `no_reader`; this one
        // may have received it.
        // And one for each kill may have been written and not yet counted: it counts as `lane_down`.
        let processes = [bed.pids("egress-critical"), bed.pids("egress-critical-2")].concat();
        let kills = processes.len() as u64 - 1;
        let uncounted = kills.min(number(&critical["drops"]["lane_down"]));
        let possible = forwarded..=forwarded + number(&critical["drops"]["no_reader"]) + uncounted;
        assert!(possible.contains(&received.received), "{received:?} of {critical}");
        println!(
            "{} sent, repeated {}; critical lane: {forwarded} forwarded, {}",
            sent.ok, route["repeated"], critical["drops"]
        );
        bed.end();
    }
}
