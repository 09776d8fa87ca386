//! `responder`: answers probe requests beside a remote subscriber.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use super::{ConfigArguments, EXIT_CONFIG, bad_configuration, failed, roles, topic};
use crate::config::{self, Configuration, DdsNetwork, NetworkSelector, SecretSource, Settings};
use crate::model::{LaneName, TopicName, is_probe_id};
use crate::process::probes::Trust;
use crate::process::{self, ResponderOptions};
use crate::telemetry;

/// The arguments of `responder`.
///
/// It needs no configuration file: without one it uses the defaults, ROS_DOMAIN_ID and these options. With
/// the bridge's own file it uses the DDS domain of the subscriber's lane.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The subscriber's name in `subscribers:` of the bridge's configuration
    #[arg(long, value_name = "ID", value_parser = id)]
    id: String,
    /// DDS domain [default: the domain of the subscriber's lane, else $ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=232))]
    domain: Option<u16>,
    /// A network interface to use, by name or IPv4 address; repeatable [default: as configured, else all]
    #[arg(long = "network", value_name = "INTERFACE", value_parser = network)]
    networks: Vec<NetworkSelector>,
    /// Topic of the probe requests [default: as configured, else /adaptive_bridge/probe_req]
    #[arg(long, value_name = "TOPIC", value_parser = topic)]
    request_topic: Option<TopicName>,
    /// Topic of the probe responses [default: as configured, else /adaptive_bridge/probe_resp]
    #[arg(long, value_name = "TOPIC", value_parser = topic)]
    response_topic: Option<TopicName>,
    /// A file whose first line is the bridge's secret: sign responses, and answer signed requests only
    #[arg(long, value_name = "FILE")]
    secret_file: Option<PathBuf>,
    #[command(flatten)]
    config: ConfigArguments,
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    let loaded = config::load_or_default(arguments.config.path(), &arguments.config.parameters, &|name| {
        std::env::var(name).ok()
    });
    let Configuration { settings, inline_secret } = loaded.map_err(|error| bad_configuration(&error))?;
    telemetry::set_verbosity(settings.diagnostics.verbosity);
    let request_topic = arguments.request_topic.as_ref().unwrap_or(&settings.probes.request_topic);
    let response_topic = arguments.response_topic.as_ref().unwrap_or(&settings.probes.response_topic);
    if request_topic == response_topic {
        failed(&format!(
            "probe requests and responses must be on different topics; both are on {request_topic}"
        ));
        return Err(ExitCode::from(EXIT_CONFIG));
    }
    let mut security = settings.security.clone();
    if let Some(path) = &arguments.secret_file {
        security.enable_probe_hmac = true;
        security.secret = Some(SecretSource::File(path.clone()));
    }
    let trust = Trust::load(&security, inline_secret.as_ref()).map_err(|error| {
        failed(&error);
        ExitCode::from(EXIT_CONFIG)
    })?;
    let network = arguments.network(&settings);
    let options = ResponderOptions {
        id: &arguments.id,
        network: &network,
        graph_gid_bytes: settings.graph_gid_bytes,
        namespace: &settings.node_namespace,
        node_name: settings.node_name.as_ref(),
        request_topic,
        response_topic,
        trust,
        max_probe_rate_hz: security.max_probe_rate_hz,
    };
    roles::run(|stop| process::responder(options, stop))
}

impl Arguments {
    /// The DDS network of the subscriber's lane, with the values of the command line in place of its own.
    fn network(&self, settings: &Settings) -> DdsNetwork {
        let lane = settings.subscribers.get(&self.id).cloned().unwrap_or_else(LaneName::noncritical);
        let configured = settings.lane(&lane).map_or(&settings.input, |lane| &lane.network);
        DdsNetwork {
            domain_id: self.domain.unwrap_or(configured.domain_id),
            interfaces: match self.networks.as_slice() {
                [] => configured.interfaces.clone(),
                given => given.to_vec(),
            },
            static_peers: configured.static_peers.clone(),
        }
    }
}

fn id(text: &str) -> Result<String, String> {
    match is_probe_id(text) {
        true => Ok(text.to_owned()),
        false => Err("must be 1 to 127 bytes without control characters".to_owned()),
    }
}

fn network(text: &str) -> Result<NetworkSelector, String> {
    NetworkSelector::parse(text).ok_or_else(|| format!("must be {}", NetworkSelector::ALLOWED))
}
