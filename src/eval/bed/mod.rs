//! Test beds: hosts on one switch, made for a run and removed after it.

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

/// What the hosts are made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum BedKind {
    /// Network namespaces
    Netns,
    /// Containers on a bridge network
    Docker,
}

impl BedKind {
    /// As the command line has it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Netns => "netns",
            Self::Docker => "docker",
        }
    }

    /// Why this machine can't make such a bed with that switch; `None` when it can.
    pub fn missing(self, switch: Switch) -> Option<String> {
        match self {
            Self::Netns => netns::missing(switch),
            Self::Docker => docker::missing(switch),
        }
    }

    /// Makes a bed with these hosts. What `sender` sends is impaired before a switch that puts fragments
    /// together. `shared` are the folders that the hosts' programs read and write.
    ///
    /// # Errors
    /// The machine refused something.
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

/// Hosts and their switch. Dropping it kills what runs on them and removes them.
pub struct Bed {
    hosts: Vec<Host>,
    switch: Network,
    /// Dropped with it.
    _remover: Box<dyn Any>,
}

/// One host.
#[derive(Clone, Debug)]
pub struct Host {
    /// Its name in the scenario.
    pub name: String,
    /// Its address on the switch's network.
    pub address: Ipv4Addr,
    /// Its interfaces, ports and tables.
    pub network: Network,
    /// The program, with arguments, that runs another one there.
    entry: Vec<String>,
    /// The interface of the switch that leads to it.
    pub port: String,
    /// What its cable to the switch leads through, where packets can be lost before the switch sees them.
    pub uplink: Option<Network>,
}

impl Bed {
    /// The host of that name.
    ///
    /// # Errors
    /// There is none.
    pub fn host(&self, name: &str) -> Result<&Host, EvalError> {
        let host = self.hosts.iter().find(|host| host.name == name);
        host.ok_or_else(|| EvalError::new(format!("the bed has no host '{name}'")))
    }

    /// All hosts.
    pub fn hosts(&self) -> &[Host] {
        &self.hosts
    }

    /// Where the ports are.
    pub fn switch(&self) -> &Network {
        &self.switch
    }
}

impl Host {
    /// A command that will run on this host, under the pid of the child itself. It is killed when the thread
    /// that starts it ends, so that nothing outlives a harness that is killed.
    pub fn command(&self, program: &Path) -> Command {
        let mut words = self.entry.iter();
        let mut command = Command::new(words.next().map_or("nsenter", String::as_str));
        command.args(words).args(["setpriv", "--pdeathsig", "KILL"]).arg(program);
        command
    }
}
