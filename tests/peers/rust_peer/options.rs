//! The command line: that of the other peers, as far as RustDDS has the features.

use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::time::Duration;

use adaptive_bridge::config::{DdsNetwork, NetworkSelector};
use adaptive_bridge::dds::{DdsError, Participant, ParticipantOptions};
use adaptive_bridge::model::{DdsType, Durability, Encapsulation, History, Reliability, TypeHash};
use clap::{Parser, ValueEnum};

use super::payload::Filling;

/// A DDS peer on RustDDS: publishes and subscribes serialized samples of any type (see tests/peers/README.md)
#[derive(Parser, Debug)]
#[command(name = "rust_peer")]
pub struct Options {
    #[arg(long)]
    pub role: Role,
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u16).range(..=232))]
    domain: u16,
    #[arg(long, default_value = "rt/scan")]
    pub topic: String,
    #[arg(long = "type", default_value = "sensor_msgs::msg::dds_::LaserScan_")]
    pub type_name: String,
    #[arg(long, default_value = "")]
    pub type_hash: String,
    #[arg(long, default_value = "r", value_parser = reliability)]
    pub reliability: Reliability,
    #[arg(long, default_value = "v", value_parser = durability)]
    pub durability: Durability,
    #[arg(long, default_value = "10", value_parser = history)]
    pub history: History,
    /// The library's own default
    #[arg(long, default_value_t = 8192)]
    pub max_samples: usize,
    #[arg(long, default_value = "100", value_parser = milliseconds)]
    pub max_blocking_ms: Duration,
    #[arg(long)]
    interface: Option<Ipv4Addr>,

    /// 0 is as fast as write returns
    #[arg(long, default_value_t = 100.0, value_parser = not_negative)]
    pub rate: f64,
    /// 0 is no limit
    #[arg(long, default_value_t = 0)]
    pub count: u64,
    /// 0 is no limit
    #[arg(long, default_value = "0", value_parser = seconds)]
    pub duration: Duration,
    #[arg(long, default_value_t = 0)]
    pub first_seq: u64,
    #[arg(long, value_delimiter = ',')]
    size: Vec<usize>,
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    #[arg(long)]
    pub plain: bool,
    #[arg(long, default_value = "00010000", value_parser = encapsulation)]
    pub encap: Encapsulation,
    #[arg(long)]
    pub payload_file: Option<PathBuf>,
    #[arg(long, default_value = "0", value_parser = milliseconds)]
    pub source_age_ms: Duration,
    #[arg(long, default_value_t = 0)]
    pub wait_match: u64,
    #[arg(long)]
    pub hold: bool,
    /// 0 is no pause
    #[arg(long, default_value_t = 0)]
    pub burst: u64,
    #[arg(long)]
    pub prime: bool,
    /// Accepted without effect, as by the peer on Cyclone DDS: the library has no such setting
    #[arg(long)]
    heartbeat_ms: Option<f64>,
    #[arg(long, default_value = "0", value_parser = seconds)]
    pub linger: Duration,

    #[arg(long)]
    pub opaque: bool,
    #[arg(long)]
    pub summary: bool,
    #[arg(long)]
    pub record: Option<PathBuf>,
    #[arg(long, default_value = "0", value_parser = seconds)]
    pub stall_every: Duration,
    #[arg(long, default_value = "0", value_parser = seconds)]
    pub stall_for: Duration,
    /// Bytes of an identifier in this peer's entry in the ROS 2 graph
    #[arg(long, default_value = "24", value_parser = ["16", "24"])]
    gid_bytes: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Role {
    Pub,
    Sub,
}

/// The size of a publisher's samples unless `--size` sets another one.
const DEFAULT_SIZE: usize = 2948;

/// The bytes that may wait in the library for a KEEP_ALL subscriber, from which its depth follows. The DDS
/// module has no KEEP_ALL readers, and the library keeps samples that were read until newer ones fill the
/// depth.
const WAITING_BYTES: usize = 64 << 20;

impl Options {
    pub fn dds_type(&self) -> DdsType<'_> {
        DdsType {
            name: &self.type_name,
            hash: TypeHash::from_hex(self.type_hash.as_bytes()),
            has_keys: false,
        }
    }

    /// What the payloads contain after their front.
    pub fn filling(&self) -> Filling {
        if self.plain { Filling::Plain } else { Filling::Random { seed: self.seed } }
    }

    /// The size of a publisher's sample; sizes take turns.
    pub fn size_to_send(&self, sequence: u64) -> usize {
        self.expected_size(sequence).unwrap_or(DEFAULT_SIZE)
    }

    /// The size that a subscriber checks; `None` without `--size`.
    pub fn expected_size(&self, sequence: u64) -> Option<usize> {
        let turns = self.size.len() as u64;
        Some(self.size[sequence.checked_rem(turns)? as usize])
    }

    /// HISTORY depth of a subscriber.
    pub fn reader_depth(&self) -> u32 {
        match self.history {
            History::KeepLast { depth } => depth,
            History::KeepAll => {
                let largest = self.size.iter().copied().max().unwrap_or(DEFAULT_SIZE).max(1);
                (WAITING_BYTES / largest).clamp(16, 1024) as u32
            }
        }
    }

    /// The peer's participant, which is a node of the ROS 2 graph as well.
    pub fn join(&self) -> Result<Participant, DdsError> {
        let interfaces = self.interface.into_iter().map(NetworkSelector::Address).collect();
        Participant::open(&ParticipantOptions {
            network: &DdsNetwork { interfaces, ..DdsNetwork::of_domain(self.domain) },
            namespace: "/peers".to_owned(),
            node_name: "rust_peer".to_owned(),
            graph_gid_bytes: if self.gid_bytes == "16" { 16 } else { 24 },
            dscp: 0,
        })
    }
}

fn reliability(text: &str) -> Result<Reliability, String> {
    match text {
        "r" => Ok(Reliability::Reliable),
        "be" => Ok(Reliability::BestEffort),
        _ => Err("expected r or be".to_owned()),
    }
}

fn durability(text: &str) -> Result<Durability, String> {
    match text {
        "v" => Ok(Durability::Volatile),
        "tl" => Ok(Durability::TransientLocal),
        _ => Err("expected v or tl".to_owned()),
    }
}

fn history(text: &str) -> Result<History, String> {
    match text.parse() {
        _ if text == "all" => Ok(History::KeepAll),
        Ok(depth) if depth > 0 => Ok(History::KeepLast { depth }),
        _ => Err("expected all, or a number from 1 on".to_owned()),
    }
}

fn encapsulation(text: &str) -> Result<Encapsulation, String> {
    let digits = text.len() == 8 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    let header = u32::from_str_radix(text, 16).ok().filter(|_| digits);
    let header = header.ok_or("expected eight hexadecimal digits; RustDDS sends no sample without them")?;
    Ok(Encapsulation(header.to_be_bytes()))
}

fn not_negative(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number: &f64| *number >= 0.0 && *number <= 1e9);
    number.ok_or_else(|| "expected a number from 0 to 1e9".to_owned())
}

fn seconds(text: &str) -> Result<Duration, String> {
    Ok(Duration::from_secs_f64(not_negative(text)?))
}

fn milliseconds(text: &str) -> Result<Duration, String> {
    Ok(Duration::from_secs_f64(not_negative(text)? / 1e3))
}
