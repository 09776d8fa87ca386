//! The replies of a service, with the DDS endpoints of a client.

use super::*;
use crate::model::SourceTimestamp;
use crate::process::role::participant_options;
use crate::process::test_role::{self, SCAN, wait_until};
use crate::shm::ProcessRole;

const REQUEST: &str = "rcl_interfaces::srv::dds_::ListParameters_Request_";
const REPLY: &str = "rcl_interfaces::srv::dds_::ListParameters_Response_";

/// The service that lists parameters, in control's participant, and a client's participant with the writer of
/// requests.
struct Host {
    services: Services,
    requests: RawWriter,
    client: Participant,
    settings: Settings,
    _control: Participant,
    _folder: tempfile::TempDir,
}

impl Host {
    fn start(domain_id: u16) -> Self {
        let (folder, role, settings) = test_role::open(ProcessRole::Control, "control", domain_id, SCAN);
        drop(role);
        let (mut control, mut client) = (participant(&settings, "control"), participant(&settings, "client"));
        let (service, reader, writer) = open_service(&mut control, "node", SERVICES[0]).unwrap();
        let services = Services {
            servers: vec![Server {
                service,
                inbox: Inbox::new(reader),
                writer,
                sent: SentReplies::default(),
            }],
            parameters: Parameters::new(settings.clone()),
            setter: Setter::new(None),
            reloaded: channel().1,
            limits: SenderLimits::with_burst(MAX_RATE_HZ, BURST_S, MAX_CLIENTS, clock::monotonic()),
            waiting: VecDeque::new(),
            counts: Arc::default(),
        };
        let topic = "rq/node/list_parametersRequest";
        let requests = client.create_writer(topic, REQUEST, &QosProfile::CRITICAL, 64).unwrap();
        wait_until("the service matched", || requests.matched_readers().count() == 1);
        Self { services, requests, client, settings, _control: control, _folder: folder }
    }

    fn read_replies(&mut self) -> RawReader {
        let qos = ReaderQos { depth: 64, ..READER_QOS };
        self.client.create_reader("rr/node/list_parametersReply", REPLY, &qos).unwrap()
    }

    /// Has the service answer so many requests, which are sent at once. Discovery of the client's reader may
    /// take longer on a busy machine than a reply is kept, so that the replies are kept for a minute.
    fn answer(&mut self, requests: usize) {
        for begun in (0..requests).step_by(WAITING_REQUESTS as usize) {
            let count = (requests - begun).min(WAITING_REQUESTS as usize);
            for _ in 0..count {
                // No prefixes, and any depth.
                let list = Bytes::from_static(&[0; 16]);
                self.requests.write(list, Encapsulation::CDR_LE, SourceTimestamp::default()).unwrap();
            }
            assert!(self.requests.wait_acknowledged(Duration::from_secs(30)));
            for _ in 0..count {
                wait_until("a request", || self.services.serve(0));
                let until = clock::monotonic().plus_ms(60_000);
                self.services.waiting.iter_mut().for_each(|reply| reply.until = until);
            }
        }
    }

    /// Waits until the reader has so many replies, while the service sends those that wait.
    fn receive(&mut self, replies: &RawReader, count: usize) {
        let mut received = 0;
        wait_until("the replies", || {
            self.services.send_waiting();
            received += usize::from(matches!(replies.take_payload(), TakePayload::Sample(..)));
            received == count
        });
    }

    /// The replies that were sent to a reader, and those that no reader was there for.
    fn counts(&self) -> [usize; 2] {
        let counts = &self.services.counts;
        [&counts.answered, &counts.no_client].map(|count| count.load(Ordering::Relaxed) as usize)
    }
}

fn participant(settings: &Settings, name: &str) -> Participant {
    Participant::open(&participant_options(settings, &settings.input, name)).unwrap()
}

#[test]
fn the_last_32_replies_are_kept_for_a_client_whose_reader_is_discovered_later() {
    let mut host = Host::start(161);
    host.answer(MAX_WAITING_REPLIES + 8);
    assert_eq!(host.services.waiting.len(), MAX_WAITING_REPLIES);
    assert_eq!(host.counts(), [0, 8]);
    let replies = host.read_replies();
    host.receive(&replies, MAX_WAITING_REPLIES);
    assert_eq!(host.counts(), [MAX_WAITING_REPLIES, 8]);
}

#[test]
fn a_client_that_sends_many_requests_at_once_gets_a_reply_to_each() {
    let mut host = Host::start(162);
    let replies = host.read_replies();
    let writer = |host: &Host| host.services.servers[0].writer.matched_readers().count();
    wait_until("the client matched", || writer(&host) == 1);
    for _ in 0..3 {
        host.answer(WAITING_REQUESTS as usize);
        let unacknowledged = host.services.servers[0].writer.matched_readers().next().unwrap().unacknowledged;
        assert!(unacknowledged <= WINDOW_SAMPLES as u64, "{unacknowledged}");
        host.receive(&replies, WAITING_REQUESTS as usize);
    }
    assert_eq!(host.counts(), [3 * WAITING_REQUESTS as usize, 0]);
}

#[test]
fn replies_to_one_client_do_not_hold_up_those_to_another() {
    let mut host = Host::start(164);
    let replies = host.read_replies();
    let mut other = participant(&host.settings, "other");
    let topic = "rq/node/list_parametersRequest";
    let requests = other.create_writer(topic, REQUEST, &QosProfile::CRITICAL, 64).unwrap();
    let others = other.create_reader("rr/node/list_parametersReply", REPLY, &READER_QOS).unwrap();
    let readers = |host: &Host| host.services.servers[0].writer.matched_readers().collect::<Vec<_>>();
    wait_until("both clients matched", || {
        requests.matched_readers().count() == 1 && readers(&host).len() == 2
    });
    host.answer(8);
    host.receive(&replies, 8);
    wait_until("room", || {
        host.services.servers[0].sent.has_room(&others.guid(), &readers(&host), clock::monotonic())
    });
    requests.write(Bytes::from_static(&[0; 16]), Encapsulation::CDR_LE, SourceTimestamp::default()).unwrap();
    wait_until("a request", || host.services.serve(0));
    assert_eq!(host.services.waiting.back().unwrap().sent, [others.guid()]);
}

#[test]
fn a_reply_waits_for_those_of_its_client_and_shortly_for_those_of_others() {
    let reader = |participant: u8, number: u8| {
        let mut guid = [participant; 16];
        guid[14] = number;
        Guid(guid)
    };
    let at = |ms: u64| MonotonicNs(0).plus_ms(ms);
    let lacks = |reader: Guid, samples: u64| ReaderRecord {
        reader,
        offered: 9,
        unacknowledged: samples,
        reliable: 1,
        ..ReaderRecord::default()
    };
    let mut sent = SentReplies::default();
    for offered in 6..=9 {
        assert!(sent.has_room(&reader(1, 4), &[lacks(reader(1, 4), 9)], at(0)));
        sent.add(SentReply { reader: reader(1, 4), offered, at: at(0) });
    }
    // Of the last four, the reader has acknowledged none, one or all.
    for (samples, has_room) in [(9, false), (4, false), (3, true), (0, true)] {
        let readers = [lacks(reader(1, 4), samples)];
        for reader in [reader(1, 4), reader(1, 7), reader(2, 4)] {
            assert_eq!(sent.has_room(&reader, &readers, at(OTHERS_MS - 1)), has_room, "{samples}");
        }
        assert_eq!(sent.has_room(&reader(1, 7), &readers, at(OTHERS_MS)), has_room, "{samples}");
        assert!(sent.has_room(&reader(2, 4), &readers, at(OTHERS_MS)), "that of another participant");
    }
    assert!(sent.has_room(&reader(1, 4), &[], at(1)), "the reader is gone");
}
