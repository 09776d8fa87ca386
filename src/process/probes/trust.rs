//! Authentication of probe messages: signs sent messages and checks received ones (docs/probe-protocol.md).

use super::message::{ProbeRequest, ProbeResponse, Signature, to_hex};
use super::secret::{Secret, SecretError};
use crate::config::{InlineSecret, Security, TrustMode};
use crate::model::{ProbeRefusal, WallNs};
use crate::policy::{Admission, ReplayGuard};

/// Nonces remembered to detect replays: those of 50 senders at 20 Hz within twice the default window of 30 s.
/// They take 1.5 MiB.
const REMEMBERED_NONCES: usize = 65_536;

/// A message that can be signed.
pub trait Signed {
    /// The text that is signed: the kind of message, the version, each field, and the nonce, each on a
    /// separate line. No field can contain a line break.
    fn signed_text(&self, nonce: &[u8; 16]) -> String;

    /// When the message was sent, in its sender's wall-clock time.
    fn sent_at(&self) -> WallNs;

    /// The signature of the message.
    fn signature(&self) -> Option<Signature>;
}

impl Signed for ProbeRequest {
    fn signed_text(&self, nonce: &[u8; 16]) -> String {
        lines(&[
            &"probe_request",
            &1,
            &self.seq,
            &self.send_time.0,
            &self.sender_id,
            &self.probe_id,
            &to_hex(nonce),
        ])
    }

    fn sent_at(&self) -> WallNs {
        self.send_time
    }

    fn signature(&self) -> Option<Signature> {
        self.signature
    }
}

impl Signed for ProbeResponse {
    fn signed_text(&self, nonce: &[u8; 16]) -> String {
        lines(&[
            &"probe_response",
            &1,
            &self.seq,
            &self.probe_id,
            &self.recv_time.0,
            &self.reply_time.0,
            &self.response_send_time.0,
            &self.responder_id,
            &to_hex(nonce),
        ])
    }

    fn sent_at(&self) -> WallNs {
        self.response_send_time
    }

    fn signature(&self) -> Option<Signature> {
        self.signature
    }
}

fn lines(fields: &[&dyn std::fmt::Display]) -> String {
    fields.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
}

/// Signs and checks the probe messages of one process.
#[derive(Debug)]
pub struct Trust {
    /// `None` if messages are not signed.
    secret: Option<Secret>,
    /// [`TrustMode::Off`] if messages are not checked.
    mode: TrustMode,
    replays: ReplayGuard,
    nonces: Nonces,
}

impl Trust {
    /// Loads the secret and the trust mode of a configuration. Without `enable_probe_hmac` messages are
    /// neither signed nor checked in any trust mode; with it, the trust mode determines how unauthenticated
    /// messages are handled. `inline` is the secret in the configuration file, if any.
    ///
    /// # Errors
    /// A secret is required and cannot be loaded.
    pub fn load(security: &Security, inline: Option<&InlineSecret>) -> Result<Self, SecretError> {
        let secret = match (&security.secret, security.enable_probe_hmac) {
            (_, false) => None,
            (Some(source), true) => Some(Secret::load(source, inline)?),
            // Messages are not checked, so that they need no signature.
            (None, true) if security.trust_mode == TrustMode::Off => None,
            (None, true) => return Err(SecretError::NotConfigured),
        };
        let nonces = Nonces::random().map_err(SecretError::NoRandomness)?;
        Ok(Self::new(secret, security.trust_mode, security.replay_window_ms, nonces))
    }

    fn new(secret: Option<Secret>, mode: TrustMode, replay_window_ms: u64, nonces: Nonces) -> Self {
        let mode = if secret.is_some() { mode } else { TrustMode::Off };
        // Without checks no nonce is remembered; 1 is the smallest capacity.
        let capacity = if mode == TrustMode::Off { 1 } else { REMEMBERED_NONCES };
        Self { secret, mode, replays: ReplayGuard::new(replay_window_ms, capacity), nonces }
    }

    /// This trust, which a reload has brought, with the memory of the former one: what that has accepted is
    /// not accepted again.
    pub fn continuing(self, former: Self) -> Self {
        if TrustMode::Off == self.mode || TrustMode::Off == former.mode {
            return self;
        }
        Self { replays: self.replays.remembering(former.replays), ..self }
    }

    /// Whether messages are signed.
    pub fn signs(&self) -> bool {
        self.secret.is_some()
    }

    /// The signature of a message if a secret is configured. The message must not be changed afterwards.
    pub fn sign(&mut self, message: &impl Signed) -> Option<Signature> {
        let secret = self.secret.as_ref()?;
        let nonce = self.nonces.next();
        Some(Signature { nonce, hmac: secret.sign(&message.signed_text(&nonce)) })
    }

    /// Checks whether a message is accepted. `Ok` with a reason means that the message is not authentic and
    /// is accepted only because the trust mode is permissive; the caller counts and logs it.
    ///
    /// # Errors
    /// The message is refused: it is unsigned, badly signed, expired or replayed.
    pub fn check(
        &mut self,
        message: &impl Signed,
        now: WallNs,
    ) -> Result<Option<ProbeRefusal>, ProbeRefusal> {
        let Some(secret) = self.secret.as_ref().filter(|_| self.mode != TrustMode::Off) else {
            return Ok(None);
        };
        match authenticate(secret, &mut self.replays, message, now) {
            Ok(()) => Ok(None),
            Err(reason) if self.mode == TrustMode::Permissive => Ok(Some(reason)),
            Err(reason) => Err(reason),
        }
    }
}

fn authenticate(
    secret: &Secret,
    replays: &mut ReplayGuard,
    message: &impl Signed,
    now: WallNs,
) -> Result<(), ProbeRefusal> {
    let signature = message.signature().ok_or(ProbeRefusal::Unsigned)?;
    if !secret.verify(&message.signed_text(&signature.nonce), &signature.hmac) {
        return Err(ProbeRefusal::BadSignature);
    }
    // After the signature check, so that a sender without the secret cannot fill the memory of nonces. One
    // guard serves all senders: all that pass the check share the secret.
    match replays.admit(signature.nonce, message.sent_at(), now) {
        Admission::Fresh => Ok(()),
        Admission::Replayed => Err(ProbeRefusal::Replayed),
        Admission::TooOld | Admission::Ahead | Admission::Forgotten => Err(ProbeRefusal::Expired),
    }
}

/// Generates unique nonces: eight random bytes of this process and a counter.
#[derive(Debug)]
struct Nonces {
    process: [u8; 8],
    used: u64,
}

impl Nonces {
    fn random() -> Result<Self, getrandom::Error> {
        let mut process = [0; 8];
        getrandom::fill(&mut process)?;
        Ok(Self { process, used: 0 })
    }

    fn next(&mut self) -> [u8; 16] {
        let mut nonce = [0; 16];
        nonce[..8].copy_from_slice(&self.process);
        nonce[8..].copy_from_slice(&self.used.to_be_bytes());
        self.used = self.used.wrapping_add(1);
        nonce
    }
}

#[cfg(test)]
mod tests {
    use super::super::message::ProbeId;
    use super::*;
    use crate::config::SecretSource;

    const NOW: WallNs = WallNs(1_763_000_000_000_000_000);
    const WINDOW_MS: u64 = 1_000;

    fn trust(secret: &str, mode: TrustMode) -> Trust {
        Trust::new(Secret::new(secret.as_bytes()), mode, WINDOW_MS, Nonces::random().unwrap())
    }

    fn request() -> ProbeRequest {
        ProbeRequest {
            seq: 7,
            send_time: NOW,
            sender_id: "bridge".to_owned(),
            probe_id: ProbeId::Text("p-7".to_owned()),
            signature: None,
        }
    }

    fn response() -> ProbeResponse {
        ProbeResponse {
            seq: 7,
            probe_id: ProbeId::Number(7),
            recv_time: WallNs(1),
            reply_time: WallNs(2),
            response_send_time: NOW,
            responder_id: "laptop".to_owned(),
            signature: None,
        }
    }

    fn signed(secret: &str, mut message: ProbeRequest) -> ProbeRequest {
        message.signature = trust(secret, TrustMode::Off).sign(&message);
        message
    }

    /// The layout of docs/probe-protocol.md, which responders of other vendors rely on.
    #[test]
    fn signed_texts_have_the_documented_layout() {
        let nonce = [0xab; 16];
        let digits = "ab".repeat(16);
        let expected = format!("probe_request\n1\n7\n{}\nbridge\np-7\n{digits}", NOW.0);
        assert_eq!(request().signed_text(&nonce), expected);
        let expected = format!("probe_response\n1\n7\n7\n1\n2\n{}\nlaptop\n{digits}", NOW.0);
        assert_eq!(response().signed_text(&nonce), expected);
    }

    #[test]
    fn the_examples_of_the_protocol_page_are_correct() {
        let page = include_str!("../../../docs/probe-protocol.md");
        let secret = Secret::new(b"swordfish").unwrap();
        let nonce = std::array::from_fn(|index| index as u8);
        let probe_id = ProbeId::Text("robot-42".to_owned());
        let at = |us: u64| WallNs(NOW.0 + us * 1_000);
        let request = ProbeRequest {
            seq: 42,
            send_time: at(0),
            sender_id: "robot".to_owned(),
            probe_id: probe_id.clone(),
            signature: None,
        };
        let response = ProbeResponse {
            seq: 42,
            probe_id,
            recv_time: at(12_000),
            reply_time: at(12_100),
            response_send_time: at(12_200),
            responder_id: "laptop".to_owned(),
            signature: None,
        };
        for text in [request.signed_text(&nonce), response.signed_text(&nonce)] {
            let hmac = to_hex(&secret.sign(&text));
            assert!(page.contains(&format!("`{hmac}`")), "{hmac} of {text:?}");
        }
    }

    #[test]
    fn a_signed_message_is_accepted_once() {
        let mut trust = trust("swordfish", TrustMode::DefaultDeny);
        let message = signed("swordfish", request());
        assert_eq!(trust.check(&message, NOW), Ok(None));
        assert_eq!(trust.check(&message, NOW), Err(ProbeRefusal::Replayed));
        assert_eq!(trust.check(&signed("swordfish", request()), NOW), Ok(None));
        let mut answer = response();
        answer.signature = trust.sign(&answer);
        assert_eq!(trust.check(&answer, NOW), Ok(None));
    }

    #[test]
    fn an_unauthenticated_message_is_refused_with_the_right_reason() {
        let mut trust = trust("swordfish", TrustMode::DefaultDeny);
        assert_eq!(trust.check(&request(), NOW), Err(ProbeRefusal::Unsigned));
        assert_eq!(trust.check(&signed("trout", request()), NOW), Err(ProbeRefusal::BadSignature));
        let good = signed("swordfish", request());
        let changed = [
            ProbeRequest { seq: 8, ..good.clone() },
            ProbeRequest { send_time: WallNs(NOW.0 + 1), ..good.clone() },
            ProbeRequest { sender_id: "bridgf".to_owned(), ..good.clone() },
            ProbeRequest { probe_id: ProbeId::Text("p-8".to_owned()), ..good.clone() },
        ];
        for message in changed {
            assert_eq!(trust.check(&message, NOW), Err(ProbeRefusal::BadSignature), "{message:?}");
        }
        let mut nonce = good.clone();
        nonce.signature.as_mut().unwrap().nonce[0] ^= 1;
        assert_eq!(trust.check(&nonce, NOW), Err(ProbeRefusal::BadSignature));
        // The refused variants have not used up the nonce of the genuine message.
        assert_eq!(trust.check(&good, NOW), Ok(None));
        for now in [0, NOW.0 - WINDOW_MS * 1_000_000 - 1, NOW.0 + WINDOW_MS * 1_000_000 + 1, u64::MAX] {
            let fresh = signed("swordfish", request());
            assert_eq!(trust.check(&fresh, WallNs(now)), Err(ProbeRefusal::Expired), "{now}");
        }
    }

    #[test]
    fn the_signed_texts_of_requests_and_responses_differ_in_the_first_line() {
        assert_ne!(
            request().signed_text(&[0; 16]).lines().next(),
            response().signed_text(&[0; 16]).lines().next()
        );
    }

    #[test]
    fn trust_mode_permissive_accepts_and_returns_the_reason() {
        let mut trust = trust("swordfish", TrustMode::Permissive);
        assert_eq!(trust.check(&request(), NOW), Ok(Some(ProbeRefusal::Unsigned)));
        assert_eq!(trust.check(&signed("trout", request()), NOW), Ok(Some(ProbeRefusal::BadSignature)));
        let good = signed("swordfish", request());
        assert_eq!(trust.check(&good, NOW), Ok(None));
        assert_eq!(trust.check(&good, NOW), Ok(Some(ProbeRefusal::Replayed)));
    }

    #[test]
    fn what_was_accepted_before_a_reload_is_not_accepted_again() {
        let mut former = trust("swordfish", TrustMode::DefaultDeny);
        let good = signed("swordfish", request());
        assert_eq!(former.check(&good, NOW), Ok(None));
        let mut reloaded = trust("swordfish", TrustMode::DefaultDeny).continuing(former);
        assert_eq!(reloaded.check(&good, NOW), Err(ProbeRefusal::Replayed));
        assert_eq!(reloaded.check(&signed("swordfish", request()), NOW), Ok(None));
        // A former trust that checked nothing has no memory to continue with.
        let mut checked = trust("swordfish", TrustMode::DefaultDeny).continuing(trust("", TrustMode::Off));
        assert_eq!(checked.check(&good, NOW), Ok(None));
        assert_eq!(checked.replays.len(), 1);
    }

    #[test]
    fn without_a_secret_or_in_trust_mode_off_nothing_is_checked() {
        for mut trust in [trust("swordfish", TrustMode::Off), trust("", TrustMode::DefaultDeny)] {
            assert_eq!(trust.check(&request(), NOW), Ok(None));
            assert_eq!(trust.check(&signed("trout", request()), WallNs(0)), Ok(None));
            assert_eq!(trust.mode, TrustMode::Off);
        }
    }

    #[test]
    fn the_configuration_selects_the_secret_and_the_trust_mode() {
        let security = |enable_probe_hmac, secret, trust_mode| Security {
            trust_mode,
            enable_probe_hmac,
            secret,
            replay_window_ms: WINDOW_MS,
            max_probe_rate_hz: 20,
            allow_legacy_node_name_overrides: true,
        };
        let missing = || Some(SecretSource::File("/nonexistent".into()));
        let load = |security: Security| Trust::load(&security, None);
        // The defaults of the original package.
        let unsigned = load(security(false, None, TrustMode::DefaultDeny)).unwrap();
        assert!(!unsigned.signs() && unsigned.mode == TrustMode::Off);
        assert!(!load(security(false, missing(), TrustMode::DefaultDeny)).unwrap().signs());
        assert!(!load(security(true, None, TrustMode::Off)).unwrap().signs());
        for mode in [TrustMode::DefaultDeny, TrustMode::Permissive] {
            let error = load(security(true, None, mode)).unwrap_err();
            assert!(matches!(error, SecretError::NotConfigured), "{error}");
        }
        let error = load(security(true, missing(), TrustMode::Off)).unwrap_err();
        assert!(matches!(error, SecretError::Unreadable { .. }), "{error}");
    }
}
