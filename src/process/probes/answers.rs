//! What a responder makes of a request: an answer, or a count.

use super::message::{ProbeRequest, ProbeResponse};
use super::trust::Trust;
use crate::model::{Encapsulation, Guid, MonotonicNs, ProbeRefusal, RefusalCounts, WallNs};
use crate::policy::SenderLimits;

/// Bridges that are served at once, each at the full rate. More on one network exist on no robot we know.
const MAX_SENDERS: usize = 64;

/// Decides about requests. Time is an argument; memory is bounded whatever arrives.
#[derive(Debug)]
pub struct Answers {
    responder_id: String,
    trust: Trust,
    limits: SenderLimits<Guid>,
    /// Requests that were answered.
    pub answered: u64,
    /// Requests that were refused.
    pub refused: RefusalCounts,
    /// Requests that were answered only because the trust mode is permissive.
    pub accepted_anyway: RefusalCounts,
}

impl Answers {
    /// Answers in the name of `responder_id`, at most `max_rate_hz` times a second to each sender.
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

    /// Whether to look at a request that the DDS writer `writer` sent, before anything is computed for it.
    /// One that is beyond its sender's rate is counted.
    ///
    /// A sender is known by its writer and not by the `sender_id` in its requests, which whoever forges them
    /// shares with the bridge that they are made to look like.
    pub fn is_within_rate(&mut self, writer: Guid, now: MonotonicNs) -> bool {
        let allowed = self.limits.allow(writer, now);
        if !allowed {
            self.refused.add(ProbeRefusal::RateLimited);
        }
        allowed
    }

    /// The request that was received at `received`, if it is to be answered. One that is refused is counted.
    pub fn judge(
        &mut self,
        payload: &[u8],
        encapsulation: Encapsulation,
        received: WallNs,
    ) -> Option<ProbeRequest> {
        let judged = ProbeRequest::decode(payload, encapsulation)
            .and_then(|request| self.trust.check(&request, received).map(|doubt| (request, doubt)));
        match judged {
            Ok((request, doubt)) => {
                if let Some(reason) = doubt {
                    self.accepted_anyway.add(reason);
                }
                Some(request)
            }
            Err(reason) => {
                self.refused.add(reason);
                None
            }
        }
    }

    /// A sample that the DDS library could not read.
    pub fn count_malformed(&mut self) {
        self.refused.add(ProbeRefusal::Malformed);
    }

    /// The response to a request that was received at `received`; it is begun at `begun` and leaves at
    /// `sent`. Signed, if responses are.
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
        self.trust.sign(&mut response);
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

    /// A responder, and a bridge that has the same secret.
    fn sides(secret: Option<&std::path::Path>, trust_mode: TrustMode) -> (Answers, Trust) {
        let security = Security {
            trust_mode,
            enable_probe_hmac: secret.is_some(),
            secret: secret.map(|path| SecretSource::File(path.to_owned())),
            replay_window_ms: 30_000,
            max_probe_rate_hz: 20,
            allow_legacy_node_name_overrides: true,
        };
        let trust = || Trust::load(&security, None).unwrap();
        (Answers::new("laptop", trust(), 20, MonotonicNs(0)), trust())
    }

    fn unsigned() -> (Answers, Trust) {
        sides(None, TrustMode::DefaultDeny)
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

    impl Answers {
        fn ask(&mut self, request: &ProbeRequest) -> bool {
            self.judge(&request.encode(), Encapsulation::CDR_LE, WALL).is_some()
        }
    }

    #[test]
    fn a_response_repeats_the_request_and_has_three_times() {
        let (mut answers, _) = unsigned();
        let asked = answers.judge(&request("robot", 7).encode(), Encapsulation::CDR_LE, WALL).unwrap();
        let response = answers.respond(asked, WallNs(1), WallNs(2), WallNs(3));
        let expected = ProbeResponse {
            seq: 7,
            probe_id: ProbeId::Text("robot-7".to_owned()),
            recv_time: WallNs(1),
            reply_time: WallNs(2),
            response_send_time: WallNs(3),
            responder_id: "laptop".to_owned(),
            signature: None,
        };
        assert_eq!((response, answers.answered), (expected, 1));
    }

    #[test]
    fn a_flood_is_counted_and_leaves_others_their_rate() {
        let (mut answers, _) = unsigned();
        let mut looked_at = [0_u64; 2];
        for ms in 0..10_000 {
            looked_at[0] += u64::from(answers.is_within_rate(Guid([1; 16]), at_ms(ms)));
            if ms % 200 == 0 {
                looked_at[1] += u64::from(answers.is_within_rate(Guid([2; 16]), at_ms(ms)));
            }
        }
        assert!((190..=210).contains(&looked_at[0]), "{looked_at:?}");
        assert_eq!(looked_at[1], 50);
        assert_eq!(answers.refused.get(ProbeRefusal::RateLimited), 10_000 - looked_at[0]);
    }

    #[test]
    fn forged_and_repeated_requests_are_counted_and_change_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("secret");
        std::fs::write(&path, "a secret of the bridge's own").unwrap();
        let (mut answers, mut bridge) = sides(Some(&path), TrustMode::DefaultDeny);
        let mut first = request("robot", 0);
        bridge.sign(&mut first);
        assert!(answers.ask(&first));
        for seq in 1..1_000 {
            assert!(!answers.ask(&first));
            assert!(!answers.ask(&request("robot", seq)));
            let forged = ProbeRequest { signature: first.signature, ..request("robot", seq) };
            assert!(!answers.ask(&forged));
            let mut good = request("robot", seq);
            bridge.sign(&mut good);
            assert!(answers.ask(&good), "{seq}");
        }
        for reason in [ProbeRefusal::Replayed, ProbeRefusal::Unsigned, ProbeRefusal::BadSignature] {
            assert_eq!(answers.refused.get(reason), 999, "{reason}");
        }
        assert_eq!(answers.refused.total(), 3 * 999);
    }

    #[test]
    fn permissive_answers_and_counts() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("secret");
        std::fs::write(&path, "a secret of the bridge's own").unwrap();
        let (mut answers, _) = sides(Some(&path), TrustMode::Permissive);
        assert!(answers.ask(&request("robot", 1)));
        assert_eq!((answers.refused.total(), answers.accepted_anyway.get(ProbeRefusal::Unsigned)), (0, 1));
    }
}
