//! Handling of requests by a responder: each is answered, or refused and counted.

use super::message::{ProbeRequest, ProbeResponse};
use super::trust::Trust;
use crate::model::{Encapsulation, Guid, MonotonicNs, ProbeRefusal, RefusalCounts, WallNs};
use crate::policy::SenderLimits;

/// Bridges that are served at the same time, each at the full rate. No known robot network has more.
const MAX_SENDERS: usize = 64;

/// Checks requests and makes the responses. Time is an argument; memory is bounded for any input.
#[derive(Debug)]
pub struct RequestHandler {
    responder_id: String,
    trust: Trust,
    limits: SenderLimits<Guid>,
    /// The number of answered requests.
    pub answered: u64,
    /// The numbers of refused requests, by reason.
    pub refused: RefusalCounts,
    /// The numbers of requests that were answered only because the trust mode is permissive, by reason.
    pub accepted_anyway: RefusalCounts,
}

impl RequestHandler {
    /// Creates the request handling of the responder `responder_id`, which answers each sender at most
    /// `max_rate_hz` times a second.
    pub fn new(responder_id: &str, trust: Trust, max_rate_hz: u32, now: MonotonicNs) -> Self {
        Self {
            responder_id: responder_id.to_owned(),
            trust,
            limits: SenderLimits::new(f64::from(max_rate_hz), MAX_SENDERS, now),
            answered: 0,
            refused: RefusalCounts::default(),
            accepted_anyway: RefusalCounts::default(),
        }
    }

    /// Whether a request of the DDS writer `writer` is within its sender's rate; called before the request is
    /// decoded. A request beyond the rate is counted as refused.
    ///
    /// A sender is identified by its DDS writer and not by the `sender_id` of its requests: forged requests
    /// carry the id of a real bridge and would use up that bridge's rate.
    pub fn is_within_rate(&mut self, writer: Guid, now: MonotonicNs) -> bool {
        let allowed = self.limits.allow(writer, now);
        if !allowed {
            self.refused.add(ProbeRefusal::RateLimited, 1);
        }
        allowed
    }

    /// Decodes and checks a request that was received at `received`; `None` if it is refused, which is
    /// counted.
    pub fn check(
        &mut self,
        payload: &[u8],
        encapsulation: Encapsulation,
        received: WallNs,
    ) -> Option<ProbeRequest> {
        let checked = ProbeRequest::decode(payload, encapsulation)
            .and_then(|request| self.trust.check(&request, received).map(|tolerated| (request, tolerated)));
        let (request, tolerated) = checked.inspect_err(|reason| self.refused.add(*reason, 1)).ok()?;
        if let Some(reason) = tolerated {
            self.accepted_anyway.add(reason, 1);
        }
        Some(request)
    }

    /// Makes the response to a request that was received at `received`. `begun` and `sent` are the times at
    /// which the response is started and sent. The response is signed if a secret is configured.
    pub fn respond(
        &mut self,
        request: ProbeRequest,
        received: WallNs,
        begun: WallNs,
        sent: WallNs,
    ) -> ProbeResponse {
        let mut response = ProbeResponse {
            seq: request.seq,
            probe_id: request.probe_id,
            recv_time: received,
            reply_time: begun,
            response_send_time: sent,
            responder_id: self.responder_id.clone(),
            signature: None,
        };
        response.signature = self.trust.sign(&response);
        self.answered += 1;
        response
    }
}

#[cfg(test)]
mod tests {
    use super::super::message::ProbeId;
    use super::*;
    use crate::config::{SecretSource, Security, TrustMode};

    const WALL: WallNs = WallNs(1_763_000_000_000_000_000);

    /// A responder and the signing of a bridge with the same secret.
    fn responder_and_bridge(
        secret: Option<&std::path::Path>,
        trust_mode: TrustMode,
    ) -> (RequestHandler, Trust) {
        let security = Security {
            trust_mode,
            enable_probe_hmac: secret.is_some(),
            secret: secret.map(|path| SecretSource::File(path.to_owned())),
            replay_window_ms: 30_000,
            max_probe_rate_hz: 20,
            allow_legacy_node_name_overrides: true,
        };
        let trust = || Trust::load(&security, None).unwrap();
        (RequestHandler::new("laptop", trust(), 20, MonotonicNs(0)), trust())
    }

    fn unsigned() -> (RequestHandler, Trust) {
        responder_and_bridge(None, TrustMode::DefaultDeny)
    }

    fn request(sender: &str, seq: u64) -> ProbeRequest {
        ProbeRequest {
            seq,
            send_time: WALL,
            sender_id: sender.to_owned(),
            probe_id: ProbeId::Text(format!("{sender}-{seq}")),
            signature: None,
        }
    }

    fn at_ms(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    impl RequestHandler {
        fn accepts(&mut self, request: &ProbeRequest) -> bool {
            self.check(&request.encode(), Encapsulation::CDR_LE, WALL).is_some()
        }
    }

    #[test]
    fn a_response_echoes_the_request_and_has_three_timestamps() {
        let (mut handler, _) = unsigned();
        let accepted = handler.check(&request("robot", 7).encode(), Encapsulation::CDR_LE, WALL).unwrap();
        let response = handler.respond(accepted, WallNs(1), WallNs(2), WallNs(3));
        let expected = ProbeResponse {
            seq: 7,
            probe_id: ProbeId::Text("robot-7".to_owned()),
            recv_time: WallNs(1),
            reply_time: WallNs(2),
            response_send_time: WallNs(3),
            responder_id: "laptop".to_owned(),
            signature: None,
        };
        assert_eq!((response, handler.answered), (expected, 1));
    }

    #[test]
    fn a_flood_of_one_sender_is_counted_and_does_not_limit_another_sender() {
        let (mut handler, _) = unsigned();
        let mut allowed = [0_u64; 2];
        for ms in 0..10_000 {
            allowed[0] += u64::from(handler.is_within_rate(Guid([1; 16]), at_ms(ms)));
            if ms % 200 == 0 {
                allowed[1] += u64::from(handler.is_within_rate(Guid([2; 16]), at_ms(ms)));
            }
        }
        assert!((190..=210).contains(&allowed[0]), "{allowed:?}");
        assert_eq!(allowed[1], 50);
        assert_eq!(handler.refused.get(ProbeRefusal::RateLimited), 10_000 - allowed[0]);
    }

    #[test]
    fn forged_and_replayed_requests_are_refused_and_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("secret");
        std::fs::write(&path, "a secret of the bridge's own").unwrap();
        let (mut handler, mut bridge) = responder_and_bridge(Some(&path), TrustMode::DefaultDeny);
        let mut first = request("robot", 0);
        first.signature = bridge.sign(&first);
        assert!(handler.accepts(&first));
        for seq in 1..1_000 {
            assert!(!handler.accepts(&first));
            assert!(!handler.accepts(&request("robot", seq)));
            let forged = ProbeRequest { signature: first.signature, ..request("robot", seq) };
            assert!(!handler.accepts(&forged));
            let mut good = request("robot", seq);
            good.signature = bridge.sign(&good);
            assert!(handler.accepts(&good), "{seq}");
        }
        for reason in [ProbeRefusal::Replayed, ProbeRefusal::Unsigned, ProbeRefusal::BadSignature] {
            assert_eq!(handler.refused.get(reason), 999, "{reason}");
        }
        assert_eq!(handler.refused.total(), 3 * 999);
    }

    #[test]
    fn trust_mode_permissive_answers_and_counts_unsigned_requests() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("secret");
        std::fs::write(&path, "a secret of the bridge's own").unwrap();
        let (mut handler, _) = responder_and_bridge(Some(&path), TrustMode::Permissive);
        assert!(handler.accepts(&request("robot", 1)));
        assert_eq!((handler.refused.total(), handler.accepted_anyway.get(ProbeRefusal::Unsigned)), (0, 1));
    }
}
