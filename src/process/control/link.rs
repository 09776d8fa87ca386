//! The probes of one network: a writer of requests, a reader of responses, and the probes under way.

use std::collections::VecDeque;

use super::super::inbox::Inbox;
use super::super::probes::{
    MAX_MESSAGE_BYTES, PROBE_READER_QOS, PROBE_TYPE, PROBE_WRITER_QOS, ProbeId, ProbeRequest, ProbeResponse,
    Trust,
};
use super::super::role::RoleError;
use crate::clock;
use crate::config::Settings;
use crate::dds::{Participant, RawWriter, ReaderQos, Take};
use crate::model::{Encapsulation, FixedText, MonotonicNs, ProbeRefusal, RefusalCounts, SourceTimestamp};

/// Responses that may wait for control; with 64 responders at 5 Hz it is three seconds' worth.
const RESPONSES_WAITING: u32 = 1024;

/// Probes that are remembered, so that a late or a second response is told from one to no probe at all: 100 s
/// at 5 Hz.
const PROBES_REMEMBERED: usize = 512;

/// A probe that was sent.
#[derive(Clone, Debug)]
pub(super) struct Probe {
    pub seq: u64,
    pub sent_at: MonotonicNs,
    id: u64,
}

impl Probe {
    /// Random, so that nobody who has not seen the probe can answer it.
    fn id(&self) -> ProbeId {
        ProbeId::Text(format!("{:016x}", self.id))
    }
}

/// A response that is believed, to a probe that was sent.
pub(super) struct Response {
    pub responder_id: String,
    pub seq: u64,
    pub arrived_at: MonotonicNs,
}

/// Responses that did not authenticate or answer no probe, by reason.
#[derive(Debug, Default)]
pub(super) struct Doubts {
    pub refused: RefusalCounts,
    /// Accepted all the same, because the trust mode is permissive.
    pub accepted: RefusalCounts,
}

/// The probes of one network.
pub(super) struct Link {
    writer: RawWriter,
    inbox: Inbox,
    sender_id: String,
    /// Oldest first.
    probes: VecDeque<Probe>,
    next_seq: u64,
    scratch: Vec<u8>,
}

impl Link {
    pub fn open(participant: &mut Participant, settings: &Settings) -> Result<Self, RoleError> {
        let probes = &settings.probes;
        let writer =
            participant.create_writer(&probes.request_topic.to_dds(), PROBE_TYPE, &PROBE_WRITER_QOS, 8)?;
        let qos = ReaderQos { depth: RESPONSES_WAITING, ..PROBE_READER_QOS };
        let reader = participant.create_reader(&probes.response_topic.to_dds(), PROBE_TYPE, &qos)?;
        Ok(Self {
            writer,
            inbox: Inbox::new(reader),
            sender_id: sender_id(settings),
            probes: VecDeque::with_capacity(PROBES_REMEMBERED),
            next_seq: 1,
            scratch: Vec::with_capacity(MAX_MESSAGE_BYTES + 1),
        })
    }

    /// Sends the next probe; `None` when it could not be sent.
    pub fn send(&mut self, trust: &mut Trust) -> Option<&Probe> {
        // Without randomness a forger could guess; better no probe at all. The kernel always has some.
        let id = getrandom::u64().ok()?;
        let probe = Probe { seq: self.next_seq, sent_at: clock::monotonic(), id };
        let mut request = ProbeRequest {
            seq: probe.seq,
            send_time: clock::wall(),
            sender_id: self.sender_id.clone(),
            probe_id: probe.id(),
            signature: None,
        };
        trust.sign(&mut request);
        self.writer.write(request.encode(), Encapsulation::CDR_LE, SourceTimestamp::NONE).ok()?;
        self.next_seq += 1;
        if self.probes.len() == PROBES_REMEMBERED {
            self.probes.pop_front();
        }
        self.probes.push_back(probe);
        self.probes.back()
    }

    /// The probe of that number and those after it.
    pub fn since(&self, seq: u64) -> impl Iterator<Item = &Probe> {
        self.probes.iter().filter(move |probe| probe.seq >= seq)
    }

    /// The next response that is believed; what is not is counted. At most `budget` messages are looked at,
    /// and it is counted down, so that a flood cannot hold up what else control does.
    pub fn receive(
        &mut self,
        trust: &mut Trust,
        doubts: &mut Doubts,
        budget: &mut usize,
    ) -> Option<Response> {
        while *budget > 0 {
            let scratch = &mut self.scratch;
            let mut encapsulation = Encapsulation::CDR_LE;
            let take = self.inbox.take(&mut |payload, its_encapsulation| {
                scratch.clear();
                // One byte more than is read tells that it is too long.
                scratch.extend_from_slice(&payload[..payload.len().min(MAX_MESSAGE_BYTES + 1)]);
                encapsulation = its_encapsulation;
            });
            match take {
                Take::Empty => return None,
                Take::Malformed => doubts.refused.add(ProbeRefusal::Malformed),
                Take::Sample(_) => {
                    let arrived_at = clock::monotonic();
                    match self.check(encapsulation, trust) {
                        Ok((response, doubt)) => {
                            if let Some(reason) = doubt {
                                doubts.accepted.add(reason);
                            }
                            *budget -= 1;
                            return Some(Response {
                                responder_id: response.responder_id,
                                seq: response.seq,
                                arrived_at,
                            });
                        }
                        Err(reason) => doubts.refused.add(reason),
                    }
                }
            }
            *budget -= 1;
        }
        None
    }

    /// The message in the scratch buffer, and why it should not be believed where it is all the same.
    fn check(
        &self,
        encapsulation: Encapsulation,
        trust: &mut Trust,
    ) -> Result<(ProbeResponse, Option<ProbeRefusal>), ProbeRefusal> {
        let response = ProbeResponse::decode(&self.scratch, encapsulation)?;
        // Before the signature, because it is cheaper, and because a response to somebody else's probe on a
        // shared topic is nothing to warn about.
        let known = self.probes.binary_search_by_key(&response.seq, |probe| probe.seq);
        let probe = known.ok().and_then(|place| self.probes.get(place));
        if probe.is_none_or(|probe| probe.id() != response.probe_id) {
            return Err(ProbeRefusal::Unsolicited);
        }
        let doubt = trust.check(&response, clock::wall())?;
        Ok((response, doubt))
    }
}

/// How responders tell this bridge from another.
fn sender_id(settings: &Settings) -> String {
    let host = nix::unistd::gethostname().ok().and_then(|name| name.into_string().ok()).unwrap_or_default();
    let id: String = format!("{}@{host}", settings.instance).chars().filter(|c| !c.is_control()).collect();
    FixedText::new(&id).as_str().to_owned()
}
