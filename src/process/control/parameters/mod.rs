//! The parameter services of ROS 2, for every node of the bridge: all processes have the same configuration,
//! so that control answers for all of them and the data path has no part in it.
//!
//! A thread of its own reads requests and writes replies, so that no request delays control's turn.

mod answers;
mod messages;
mod setting;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, TryRecvError, channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use bytes::Bytes;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tracing::{debug, warn};

use super::super::error::RoleError;
use super::super::parameter_store::ParameterStore;
use super::super::scheduling;
use crate::clock;
use crate::config::{SetParameters, Settings};
use crate::dds::{Inbox, Participant, Payload, RawReader, RawWriter, ReaderQos, SampleOrigin, TakePayload};
use crate::model::{
    Durability, Encapsulation, Guid, History, MonotonicNs, ParameterRequests, QosProfile, ReaderRecord,
    Reliability,
};
use crate::policy::SenderLimits;
use crate::shm::root_of;
use crate::telemetry::Snapshot;
use answers::Parameters;
use messages::{Front, ListRequest, Parameter, decode, encode};
use setting::{Outcome, Setter, set_results};

/// The largest request: one datagram. It has room for the names of 1,500 parameters.
const MAX_REQUEST_BYTES: usize = 65_536;

/// The largest reply. A request that repeats names could ask for more than the history holds.
const MAX_REPLY_BYTES: usize = 128 * 1024;

/// The largest reply of a service whose replies have no texts of the configuration.
const MAX_SHORT_REPLY_BYTES: usize = 16 * 1024;

/// Requests of one participant that are answered per second. A client that lists, gets and describes all
/// parameters of a bridge of ten nodes sends thirty at once, and then none for a while.
const MAX_RATE_HZ: f64 = 20.0;

/// The time whose requests may arrive at once.
const BURST_S: f64 = 5.0;

/// Participants whose requests are limited one by one; further ones share one rate.
const MAX_CLIENTS: usize = 64;

/// Requests of one service that wait for the thread; the oldest is overwritten.
const WAITING_REQUESTS: u32 = 16;

/// Unfinished requests of one service for which there is memory (`RawReader::expect_samples_up_to`).
const UNFINISHED_REQUESTS: usize = 4;

/// Replies of one service that are kept for clients that have not acknowledged them. With 34 nodes, those of
/// 32 lanes, ingress and control, all replies in histories stay below 60 MiB.
const WINDOW_SAMPLES: usize = 4;

/// Readers of one participant that a reply is sent to. It has one for each client of the service.
const MAX_READERS: usize = 64;

/// Readers that a reply is sent to at once: no more than the history keeps samples.
const READERS_AT_ONCE: usize = WINDOW_SAMPLES;

/// How long a reply is kept for readers of its client's participant: a request may arrive before discovery
/// has found the reader of the client, while that of another client is there already, and DDS delivers no
/// earlier sample to a VOLATILE reader. It is also how long a reply waits at most for room in the history.
const MATCH_MS: u64 = 1_000;

/// How long a reply that has not been acknowledged holds up those to other participants. Acknowledgements
/// take milliseconds, and a client that is gone sends none.
const OTHERS_MS: u64 = 100;

/// Interval at which the thread checks for new readers of the replies that it keeps.
const LOOK: Duration = Duration::from_millis(10);

/// Replies that wait for room or for further readers at the same time.
const MAX_WAITING_REPLIES: usize = 32;

/// How long the answer to a request that sets parameters waits until all processes have applied them. Each
/// takes over a reload every 100 ms.
const APPLY: Duration = Duration::from_secs(2);

/// The longest sleep of the thread.
const IDLE: Duration = Duration::from_secs(1);

const READER_QOS: ReaderQos = ReaderQos {
    reliability: Reliability::Reliable,
    durability: Durability::Volatile,
    depth: WAITING_REQUESTS,
    deadline_ms: None,
};

const WRITER_QOS: QosProfile =
    QosProfile { history: History::KeepLast { depth: WINDOW_SAMPLES as u32 }, ..QosProfile::CRITICAL };

#[derive(Clone, Copy, Debug)]
enum Service {
    List,
    Get,
    GetTypes,
    Describe,
    Set,
    SetAtomically,
    GetLoggerLevels,
}

impl Service {
    fn max_reply_bytes(self) -> usize {
        match self {
            Self::List | Self::Get | Self::Describe => MAX_REPLY_BYTES,
            Self::GetTypes | Self::Set | Self::SetAtomically | Self::GetLoggerLevels => MAX_SHORT_REPLY_BYTES,
        }
    }
}

/// All services, each with the name in its topics and the name of its type.
const SERVICES: [(Service, &str, &str); 7] = [
    (Service::List, "list_parameters", "ListParameters"),
    (Service::Get, "get_parameters", "GetParameters"),
    (Service::GetTypes, "get_parameter_types", "GetParameterTypes"),
    (Service::Describe, "describe_parameters", "DescribeParameters"),
    (Service::Set, "set_parameters", "SetParameters"),
    (Service::SetAtomically, "set_parameters_atomically", "SetParametersAtomically"),
    (Service::GetLoggerLevels, "get_logger_levels", "GetLoggerLevels"),
];

/// The bytes that requests and replies of one node take at most: of each service, requests that wait and
/// unfinished ones, and replies for clients that have not acknowledged them.
pub(super) fn bytes_of_node() -> usize {
    let requests = (WAITING_REQUESTS as usize + UNFINISHED_REQUESTS) * MAX_REQUEST_BYTES;
    SERVICES.iter().map(|(service, ..)| requests + WINDOW_SAMPLES * service.max_reply_bytes()).sum()
}

/// The running services. Dropping it ends the thread.
pub(super) struct ParameterServices {
    reloaded: Option<Sender<Settings>>,
    counts: Arc<SharedCounts>,
    thread: Option<JoinHandle<Vec<Server>>>,
}

/// The counts of the thread, for the board that control's main thread writes.
#[derive(Default)]
struct SharedCounts {
    answered: AtomicU64,
    malformed: AtomicU64,
    too_large: AtomicU64,
    rate_limited: AtomicU64,
    no_client: AtomicU64,
}

impl ParameterServices {
    /// Announces the services and starts their thread. `participants` are control's, the first on the input
    /// network, and `link_of_lane` is the index of each lane's.
    pub fn open(
        settings: &Settings,
        store: Option<ParameterStore>,
        participants: &mut [Participant],
        link_of_lane: &[usize],
    ) -> Result<Self, RoleError> {
        let mut endpoints = Vec::new();
        for (index, participant) in participants.iter_mut().enumerate() {
            let mut processes = vec!["control".to_owned()];
            processes.extend((index == 0).then(|| "ingress".to_owned()));
            let lanes = settings.lanes.iter().zip(link_of_lane);
            let lanes = lanes.filter(|(lane, link)| **link == index && lane.is_used());
            processes.extend(lanes.map(|(lane, _)| format!("egress_{}", lane.name)));
            for process in processes {
                let node = format!("{}/{}", settings.node_namespace, settings.node_name_of(&process));
                for service in SERVICES {
                    endpoints.push(open_service(participant, node.trim_start_matches('/'), service)?);
                }
            }
        }
        let counts = Arc::<SharedCounts>::default();
        let (sender, reloaded) = channel();
        let (settings, shared) = (settings.clone(), Arc::clone(&counts));
        let thread = thread::Builder::new().name("parameters".to_owned()).spawn(move || {
            scheduling::apply_to_background();
            let servers = endpoints.into_iter();
            Services {
                // Here, because arrivals wake the thread that creates an inbox.
                servers: servers
                    .map(|(service, reader, writer)| Server {
                        service,
                        inbox: Inbox::new(reader),
                        writer,
                        sent: SentReplies::default(),
                    })
                    .collect(),
                parameters: Parameters::new(settings),
                setter: Setter::new(store),
                reloaded,
                limits: SenderLimits::with_burst(MAX_RATE_HZ, BURST_S, MAX_CLIENTS, clock::monotonic()),
                waiting: VecDeque::new(),
                counts: shared,
            }
            .run()
        })?;
        Ok(Self { reloaded: Some(sender), counts, thread: Some(thread) })
    }

    /// Answers with these settings from now on.
    pub fn apply(&mut self, settings: &Settings) {
        if let Some(reloaded) = &self.reloaded {
            // Fails only if the thread has panicked, which ends the process.
            let _ = reloaded.send(settings.clone());
        }
        self.wake();
    }

    /// The requests since control started.
    pub fn counts(&self) -> ParameterRequests {
        let count = |count: &AtomicU64| count.load(Ordering::Relaxed);
        ParameterRequests {
            answered: count(&self.counts.answered),
            malformed: count(&self.counts.malformed),
            too_large: count(&self.counts.too_large),
            rate_limited: count(&self.counts.rate_limited),
            no_client: count(&self.counts.no_client),
        }
    }

    fn wake(&self) {
        if let Some(thread) = &self.thread {
            thread.thread().unpark();
        }
    }
}

impl Drop for ParameterServices {
    fn drop(&mut self) {
        self.reloaded = None;
        self.wake();
        // The caller drops the endpoints: the thread gets little CPU time on a busy machine, and each
        // endpoint waits for the event loop several times.
        match self.thread.take().map(JoinHandle::join) {
            Some(Err(_)) => warn!("the thread of the parameter services panicked"),
            servers => drop(servers),
        }
    }
}

fn open_service(
    participant: &mut Participant,
    node: &str,
    (service, name, type_name): (Service, &str, &str),
) -> Result<(Service, RawReader, RawWriter), RoleError> {
    // The DDS names of a ROS 2 service (design.ros2.org, "Topic and Service name mapping to DDS").
    let dds_type = |part: &str| format!("rcl_interfaces::srv::dds_::{type_name}_{part}_");
    let (request, reply) = (format!("rq/{node}/{name}Request"), format!("rr/{node}/{name}Reply"));
    let writer = participant.create_writer(&reply, &*dds_type("Response"), &WRITER_QOS, WINDOW_SAMPLES)?;
    let reader = participant.create_reader(&request, &*dds_type("Request"), &READER_QOS)?;
    reader.expect_samples_up_to(MAX_REQUEST_BYTES);
    Ok((service, reader, writer))
}

struct Server {
    service: Service,
    inbox: Inbox,
    writer: RawWriter,
    sent: SentReplies,
}

/// A request with its origin.
struct Request<'a> {
    origin: SampleOrigin,
    payload: &'a [u8],
    encapsulation: Encapsulation,
}

/// The last replies of a service: those that the writer's history has.
#[derive(Default)]
struct SentReplies(VecDeque<SentReply>);

struct SentReply {
    reader: Guid,
    /// The samples that the reader had been offered with it.
    offered: u64,
    at: MonotonicNs,
}

impl SentReplies {
    /// Whether a reply to this reader evicts none that another one, or this one, may still request again.
    fn has_room(&self, reader: &Guid, readers: &[ReaderRecord], now: MonotonicNs) -> bool {
        let is_needed = |sent: &&SentReply| {
            let lacks =
                |record: &ReaderRecord| record.offered.saturating_sub(record.unacknowledged) < sent.offered;
            let is_acknowledged = !readers.iter().any(|record| record.reader == sent.reader && lacks(record));
            let is_own = sent.reader.prefix() == reader.prefix();
            !is_acknowledged && (is_own || now < sent.at.plus_ms(OTHERS_MS))
        };
        self.0.iter().filter(is_needed).count() < WINDOW_SAMPLES
    }

    fn add(&mut self, reply: SentReply) {
        if self.0.len() == WINDOW_SAMPLES {
            self.0.pop_front();
        }
        self.0.push_back(reply);
    }
}

/// A reply that waits for room in the history, or for readers that are not discovered yet.
struct WaitingReply {
    server: usize,
    request: SampleOrigin,
    payload: Bytes,
    until: MonotonicNs,
    /// The readers that it was sent to.
    sent: Vec<Guid>,
}

/// Whether the history must have room for a reply that a reader has not acknowledged.
#[derive(Clone, Copy)]
enum Room {
    Needed,
    NotNeeded,
}

struct Services {
    servers: Vec<Server>,
    parameters: Parameters,
    setter: Setter,
    reloaded: Receiver<Settings>,
    limits: SenderLimits<[u8; 12]>,
    waiting: VecDeque<WaitingReply>,
    counts: Arc<SharedCounts>,
}

impl Services {
    /// Serves until control drops the sender of settings; returns the endpoints.
    fn run(mut self) -> Vec<Server> {
        loop {
            match self.reloaded.try_recv() {
                Ok(settings) => {
                    self.parameters = Parameters::new(settings);
                    continue;
                }
                Err(TryRecvError::Disconnected) => return self.servers,
                Err(TryRecvError::Empty) => {}
            }
            let mut is_idle = true;
            for server in 0..self.servers.len() {
                is_idle &= !self.serve(server);
            }
            self.send_waiting();
            if is_idle {
                #[allow(clippy::disallowed_methods, reason = "control handles no samples")]
                thread::park_timeout(if self.waiting.is_empty() { IDLE } else { LOOK });
            }
        }
    }

    /// Answers the next request of one service, and returns whether there was one.
    fn serve(&mut self, server: usize) -> bool {
        let (origin, payload, encapsulation) = match self.servers[server].inbox.take_from_any() {
            TakePayload::Empty => return false,
            TakePayload::Malformed => {
                add(&self.counts.malformed);
                return true;
            }
            TakePayload::Sample(origin, payload, encapsulation) => (origin, payload, encapsulation),
        };
        if !self.limits.allow(origin.writer.prefix(), clock::monotonic()) {
            add(&self.counts.rate_limited);
            return true;
        }
        // The reader has discarded the bytes of a request that is larger than `MAX_REQUEST_BYTES`.
        let Payload::Bytes(payload) = payload else {
            add(&self.counts.too_large);
            return true;
        };
        let service = self.servers[server].service;
        match self.answer(service, &Request { origin, payload: &payload, encapsulation }) {
            None => add(&self.counts.malformed),
            Some(reply) if reply.len() > service.max_reply_bytes() => add(&self.counts.too_large),
            Some(payload) => {
                let until = clock::monotonic().plus_ms(MATCH_MS);
                let mut reply = WaitingReply { server, request: origin, payload, until, sent: Vec::new() };
                self.send(&mut reply, Room::Needed);
                if self.waiting.len() == MAX_WAITING_REPLIES {
                    self.forget_one();
                }
                self.waiting.push_back(reply);
            }
        }
        true
    }

    /// The encoded reply; `None` for a malformed request.
    fn answer(&mut self, service: Service, request: &Request<'_>) -> Option<Bytes> {
        let parameters = &self.parameters;
        match service {
            Service::List => reply(request, |list: ListRequest| parameters.list(&list)),
            Service::Get => reply(request, |names: Vec<String>| parameters.values(&names)),
            Service::GetTypes => reply(request, |names: Vec<String>| parameters.types(&names)),
            Service::Describe => reply(request, |names: Vec<String>| parameters.describe(&names)),
            Service::GetLoggerLevels => reply(request, |names| parameters.logger_levels(names)),
            Service::Set | Service::SetAtomically => {
                let is_atomic = matches!(service, Service::SetAtomically);
                let (front, given) = request.decode::<Vec<Parameter>>()?;
                let results = set_results(self.set(&given, request.origin.writer, is_atomic));
                if !is_atomic {
                    return Some(encode(front, &results));
                }
                let refused = results.iter().find(|result| !result.successful);
                let all = refused.or_else(|| results.first()).cloned();
                Some(encode(front, &all.unwrap_or_else(|| set_results(vec![Ok(())]).remove(0))))
            }
        }
    }

    /// Sets parameters, and waits until all processes have applied them, so that a client that asks for a
    /// value next gets the new one.
    fn set(&mut self, given: &[Parameter], client: Guid, is_atomic: bool) -> Vec<Result<(), String>> {
        let Outcome { mut results, pending } = self.setter.set(given, &self.parameters, client, is_atomic);
        if let Some(pending) = pending {
            let late = self.wait_applied(&pending);
            if !late.is_empty() {
                let late = late.join(", ");
                let reason = format!("stored, but not applied within 2 s by {late}: read the log there");
                for result in results.iter_mut().filter(|result| result.is_ok()) {
                    *result = Err(reason.clone());
                }
            }
        }
        results
    }

    /// Waits until all processes have applied these parameters; returns those that have not in time.
    fn wait_applied(&mut self, pending: &SetParameters) -> Vec<String> {
        let give_up_at = clock::monotonic().plus_ms(APPLY.as_millis() as u64);
        loop {
            let is_last = give_up_at <= clock::monotonic();
            // Several changes may wait, because this thread gets little CPU time on a busy machine.
            while let Ok(settings) = self.reloaded.try_recv() {
                self.parameters = Parameters::new(settings);
            }
            let settings = &self.parameters.settings;
            let late = match settings.set_parameters == *pending {
                true => others_than(settings),
                false => vec!["control".to_owned()],
            };
            if late.is_empty() || is_last {
                return late;
            }
            #[allow(clippy::disallowed_methods, reason = "control handles no samples")]
            let reload = self.reloaded.recv_timeout(LOOK);
            match reload {
                Ok(settings) => self.parameters = Parameters::new(settings),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return late,
            }
        }
    }

    /// Discards a kept reply to make room: the oldest that was sent to a reader, else the oldest to which a
    /// reader has been discovered, else the oldest.
    fn forget_one(&mut self) {
        let sent = self.waiting.iter().position(|reply| !reply.sent.is_empty());
        let known = || {
            let readers = |reply: &WaitingReply| self.servers[reply.server].writer.matched_readers();
            self.waiting.iter().position(|reply| readers(reply).any(|record| reply.is_to(&record.reader)))
        };
        if let Some(reply) = self.waiting.remove(sent.or_else(known).unwrap_or(0)) {
            self.forget(reply);
        }
    }

    /// Sends a reply that has waited for room in vain, rather than never.
    fn forget(&mut self, mut reply: WaitingReply) {
        if reply.sent.is_empty() {
            self.send(&mut reply, Room::NotNeeded);
        }
        if reply.sent.is_empty() {
            add(&self.counts.no_client);
        }
    }

    fn send_waiting(&mut self) {
        let now = clock::monotonic();
        for _ in 0..self.waiting.len() {
            let Some(mut reply) = self.waiting.pop_front() else { return };
            self.send(&mut reply, Room::Needed);
            if now < reply.until {
                self.waiting.push_back(reply);
            } else {
                self.forget(reply);
            }
        }
    }

    /// Sends a reply once to each reader of the client's participant, the one that was created next to the
    /// client's writer first. Those of other participants do not receive it: they could not decode the form
    /// of another library. If room is needed, those for which the history has none get it later.
    fn send(&mut self, reply: &mut WaitingReply, room: Room) {
        let Server { writer, sent, .. } = &mut self.servers[reply.server];
        let now = clock::monotonic();
        let readers = writer.matched_readers().map(|record| record.reader);
        let mut new: Vec<Guid> =
            readers.filter(|reader| reply.is_to(reader) && !reply.sent.contains(reader)).collect();
        new.sort_by_key(|reader| number(reader).abs_diff(number(&reply.request.writer)));
        for reader in new.into_iter().take(READERS_AT_ONCE.min(MAX_READERS - reply.sent.len())) {
            let readers: Vec<ReaderRecord> = writer.matched_readers().collect();
            if matches!(room, Room::Needed) && !sent.has_room(&reader, &readers, now) {
                return;
            }
            if let Err(error) = writer.write_reply(reader, &reply.request, reply.payload.clone()) {
                debug!(%error, "cannot send a reply");
            }
            let offered = writer.matched_readers().find(|record| record.reader == reader);
            sent.add(SentReply { reader, offered: offered.map_or(0, |record| record.offered), at: now });
            if reply.sent.is_empty() {
                add(&self.counts.answered);
            }
            reply.sent.push(reader);
        }
    }
}

impl WaitingReply {
    /// Whether the reader is one of the client's participant.
    fn is_to(&self, reader: &Guid) -> bool {
        reader.prefix() == self.request.writer.prefix()
    }
}

/// The number of a reader or writer in its participant, which DDS libraries increment for each new one.
fn number(of: &Guid) -> u32 {
    u32::from_be_bytes([0, of.0[12], of.0[13], of.0[14]])
}

impl Request<'_> {
    fn decode<T: DeserializeOwned>(&self) -> Option<(Front, T)> {
        decode(self.origin.writer, self.payload, self.encapsulation)
    }
}

/// The running processes that have other settings in force than these.
fn others_than(settings: &Settings) -> Vec<String> {
    let fingerprint = settings.fingerprint();
    match Snapshot::take(&root_of(settings), settings) {
        Ok(Some(snapshot)) => {
            let running = snapshot.processes.into_iter().filter(|process| process.state.exists());
            running
                .filter(|process| process.health.settings_fingerprint != fingerprint)
                .map(|process| process.name)
                .collect()
        }
        Ok(None) => vec!["all processes".to_owned()],
        Err(error) => vec![format!("a process whose health cannot be read ({error})")],
    }
}

/// Decodes a request and encodes the reply that `answer` makes of it.
fn reply<Q: DeserializeOwned, A: Serialize>(
    request: &Request<'_>,
    answer: impl FnOnce(Q) -> A,
) -> Option<Bytes> {
    let (front, question) = request.decode()?;
    Some(encode(front, &answer(question)))
}

fn add(count: &AtomicU64) {
    count.fetch_add(1, Ordering::Relaxed);
}
