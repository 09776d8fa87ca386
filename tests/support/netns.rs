//! Hosts on one Ethernet switch, as network namespaces with their own addresses, ports and multicast.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::net::{Ipv4Addr, UdpSocket};
use std::path::Path;
use std::process::Command;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};

use nix::sched::{CloneFlags, setns};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use super::{Shared, shared};

/// The prefix of the namespaces' names, `ab-PID-NUMBER-HOST`. PID is the test program's process id.
const PREFIX: &str = "ab-";
const NAMESPACES: &str = "/run/netns";

/// Returns why network namespaces cannot be created on this machine; `None` if they can.
pub fn requires_root() -> Option<String> {
    static REASON: OnceLock<Option<String>> = OnceLock::new();
    REASON
        .get_or_init(|| {
            if !nix::unistd::geteuid().is_root() {
                return Some("network namespaces need root".to_owned());
            }
            let name = format!("{PREFIX}{}-probe", std::process::id());
            let created = try_run("ip", &["netns", "add", &name]);
            let _ = try_run("ip", &["netns", "del", &name]);
            created.err().map(|error| format!("network namespaces cannot be created: {error}"))
        })
        .clone()
}

/// Runs a program and returns its stdout; an error contains its stderr.
fn try_run(program: &str, arguments: &[&str]) -> Result<String, String> {
    let output =
        Command::new(program).args(arguments).output().map_err(|error| format!("{program}: {error}"))?;
    if output.status.success() {
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    } else {
        let stderr = String::from_utf8_lossy(&output.stderr);
        Err(format!("{program} {}: {} {}", arguments.join(" "), output.status, stderr.trim()))
    }
}

fn run(program: &str, arguments: &[&str]) {
    try_run(program, arguments).unwrap_or_else(|error| panic!("{error}"));
}

/// Runs `ip` with arguments that are separated by spaces.
fn ip(arguments: &str) {
    run("ip", &arguments.split_whitespace().collect::<Vec<_>>());
}

/// Kills all processes in a namespace and removes it. Ignores processes and namespaces that no longer exist.
fn remove(namespace: &str) {
    let pids = try_run("ip", &["netns", "pids", namespace]).unwrap_or_default();
    for pid in pids.split_whitespace().filter_map(|pid| pid.parse().ok()) {
        let _ = kill(Pid::from_raw(pid), Signal::SIGKILL);
    }
    let _ = try_run("ip", &["netns", "del", namespace]);
}

/// Removes the namespaces of test programs that no longer run.
fn remove_stale() {
    let Ok(entries) = fs::read_dir(NAMESPACES) else { return };
    for name in entries.flatten().filter_map(|entry| entry.file_name().into_string().ok()) {
        let pid = name.strip_prefix(PREFIX).and_then(|rest| rest.split('-').next()?.parse::<u32>().ok());
        if pid.is_some_and(|pid| !Path::new(&format!("/proc/{pid}")).exists()) {
            remove(&name);
        }
    }
}

/// Removes the shared memory of killed Fast DDS peers and ROS 2 nodes, except segments that a process has
/// mapped. The hosts share `/dev/shm`, and another version of Fast DDS aborts when it finds such a segment.
fn remove_stale_shared_memory() {
    let is_of_fast_dds = |name: &str| name.starts_with("fastrtps_") || name.starts_with("sem.fastrtps_");
    let mut mapped = BTreeSet::new();
    for process in fs::read_dir("/proc").into_iter().flatten().flatten() {
        let maps = fs::read_to_string(process.path().join("maps")).unwrap_or_default();
        let names = maps.lines().filter_map(|line| line.split_once("/dev/shm/"));
        mapped.extend(names.map(|(_, name)| name.to_owned()).filter(|name| is_of_fast_dds(name)));
    }
    for entry in fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
        let Ok(name) = entry.file_name().into_string() else { continue };
        // The lock file of a segment is never mapped; it is kept as long as its segment is.
        let segment = name.strip_suffix("_el").unwrap_or(&name);
        if is_of_fast_dds(&name) && !mapped.contains(segment) {
            let _ = fs::remove_file(entry.path());
        }
    }
}

thread_local! {
    /// Whether the test has a [`Net`]: a second one would wait forever for the first.
    static HAS_NET: Cell<bool> = const { Cell::new(false) };
}

/// Hosts on one switch, with a part of the machine (see [`shared`]). Dropping it kills all processes on its
/// hosts and removes them.
pub struct Net {
    id: String,
    hosts: Vec<Host>,
    _shared: Option<Shared>,
}

impl Net {
    /// Creates the hosts and connects each to the switch. Panics if [`requires_root`] returns a reason.
    pub fn new(hosts: &[&str]) -> Net {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        assert!(!HAS_NET.replace(true), "a test can have one Net: drop it before creating another");
        let shared = shared();
        remove_stale();
        remove_stale_shared_memory();

        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let pid = std::process::id();
        let id = format!("{PREFIX}{pid}-{number}");
        let mut net = Net { id, hosts: Vec::new(), _shared: shared };
        let switch = net.switch();
        ip(&format!("netns add {switch}"));
        ip(&format!("-n {switch} link add br0 type bridge mcast_snooping 0"));
        ip(&format!("-n {switch} link set br0 up"));
        // Otherwise the machine's firewall filters and reassembles the packets that pass the switch.
        let no_netfilter = "f=/proc/sys/net/bridge/bridge-nf-call-iptables; test ! -e $f || echo 0 > $f";
        run("nsenter", &[&format!("--net={NAMESPACES}/{switch}"), "sh", "-c", no_netfilter]);

        for (index, name) in hosts.iter().enumerate() {
            let namespace = format!("{}-{name}", net.id);
            let port = format!("p{index}");
            // Uses a different subnet for each Net, so that no peer remembers an address of an earlier one.
            let address = Ipv4Addr::new(10, 64 + (pid % 128) as u8, (number % 256) as u8, index as u8 + 1);
            ip(&format!("netns add {namespace}"));
            let host = Host { name: (*name).to_owned(), namespace, address, switch: switch.clone(), port };
            ip(&format!("-n {} link set lo up", host.namespace));
            host.plug_in();
            net.hosts.push(host);
        }
        net
    }

    fn switch(&self) -> String {
        format!("{}-switch", self.id)
    }

    /// The host with a given name.
    pub fn host(&self, name: &str) -> &Host {
        self.hosts.iter().find(|host| host.name == name).unwrap_or_else(|| panic!("no host '{name}'"))
    }
}

impl Drop for Net {
    fn drop(&mut self) {
        // By name instead of by `hosts`, so that a partly created Net is removed too.
        let prefix = format!("{}-", self.id);
        for entry in fs::read_dir(NAMESPACES).into_iter().flatten().flatten() {
            if let Some(name) = entry.file_name().to_str().filter(|name| name.starts_with(&prefix)) {
                remove(name);
            }
        }
        HAS_NET.set(false);
    }
}

/// One host of a [`Net`].
#[derive(Clone, Debug)]
pub struct Host {
    name: String,
    namespace: String,
    address: Ipv4Addr,
    switch: String,
    port: String,
}

impl Host {
    /// Its name in the [`Net`].
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its address on `eth0`.
    pub fn address(&self) -> Ipv4Addr {
        self.address
    }

    /// The name of its network namespace, as `ip netns list` shows it.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// Makes a command that will run on this host. The child's pid is that of the program itself. It shares
    /// everything but the network with the test: files, `/dev/shm`, process ids.
    pub fn command(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new("nsenter");
        command.arg(format!("--net={NAMESPACES}/{}", self.namespace)).arg(program);
        command
    }

    /// Runs a program on this host and returns its stdout; panics if it fails.
    pub fn run(&self, program: &str, arguments: &[&str]) -> String {
        let network = format!("--net={NAMESPACES}/{}", self.namespace);
        let mut all = vec![network.as_str(), program];
        all.extend_from_slice(arguments);
        try_run("nsenter", &all).unwrap_or_else(|error| panic!("{error}"))
    }

    /// Opens a UDP socket on this host, bound to its address on `eth0`. The test uses it from outside the
    /// host.
    pub fn udp_socket(&self) -> UdpSocket {
        self.within(|| UdpSocket::bind((self.address, 0)).unwrap())
    }

    /// Calls a function of the test on this host. Threads and sockets that it creates stay on the host.
    pub fn within<T: Send>(&self, call: impl FnOnce() -> T + Send) -> T {
        let enter = || {
            let namespace = File::open(Path::new(NAMESPACES).join(&self.namespace)).unwrap();
            setns(namespace, CloneFlags::CLONE_NEWNET).unwrap();
            call()
        };
        let joined = std::thread::scope(|scope| scope.spawn(enter).join());
        joined.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    }

    /// Connects this host to another one directly, in addition to the switch: each gets an interface of the
    /// given name with its address and prefix length (such as `192.168.7.1/24`).
    pub fn connect(&self, interface: &str, own_address: &str, other: &Host, other_address: &str) {
        let (here, there) = (&self.namespace, &other.namespace);
        ip(&format!("link add {interface} netns {here} type veth peer name {interface} netns {there}"));
        for (namespace, address) in [(here, own_address), (there, other_address)] {
            ip(&format!("-n {namespace} addr add {address} dev {interface}"));
            ip(&format!("-n {namespace} link set {interface} up"));
        }
        // The kernel reports the carrier up to a second later; a program that starts before that does not use
        // the interface.
        for host in [self, other] {
            let operstate = || host.run("ip", &["-br", "link", "show", "dev", interface]);
            super::wait_until("a carrier", || operstate().split_whitespace().nth(1) == Some("UP"));
        }
    }

    /// Adds an interface that is connected to nothing, like the network bridge of a container engine without
    /// containers.
    pub fn add_interface(&self, name: &str, address: &str) {
        let namespace = &self.namespace;
        ip(&format!("-n {namespace} link add {name} type veth peer name {name}-end"));
        ip(&format!("-n {namespace} addr add {address} dev {name}"));
        ip(&format!("-n {namespace} link set {name}-end up"));
        ip(&format!("-n {namespace} link set {name} up"));
    }

    /// Replaces the address of `eth0`, or removes it, as DHCP does.
    pub fn set_address(&self, address: Option<Ipv4Addr>) {
        let namespace = &self.namespace;
        ip(&format!("-n {namespace} addr flush dev eth0"));
        if let Some(address) = address {
            ip(&format!("-n {namespace} addr add {address}/24 dev eth0"));
            ip(&format!("-n {namespace} route replace 239.0.0.0/8 dev eth0"));
        }
    }

    /// Creates `eth0` with the host's address and connects it to the switch.
    pub fn plug_in(&self) {
        let Host { namespace, address, switch, port, .. } = self;
        ip(&format!("link add {port} netns {switch} type veth peer name eth0 netns {namespace}"));
        ip(&format!("-n {switch} link set {port} master br0 up"));
        ip(&format!("-n {namespace} addr add {address}/24 dev eth0"));
        ip(&format!("-n {namespace} link set eth0 up"));
        ip(&format!("-n {namespace} route add 239.0.0.0/8 dev eth0"));
    }

    /// Deletes `eth0`, as unplugging a USB adapter does.
    pub fn unplug(&self) {
        ip(&format!("-n {} link del eth0", self.namespace));
    }

    /// Sets the switch's port of this host up or down.
    pub fn set_link(&self, up: bool) {
        let state = if up { "up" } else { "down" };
        ip(&format!("-n {} link set {} {state}", self.switch, self.port));
    }

    /// The bytes that this host has sent on `eth0`.
    pub fn sent_bytes(&self) -> u64 {
        let counters = self.run("cat", &["/proc/net/dev"]);
        let counters = counters.lines().find_map(|line| line.trim().strip_prefix("eth0:"));
        // Eight columns of what it received come first.
        counters.and_then(|counters| counters.split_whitespace().nth(8)?.parse().ok()).expect("an eth0")
    }

    /// Sends a signal to every process on the host.
    pub fn signal_all(&self, signal: Signal) {
        let pids =
            try_run("ip", &["netns", "pids", &self.namespace]).unwrap_or_else(|error| panic!("{error}"));
        for pid in pids.split_whitespace() {
            kill(Pid::from_raw(pid.parse().expect("a process id")), signal).expect("a process of ours");
        }
    }

    /// Drops each arriving packet with a probability of 0 to 1; 0 ends it. The kernel's random numbers cannot
    /// be seeded.
    pub fn lose_incoming(&self, probability: f64) {
        self.run("iptables", &["-F", "INPUT"]);
        if probability > 0.0 {
            let probability = probability.to_string();
            let rule = ["-A", "INPUT", "-i", "eth0", "-m", "statistic", "--mode", "random"];
            let rule = [rule.as_slice(), &["--probability", &probability, "-j", "DROP"]].concat();
            self.run("iptables", &rule);
        }
    }
}

/// The open UDP ports in the network namespace of a process.
pub fn udp_ports(pid: i32) -> Vec<u16> {
    let mut ports: Vec<u16> = udp_sockets(pid).into_iter().map(|(port, _)| port).collect();
    ports.sort_unstable();
    ports.dedup();
    ports
}

/// The UDP ports of the sockets of one process.
pub fn udp_ports_of(pid: i32) -> Vec<u16> {
    let files = fs::read_dir(format!("/proc/{pid}/fd")).unwrap().flatten();
    let own: Vec<_> = files.filter_map(|file| fs::read_link(file.path()).ok()).collect();
    let is_own = |inode: &str| own.iter().any(|target| target.as_os_str() == &*format!("socket:[{inode}]"));
    udp_sockets(pid).into_iter().filter(|(_, inode)| is_own(inode)).map(|(port, _)| port).collect()
}

/// The port and the inode of each UDP socket in the network namespace of a process.
fn udp_sockets(pid: i32) -> Vec<(u16, String)> {
    let socket = |line: &str| {
        let mut fields = line.split_whitespace();
        let port = u16::from_str_radix(fields.nth(1)?.rsplit(':').next()?, 16).ok()?;
        Some((port, fields.nth(7)?.to_owned()))
    };
    let table = fs::read_to_string(format!("/proc/{pid}/net/udp")).unwrap();
    table.lines().skip(1).filter_map(socket).collect()
}
