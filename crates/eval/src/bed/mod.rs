//! Test beds: hosts connected to one switch, created for a run and removed after it.

mod docker;
mod netns;
mod network;
pub mod stale;

use std::any::Any;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process::Command;

use clap::ValueEnum;
use serde::Serialize;

use super::error::EvalError;
use super::scenario::Switch;
pub use docker::switch as docker_switch;
pub use network::Network;

/// Removes the leftovers of harness processes that no longer run; returns a description of each.
pub fn remove_leftovers() -> Vec<String> {
    let mut removed = docker::remove_leftovers();
    removed.extend(stale::remove_all());
    removed
}

/// The kind of a test bed's hosts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum BedKind {
    /// Network namespaces
    Netns,
    /// Containers on a bridge network
    Docker,
}

impl BedKind {
    /// The name used on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Netns => "netns",
            Self::Docker => "docker",
        }
    }

    /// Why this machine cannot create such a bed with that switch; `None` when it can.
    pub fn missing(self, switch: Switch) -> Option<String> {
        match self {
            Self::Netns => netns::missing(switch),
            Self::Docker => docker::missing(switch),
        }
    }

    /// Creates a bed with these hosts. If the switch reassembles fragments, the packets of `sender` can be
    /// impaired before it. `shared` are the folders that the hosts' programs read and write.
    ///
    /// # Errors
    /// A command failed.
    pub fn make(
        self,
        hosts: &[String],
        sender: &str,
        switch: Switch,
        shared: &[&Path],
    ) -> Result<Bed, EvalError> {
        match self {
            Self::Netns => netns::make(hosts, sender, switch),
            Self::Docker => docker::make(hosts, shared),
        }
    }
}

/// Hosts and their switch. Dropping a bed kills the processes on its hosts and removes the hosts.
pub struct Bed {
    hosts: Vec<Host>,
    switch: Network,
    /// Removes the hosts when it is dropped.
    _remover: Box<dyn Any>,
}

/// A host of a test bed.
#[derive(Clone, Debug)]
pub struct Host {
    /// The host's name in the scenario.
    pub name: String,
    /// Its address on the switch's network.
    pub address: Ipv4Addr,
    /// Its network namespace.
    pub network: Network,
    /// The command prefix that runs a program on the host.
    entry: Vec<String>,
    /// The interface of the switch that leads to the host.
    pub port: String,
    /// The network namespace between the host and the switch, in which packets can be lost before the switch
    /// sees them.
    pub uplink: Option<Network>,
}

impl Bed {
    /// Returns the host with that name.
    ///
    /// # Errors
    /// The bed has no such host.
    pub fn host(&self, name: &str) -> Result<&Host, EvalError> {
        let host = self.hosts.iter().find(|host| host.name == name);
        host.ok_or_else(|| EvalError::new(format!("the bed has no host '{name}'")))
    }

    /// All hosts of the bed.
    pub fn hosts(&self) -> &[Host] {
        &self.hosts
    }

    /// The switch's network namespace, which has the ports of all hosts.
    pub fn switch(&self) -> &Network {
        &self.switch
    }
}

impl Host {
    /// Builds a command that runs a program on this host, with the child's own pid. The program is killed
    /// when the thread that started it ends, so that it does not outlive a killed harness.
    pub fn command(&self, program: &Path) -> Command {
        let mut words = self.entry.iter();
        let mut command = Command::new(words.next().map_or("nsenter", String::as_str));
        command.args(words).args(["setpriv", "--pdeathsig", "KILL"]).arg(program);
        command
    }
}
