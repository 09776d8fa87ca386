//! The back end that uses `tc netem`, which impairs packets that an interface sends. Received packets are
//! first redirected through an intermediate device (ifb), so that the link is in the same place as that of
//! NFQUEUE: in the receiver's network namespace, before fragments are reassembled, and for one source only.

use std::net::Ipv4Addr;
use std::os::fd::BorrowedFd;

use adaptive_bridge::model::MonotonicNs;
use serde_json::Value;

use super::backend::Backend;
use super::delay::NormalDelay;
use super::error::ImpairmentError;
use super::gilbert_elliott::GilbertElliott;
use super::link::{Counters, HELD_MAX, Impairment, LinkState};
use super::system::{run, words};

/// Prefix of the names of the harness's ifb devices.
const DEVICE: &str = "abimpair";

/// Why netem does not work on this machine; `None` when it works. Tries it in the current network namespace
/// on a separate device, with a delay too: not every package of `tc` includes the file of its distribution.
pub(super) fn missing(queue: u16) -> Option<String> {
    let device = format!("abprobe{queue}");
    let _ = run(&words(&format!("ip link del {device}")));
    let commands = [
        format!("ip link add {device} type ifb"),
        format!(
            "tc qdisc add dev {device} root netem limit 10 delay 1ms 1ms distribution normal \
             loss gemodel 1% 10% 50% 1%"
        ),
        format!("tc qdisc add dev {device} ingress"),
        format!(
            "tc filter add dev {device} parent ffff: protocol ip prio 1 u32 match ip src 192.0.2.1/32 \
             action mirred egress redirect dev {device}"
        ),
    ];
    let failed = commands.iter().find_map(|line| run(&words(line)).err());
    let _ = run(&words(&format!("ip link del {device}")));
    failed.map(|error| error.to_string())
}

/// The command lines of one impairment.
struct Commands {
    /// The intermediate device.
    device: String,
    /// The interface through which packets of the source arrive.
    interface: String,
    /// Priority of the filter: different for each link at the interface, and never 0, which means any.
    priority: u32,
    source: Ipv4Addr,
    impairment: Impairment,
}

impl Commands {
    fn new(source: Ipv4Addr, interface: String, queue: u16, impairment: Impairment) -> Self {
        // tc takes 16 bits.
        let priority = (u32::from(queue) + 1).min(u32::from(u16::MAX));
        Self { device: format!("{DEVICE}{queue}"), interface, priority, source, impairment }
    }

    fn netem(&self, verb: &str, state: LinkState) -> String {
        let mut line = format!("tc qdisc {verb} dev {} root netem limit {HELD_MAX}", self.device);
        match state {
            LinkState::On => {
                line.push_str(&delay(&self.impairment.delay));
                line.push_str(&loss(&self.impairment.loss));
            }
            LinkState::Off => {}
            LinkState::Down => line.push_str(" loss 100%"),
        }
        line
    }

    /// The commands that set up the link, each with the command that undoes it, unless undoing another one
    /// includes it. The ingress discipline must exist.
    fn set_up(&self) -> [(String, Option<String>); 4] {
        let Self { device, interface, priority, source, .. } = self;
        let filter = format!("dev {interface} parent ffff: protocol ip prio {priority}");
        [
            (format!("ip link add {device} type ifb"), Some(format!("ip link del {device}"))),
            (format!("ip link set {device} up"), None),
            (self.netem("add", LinkState::On), None),
            (
                format!(
                    "tc filter add {filter} u32 match ip src {source}/32 action mirred egress redirect dev {device}"
                ),
                Some(format!("tc filter del {filter}")),
            ),
        ]
    }

    /// Adds the interface's ingress discipline, or shares the existing one of the interface's other links.
    fn add_ingress(&self) -> Result<(), ImpairmentError> {
        let interface = &self.interface;
        let Err(error) = run(&words(&format!("tc qdisc add dev {interface} ingress"))) else { return Ok(()) };
        let Ok(filters) = self.filters() else { return Err(error) };
        if can_share(&filters, self.source) {
            return Ok(());
        }
        let show = format!("`tc filter show dev {interface} parent ffff:` lists it");
        let what = format!(
            "a filter of another program at {interface}, or a link that also impairs {}; {show}",
            self.source
        );
        Err(ImpairmentError::Unexpected { what })
    }

    /// Removes the interface's ingress discipline if no link has a filter left in it.
    fn remove_ingress(&self) -> Result<(), ImpairmentError> {
        if self.filters()?.trim().is_empty() {
            run(&words(&format!("tc qdisc del dev {} ingress", self.interface)))?;
        }
        Ok(())
    }

    fn filters(&self) -> Result<String, ImpairmentError> {
        run(&words(&format!("tc filter show dev {} parent ffff:", self.interface)))
    }

    fn statistics(&self) -> String {
        format!("tc -s -j qdisc show dev {}", self.device)
    }
}

/// Whether all filters in the output of `tc filter show` redirect to the harness's links, and none of them
/// matches this source: of two filters that match it, only the first would get its packets.
fn can_share(filters: &str, source: Ipv4Addr) -> bool {
    let to_link = format!("mirred (Egress Redirect to device {DEVICE}");
    let of_source = format!("match {:08x}/", u32::from(source));
    filters.lines().all(|line| match line.trim_start() {
        line if line.starts_with("filter ") => line.contains(" u32 "),
        line if line.starts_with("action ") => line.contains(&to_link),
        line => !line.starts_with(&of_source),
    })
}

/// The loss arguments of netem, which takes the loss in the bad state before that in the good state:
/// `p r 1-h 1-k` (tc-netem(8)).
fn loss(model: &GilbertElliott) -> String {
    if *model == GilbertElliott::CLEAN {
        return String::new();
    }
    if model.loss_good() == model.loss_bad() {
        return format!(" loss {}", percent(model.loss_good()));
    }
    let [p, r, bad, good] = [model.p(), model.r(), model.loss_bad(), model.loss_good()].map(percent);
    format!(" loss gemodel {p} {r} {bad} {good}")
}

fn delay(delay: &NormalDelay) -> String {
    let (mean, sigma) = (decimal(delay.mean_ms()), decimal(delay.sigma_ms()));
    match (delay.is_none(), delay.sigma_ms() > 0.0) {
        (true, _) => String::new(),
        (false, false) => format!(" delay {mean}ms"),
        (false, true) => format!(" delay {mean}ms {sigma}ms distribution normal"),
    }
}

fn percent(share: f64) -> String {
    format!("{}%", decimal(share * 100.0))
}

/// Formats a number without an exponent and without trailing zeros.
fn decimal(value: f64) -> String {
    let text = format!("{value:.6}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// The counters of the queueing discipline.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Statistics {
    passed: u64,
    dropped: u64,
    held: u64,
}

impl Statistics {
    fn parse(json: &str) -> Option<Self> {
        let qdiscs: Value = serde_json::from_str(json).ok()?;
        let netem = qdiscs.as_array()?.iter().find(|qdisc| qdisc["kind"] == "netem")?;
        let number = |name: &str| netem[name].as_u64();
        Some(Self { passed: number("packets")?, dropped: number("drops")?, held: number("qlen")? })
    }

    fn arrived(&self) -> u64 {
        self.passed + self.dropped + self.held
    }
}

/// An impairment by `tc netem`. Its random numbers are not seeded: that needs a newer kernel and a newer `tc`
/// than most machines have.
pub struct Netem {
    commands: Commands,
    undo: Vec<String>,
    state: LinkState,
    last: Statistics,
    counters: Counters,
}

impl Netem {
    /// Starts to impair the packets that the current network namespace receives from `source`. Removes the
    /// leftovers of a killed process that used the same number.
    ///
    /// # Errors
    /// A command failed, or the interface has an ingress discipline with filters of other programs.
    pub fn open(source: Ipv4Addr, queue: u16, impairment: &Impairment) -> Result<Self, ImpairmentError> {
        let route = run(&words(&format!("ip -j route get {source}")))?;
        let interface = interface_of(&route).ok_or_else(|| ImpairmentError::Unexpected {
            what: format!("no interface in the route to {source}: {}", route.trim()),
        })?;
        let commands = Commands::new(source, interface, queue, *impairment);
        if run(&words(&format!("ip link show {}", commands.device))).is_ok() {
            for undo in commands.set_up().into_iter().rev().filter_map(|(_, undo)| undo) {
                let _ = run(&words(&undo));
            }
        }
        commands.add_ingress()?;
        let set_up = commands.set_up();
        let mut netem = Self {
            commands,
            undo: Vec::new(),
            state: LinkState::On,
            last: Statistics::default(),
            counters: Counters::default(),
        };
        for (line, undo) in set_up {
            run(&words(&line))?;
            netem.undo.extend(undo);
        }
        Ok(netem)
    }

    /// Adds the packets since the last call to the counters of the link's current state.
    fn count(&mut self) -> Result<(), ImpairmentError> {
        let output = run(&words(&self.commands.statistics()))?;
        let now = Statistics::parse(&output)
            .ok_or_else(|| ImpairmentError::Unexpected { what: format!("statistics of tc: {output}") })?;
        self.add(now);
        Ok(())
    }

    fn add(&mut self, now: Statistics) {
        let arrived = now.arrived().saturating_sub(self.last.arrived());
        let dropped = now.dropped.saturating_sub(self.last.dropped);
        self.counters.seen += arrived;
        match self.state {
            LinkState::On => {
                self.counters.judged += arrived;
                self.counters.lost += dropped;
            }
            LinkState::Off => self.counters.overflowed += dropped,
            LinkState::Down => self.counters.cut += dropped,
        }
        self.counters.passed = now.passed;
        self.counters.held = now.held;
        self.last = now;
    }
}

impl Backend for Netem {
    fn name(&self) -> &'static str {
        "netem"
    }

    fn is_seeded(&self) -> bool {
        false
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn next_release(&self) -> Option<MonotonicNs> {
        None
    }

    fn work(&mut self) -> Result<(), ImpairmentError> {
        Ok(())
    }

    fn switch(&mut self, state: LinkState) -> Result<(), ImpairmentError> {
        self.count()?;
        run(&words(&self.commands.netem("change", state)))?;
        self.state = state;
        Ok(())
    }

    fn set(&mut self, loss: GilbertElliott, delay: NormalDelay) -> Result<(), ImpairmentError> {
        self.commands.impairment = Impairment { loss, delay, ..self.commands.impairment };
        match self.state {
            LinkState::On => run(&words(&self.commands.netem("change", LinkState::On))).map(drop),
            LinkState::Off | LinkState::Down => Ok(()),
        }
    }

    fn state(&self) -> LinkState {
        self.state
    }

    fn counters(&mut self) -> Result<Counters, ImpairmentError> {
        self.count()?;
        Ok(self.counters)
    }

    fn kernel_dropped(&self) -> Result<u64, ImpairmentError> {
        Ok(0)
    }
}

impl Drop for Netem {
    fn drop(&mut self) {
        for line in self.undo.drain(..).rev() {
            if let Err(error) = run(&words(&line)) {
                tracing::warn!(%error, "could not remove an impairment");
            }
        }
        if let Err(error) = self.commands.remove_ingress() {
            tracing::warn!(%error, "could not remove an ingress discipline");
        }
    }
}

/// Parses the interface from the output of `ip -j route get`.
fn interface_of(json: &str) -> Option<String> {
    let routes: Value = serde_json::from_str(json).ok()?;
    Some(routes.get(0)?.get("dev")?.as_str()?.to_owned())
}

#[cfg(test)]
mod tests {
    use super::super::levels::{Level, Reading};
    use super::*;

    fn commands(level: Level, reading: Reading, mean_ms: f64, sigma_ms: f64) -> Commands {
        let delay = NormalDelay::new(mean_ms, sigma_ms).expect("in range");
        let impairment = Impairment { loss: level.model(reading), delay, seed: 1 };
        Commands::new(Ipv4Addr::new(10, 1, 2, 3), "eth0".to_owned(), 7, impairment)
    }

    #[test]
    fn the_loss_in_the_bad_state_comes_before_that_in_the_good_one() {
        let line = |level, reading| commands(level, reading, 20.0, 10.0).netem("add", LinkState::On);
        let head = "tc qdisc add dev abimpair7 root netem limit 20000 delay 20ms 10ms distribution normal";
        for (level, printed, run) in [
            (Level::Clean, "", ""),
            (Level::Mild, " loss gemodel 1% 15% 30% 0.5%", " loss gemodel 1% 15% 0.5% 30%"),
            (Level::Moderate, " loss gemodel 3% 15% 40% 0.5%", " loss gemodel 3% 15% 0.5% 40%"),
            (Level::Strong, " loss gemodel 2% 10% 50% 1%", " loss gemodel 2% 10% 1% 50%"),
        ] {
            assert_eq!(line(level, Reading::AsPrinted), format!("{head}{printed}"));
            assert_eq!(line(level, Reading::AsRun), format!("{head}{run}"));
        }
    }

    #[test]
    fn a_row_of_a_trace_uses_a_loss_without_states() {
        let mut commands = commands(Level::Clean, Reading::AsRun, 40.5, 2.25);
        let head =
            "tc qdisc change dev abimpair7 root netem limit 20000 delay 40.5ms 2.25ms distribution normal";
        for (loss, arguments) in [(0.0, ""), (0.0123, " loss 1.23%"), (1.0, " loss 100%")] {
            commands.impairment.loss = GilbertElliott::independent(loss).expect("a probability");
            assert_eq!(commands.netem("change", LinkState::On), format!("{head}{arguments}"));
        }
    }

    #[test]
    fn a_link_that_is_off_or_down_is_changed_in_place() {
        let commands = commands(Level::Strong, Reading::AsPrinted, 0.25, 0.0);
        let head = "tc qdisc change dev abimpair7 root netem limit 20000";
        assert_eq!(
            commands.netem("change", LinkState::On),
            format!("{head} delay 0.25ms loss gemodel 2% 10% 50% 1%")
        );
        assert_eq!(commands.netem("change", LinkState::Off), head);
        assert_eq!(commands.netem("change", LinkState::Down), format!("{head} loss 100%"));
    }

    #[test]
    fn what_is_set_up_is_undone() {
        let commands = commands(Level::Clean, Reading::AsRun, 0.0, 0.0);
        let (lines, undo): (Vec<_>, Vec<_>) = commands.set_up().into_iter().unzip();
        assert_eq!(
            lines,
            [
                "ip link add abimpair7 type ifb",
                "ip link set abimpair7 up",
                "tc qdisc add dev abimpair7 root netem limit 20000",
                "tc filter add dev eth0 parent ffff: protocol ip prio 8 u32 match ip src 10.1.2.3/32 action \
                 mirred egress redirect dev abimpair7",
            ]
        );
        let undo: Vec<String> = undo.into_iter().flatten().collect();
        assert_eq!(undo, ["ip link del abimpair7", "tc filter del dev eth0 parent ffff: protocol ip prio 8"]);
        let of =
            |queue| Commands::new(commands.source, "eth0".to_owned(), queue, commands.impairment).priority;
        assert_eq!([0, 1, u16::MAX].map(of), [1, 2, 65_535], "tc takes 16 bits, and 0 for any");
    }

    #[test]
    fn an_ingress_discipline_is_shared_with_links_of_other_sources_only() {
        // The output of iproute2 6.1 for a link.
        let filter = |number: u32, action: &str| {
            let priority = number + 1;
            format!(
                "filter protocol ip pref {priority} u32 chain 0 \n\
                 filter protocol ip pref {priority} u32 chain 0 fh 80{number}: ht divisor 1 \n\
                 filter protocol ip pref {priority} u32 chain 0 fh 80{number}::800 order 2048 key ht 80{number} \
                 bkt 0 terminal flowid not_in_hw \n  match 0a01020{priority}/ffffffff at 12\n\
                 \taction order 1: {action}\n\tindex {priority} ref 1 bind 1\n\n"
            )
        };
        let redirect =
            |number, to| filter(number, &format!("mirred (Egress Redirect to device {to}) stolen"));
        let links = redirect(0, "abimpair0") + &redirect(1, "abimpair1");
        let source = |last| Ipv4Addr::new(10, 1, 2, last);
        assert!(can_share("", source(1)) && can_share(&links, source(3)));
        assert!(!can_share(&links, source(1)) && !can_share(&links, source(2)));
        for another in [
            redirect(2, "eth1"),
            filter(2, "gact action drop"),
            "filter protocol all pref 9 matchall chain 0 \n".to_owned(),
        ] {
            assert!(!can_share(&(links.clone() + &another), source(9)), "{another}");
        }
    }

    #[test]
    fn statistics_are_counted_by_the_state_of_the_link() {
        // The output of iproute2 6.1, shortened.
        let json = |packets, drops, qlen| {
            format!(
                "[{{\"kind\":\"netem\",\"handle\":\"8001:\",\"root\":true,\"refcnt\":2,\"options\":{{}},\
                 \"bytes\":1,\"packets\":{packets},\"drops\":{drops},\"overlimits\":0,\"requeues\":0,\
                 \"backlog\":0,\"qlen\":{qlen}}}]"
            )
        };
        let mut netem = Netem {
            commands: commands(Level::Mild, Reading::AsRun, 0.0, 0.0),
            undo: Vec::new(),
            state: LinkState::On,
            last: Statistics::default(),
            counters: Counters::default(),
        };
        netem.add(Statistics::parse(&json(60, 30, 10)).expect("statistics"));
        netem.state = LinkState::Down;
        netem.add(Statistics::parse(&json(70, 55, 0)).expect("statistics"));
        let expected =
            Counters { seen: 125, judged: 100, lost: 30, cut: 25, passed: 70, ..Counters::default() };
        assert_eq!(netem.counters, expected);
        assert_eq!(Statistics::parse("[]"), None);
        assert_eq!(Statistics::parse("no JSON"), None);
        assert_eq!(Statistics::parse("[{\"kind\":\"netem\",\"packets\":-1}]"), None);
    }

    #[test]
    fn the_interface_is_that_of_the_route() {
        let json =
            "[{\"dst\":\"10.1.2.3\",\"dev\":\"eth0\",\"prefsrc\":\"10.1.2.4\",\"uid\":0,\"cache\":[]}]";
        assert_eq!(interface_of(json).as_deref(), Some("eth0"));
        assert_eq!(interface_of("[]"), None);
        assert_eq!(interface_of(""), None);
    }
}
