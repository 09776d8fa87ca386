//! The responder: answers the probe requests of bridges, on the host of a remote subscriber.
//!
//! It needs no bridge and no shared memory on its host. Any message from the network is cheap to handle: the
//! responder checks each request once, and counts the ones that it refuses.

use std::time::Duration;

use tracing::{debug, info, warn};

use super::HOUSEKEEPING_MS;
use super::count_log::RefusalLog;
use super::error::RoleError;
use super::notify::{Meter, Notifier};
use super::probes::{PROBE_READER_QOS, PROBE_TYPE, PROBE_WRITER_QOS, RequestHandler, Trust};
use super::stop::Stop;
use crate::clock;
use crate::config::DdsNetwork;
use crate::dds::{Inbox, Participant, ParticipantOptions, RawWriter, TakePayload};
use crate::model::{
    Encapsulation, MonotonicNs, NodeName, ProbeRefusal, RefusalCounts, SourceTimestamp, TopicName,
};
use crate::telemetry;

/// How long the responder waits for a probe request before it logs a warning.
const SILENCE_MS: u64 = 10_000;

/// Requests handled in one turn, so that a flood of them does not delay housekeeping.
const REQUESTS_PER_TURN: usize = 64;

/// Samples that the DDS library may hold for the BEST_EFFORT response writer.
const WINDOW_SAMPLES: usize = 16;

/// The configuration of a responder.
#[derive(Debug)]
pub struct ResponderOptions<'a> {
    /// The id of the subscriber in the bridge's configuration; see
    /// [`is_probe_id`](crate::model::is_probe_id).
    pub id: &'a str,
    /// Domain and interfaces.
    pub network: &'a DdsNetwork,
    /// Length in bytes of a graph identifier: 24 up to ROS 2 Humble, 16 since Iron.
    pub graph_gid_bytes: usize,
    /// The namespace of its node.
    pub namespace: &'a str,
    /// The name of its node; else one that is made from the id.
    pub node_name: Option<&'a NodeName>,
    /// Topic of the requests.
    pub request_topic: &'a TopicName,
    /// Topic of the responses.
    pub response_topic: &'a TopicName,
    /// Which requests are trusted.
    pub trust: Trust,
    /// Requests of one sender that are answered per second.
    pub max_probe_rate_hz: u32,
}

/// Runs the responder until `stop` is requested.
///
/// # Errors
/// The DDS participant or an endpoint cannot be created.
pub fn responder(options: ResponderOptions<'_>, stop: &Stop) -> Result<(), RoleError> {
    let (id, topic) = (options.id.to_owned(), options.request_topic.to_string());
    let domain_id = options.network.domain_id;
    let signed = options.trust.signs();
    let mut responder = Responder::open(options)?;
    info!(id, domain_id, topic, signed, "responder is up");
    while !stop.is_requested() {
        if responder.turn() {
            continue;
        }
        let wait_ns = responder.housekeeping_at.since(clock::monotonic());
        if wait_ns > 0 {
            #[allow(clippy::disallowed_methods, reason = "the responder handles no samples")]
            std::thread::park_timeout(Duration::from_nanos(wait_ns));
        }
    }
    responder.notifier.stopping();
    info!(
        answered = responder.handler.answered,
        refused = responder.handler.refused.total(),
        "responder is done"
    );
    Ok(())
}

struct Responder {
    /// Declared before the participant: the DDS library requires readers and writers to be dropped first.
    requests: Inbox,
    responses: RawWriter,
    participant: Participant,
    handler: RequestHandler,
    refused: RefusalLog,
    accepted: RefusalLog,
    housekeeping_at: MonotonicNs,
    /// When the last request was accepted; before the first, when the responder started.
    last_request_at: MonotonicNs,
    logged: LoggedState,
    /// The domain and topic of the requests, for the log.
    listens_on: String,
    notifier: Notifier,
    answered: Meter,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum LoggedState {
    Nothing,
    Arriving,
    Silent,
}

impl Responder {
    fn open(options: ResponderOptions<'_>) -> Result<Self, RoleError> {
        let mut participant = Participant::open(&ParticipantOptions {
            network: options.network,
            namespace: options.namespace.to_owned(),
            node_name: options.node_name.map_or_else(|| node_name(options.id), NodeName::to_string),
            graph_gid_bytes: options.graph_gid_bytes,
            dscp: 0,
        })?;
        // The writer first, so that the first request can be answered at once.
        let responses = participant.create_writer(
            &options.response_topic.to_dds(),
            PROBE_TYPE,
            &PROBE_WRITER_QOS,
            WINDOW_SAMPLES,
        )?;
        let requests =
            participant.create_reader(&options.request_topic.to_dds(), PROBE_TYPE, &PROBE_READER_QOS)?;
        requests.expect_small_samples();
        let now = clock::monotonic();
        Ok(Self {
            requests: Inbox::new(requests),
            responses,
            participant,
            handler: RequestHandler::new(options.id, options.trust, options.max_probe_rate_hz, now),
            refused: RefusalLog::new(RefusalCounts::default()),
            accepted: RefusalLog::new(RefusalCounts::default()),
            housekeeping_at: MonotonicNs(0),
            last_request_at: now,
            logged: LoggedState::Nothing,
            listens_on: format!("domain {}, topic {}", options.network.domain_id, options.request_topic),
            notifier: Notifier::new(),
            answered: Meter::default(),
        })
    }

    /// Does housekeeping if it is due, and answers requests. Returns whether more may be waiting.
    fn turn(&mut self) -> bool {
        let now = clock::monotonic();
        if now >= self.housekeeping_at {
            self.housekeeping(now);
        }
        (0..REQUESTS_PER_TURN).all(|_| self.step())
    }

    /// Takes one request and answers it. Returns whether there was one.
    fn step(&mut self) -> bool {
        let taken = self.requests.take_from_any();
        let received = clock::wall();
        let (origin, mut payload, encapsulation) = match taken {
            TakePayload::Empty => return false,
            TakePayload::Malformed => {
                self.handler.refused.add(ProbeRefusal::Malformed, 1);
                return true;
            }
            TakePayload::Sample(origin, payload, encapsulation) => (origin, payload, encapsulation),
        };
        let now = clock::monotonic();
        if !self.handler.is_within_rate(origin.writer, now) {
            return true;
        }
        let Some(request) = self.handler.check(payload.bytes(), encapsulation, received) else {
            return true;
        };
        let begun = clock::wall();
        if self.logged != LoggedState::Arriving {
            info!(sender_id = ?request.sender_id, "probe requests arrive");
            self.logged = LoggedState::Arriving;
        }
        self.last_request_at = now;
        let sent = clock::wall();
        let response = self.handler.respond(request, received, begun, sent).encode();
        let timestamp = SourceTimestamp::from_wall(sent);
        if let Err(error) = self.responses.write(response, Encapsulation::CDR_LE, timestamp) {
            debug!(%error, "response not sent");
        }
        true
    }

    fn housekeeping(&mut self, now: MonotonicNs) {
        self.refused.log_refused(&self.handler.refused, now);
        self.accepted.log_accepted(&self.handler.accepted_anyway, now);
        if self.logged != LoggedState::Silent && now.since(self.last_request_at) >= SILENCE_MS * 1_000_000 {
            self.logged = LoggedState::Silent;
            warn!(
                "no probe requests for {} s ({}); check that the bridge runs and that the network connects \
                 it with this host",
                SILENCE_MS / 1_000,
                self.listens_on
            );
        }
        telemetry::log_left_out(now);
        // Reports readiness at the first housekeeping, when all endpoints exist.
        self.notifier.ready();
        if self.participant.have_threads_turned(now) {
            self.notifier.feed_watchdog(now);
        }
        let (handler, answered) = (&self.handler, &mut self.answered);
        self.notifier.status(now, |line| {
            let per_s = answered.per_s(handler.answered, now);
            *line += &format!("{per_s:.1} probes answered per s; {} refused", handler.refused.total());
        });
        self.housekeeping_at = now.plus_ms(HOUSEKEEPING_MS);
    }
}

/// The node name: `responder_` and the id, with `_` for each character that ROS 2 does not allow in it.
fn node_name(id: &str) -> String {
    let allowed = |c: char| if c.is_ascii_alphanumeric() { c } else { '_' };
    format!("responder_{}", id.chars().map(allowed).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_name_has_letters_digits_and_underscores_only() {
        assert_eq!(node_name("laptop-7/ß"), "responder_laptop_7__");
    }
}
