//! The probes of one network: the writer of requests, the reader of responses, and the probes already sent.

use std::collections::VecDeque;

use super::super::error::RoleError;
use super::super::probes::{
    PROBE_READER_QOS, PROBE_TYPE, PROBE_WRITER_QOS, ProbeId, ProbeRequest, ProbeResponse, Trust,
};
use crate::clock;
use crate::config::Settings;
use crate::dds::{Inbox, Participant, RawWriter, ReaderQos, TakePayload};
use crate::model::{
    Encapsulation, FixedText, Guid, MAX_SUBSCRIBERS, MonotonicNs, ProbeRefusal, RefusalCounts,
    SourceTimestamp,
};
use crate::policy::SenderLimits;

/// History depth of the response reader: the responses of 64 responders at 5 Hz for three seconds.
const RESPONSE_DEPTH: u32 = 1024;

/// Probes that a link remembers, to distinguish a late or repeated response from an unsolicited one: 100 s at
/// 5 Hz.
const REMEMBERED_PROBES: usize = 512;

/// Responders whose responses are limited in rate one by one; further ones share one rate.
const MAX_RESPONDERS: usize = 2 * MAX_SUBSCRIBERS;

/// The time whose responses may arrive at once, after an outage of a responder's link.
const BURST_S: f64 = 10.0;

#[derive(Clone, Debug)]
pub(super) struct Probe {
    pub seq: u64,
    pub sent_at: MonotonicNs,
    /// Random, so that only a responder that received the request can answer it.
    id: ProbeId,
}

/// An accepted response to a probe that was sent.
pub(super) struct Response {
    pub responder_id: String,
    pub seq: u64,
    pub arrived_at: MonotonicNs,
}

#[derive(Debug, Default)]
pub(super) struct InvalidResponses {
    pub refused: RefusalCounts,
    /// Accepted because the trust mode is permissive.
    pub accepted: RefusalCounts,
}

pub(super) struct Link {
    writer: RawWriter,
    inbox: Inbox,
    sender_id: String,
    /// The remembered probes, oldest first.
    pub probes: VecDeque<Probe>,
    next_seq: u64,
    limits: SenderLimits<Guid>,
}

impl Link {
    pub fn open(participant: &mut Participant, settings: &Settings) -> Result<Self, RoleError> {
        let probes = &settings.probes;
        let writer =
            participant.create_writer(&probes.request_topic.to_dds(), PROBE_TYPE, &PROBE_WRITER_QOS, 8)?;
        let qos = ReaderQos { depth: RESPONSE_DEPTH, ..PROBE_READER_QOS };
        let reader = participant.create_reader(&probes.response_topic.to_dds(), PROBE_TYPE, &qos)?;
        reader.expect_small_samples();
        Ok(Self {
            writer,
            inbox: Inbox::new(reader),
            sender_id: sender_id(settings),
            probes: VecDeque::with_capacity(REMEMBERED_PROBES),
            next_seq: 1,
            limits: SenderLimits::with_burst(
                max_rate_hz(settings),
                BURST_S,
                MAX_RESPONDERS,
                clock::monotonic(),
            ),
        })
    }

    pub fn apply(&mut self, settings: &Settings, now: MonotonicNs) {
        self.limits.set_rate(max_rate_hz(settings), now);
    }

    /// Sends the next probe; `None` if it could not be sent.
    pub fn send(&mut self, trust: &mut Trust) -> Option<&Probe> {
        // A predictable id could be forged, so that no probe is sent without random numbers. In practice the
        // kernel always has them.
        let id = ProbeId::Text(format!("{:016x}", getrandom::u64().ok()?));
        let probe = Probe { seq: self.next_seq, sent_at: clock::monotonic(), id };
        let mut request = ProbeRequest {
            seq: probe.seq,
            send_time: clock::wall(),
            sender_id: self.sender_id.clone(),
            probe_id: probe.id.clone(),
            signature: None,
        };
        request.signature = trust.sign(&request);
        self.writer.write(request.encode(), Encapsulation::CDR_LE, SourceTimestamp::NONE).ok()?;
        self.next_seq += 1;
        if self.probes.len() == REMEMBERED_PROBES {
            self.probes.pop_front();
        }
        self.probes.push_back(probe);
        self.probes.back()
    }

    /// Returns the next accepted response, and counts invalid ones. Each message reduces `budget` by one and
    /// the function returns at zero, so that a flood of messages does not delay the rest of control's turn.
    pub fn receive(
        &mut self,
        trust: &mut Trust,
        invalid: &mut InvalidResponses,
        budget: &mut usize,
    ) -> Option<Response> {
        while *budget > 0 {
            let taken = self.inbox.take_from_any();
            let arrived_at = clock::monotonic();
            let checked = match taken {
                TakePayload::Empty => return None,
                TakePayload::Malformed => Err(ProbeRefusal::Malformed),
                TakePayload::Sample(origin, mut payload, encapsulation) => {
                    self.check(payload.bytes(), encapsulation, trust, origin.writer, arrived_at)
                }
            };
            *budget -= 1;
            match checked {
                Ok((ProbeResponse { responder_id, seq, .. }, tolerated)) => {
                    if let Some(reason) = tolerated {
                        invalid.accepted.add(reason, 1);
                    }
                    return Some(Response { responder_id, seq, arrived_at });
                }
                Err(reason) => invalid.refused.add(reason, 1),
            }
        }
        None
    }

    /// Checks a message. The second value is the reason for which trust mode `default_deny` would have
    /// refused the response; `None` for an authentic one.
    fn check(
        &mut self,
        payload: &[u8],
        encapsulation: Encapsulation,
        trust: &mut Trust,
        writer: Guid,
        now: MonotonicNs,
    ) -> Result<(ProbeResponse, Option<ProbeRefusal>), ProbeRefusal> {
        let response = ProbeResponse::decode(payload, encapsulation)?;
        // Checked before the signature: it is cheaper, and a response to another bridge's probe on a shared
        // topic must not be reported as badly signed.
        let known = self.probes.binary_search_by_key(&response.seq, |probe| probe.seq);
        let probe = known.ok().and_then(|index| self.probes.get(index));
        if probe.is_none_or(|probe| probe.id != response.probe_id) {
            return Err(ProbeRefusal::Unsolicited);
        }
        // After that, because a responder also answers other bridges on this topic, at their rates.
        if !self.limits.allow(writer, now) {
            return Err(ProbeRefusal::RateLimited);
        }
        let tolerated = trust.check(&response, clock::wall())?;
        Ok((response, tolerated))
    }
}

fn max_rate_hz(settings: &Settings) -> f64 {
    f64::from(settings.security.max_probe_rate_hz)
}

/// The id by which responders distinguish this bridge from others: instance and host name.
fn sender_id(settings: &Settings) -> String {
    let host = nix::unistd::gethostname().ok().and_then(|name| name.into_string().ok()).unwrap_or_default();
    let id: String = format!("{}@{host}", settings.instance).chars().filter(|c| !c.is_control()).collect();
    FixedText::new(&id).as_str().to_owned()
}
