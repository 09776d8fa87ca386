//! The impaired link on real hosts: its loss and delay of real packets, compared with theory and with its own
//! model in virtual time with the same seed.

use std::collections::BTreeSet;
use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use adaptive_bridge::model::MonotonicNs;
use adaptive_bridge_eval::impairment::{
    Arrival, Fate, GilbertElliott, Impairment as Model, Level, Link, LinkState, NormalDelay, Reading,
};
use nix::sys::signal::Signal;
use nix::sys::socket::{setsockopt, sockopt};
use support::impairment::Impairment;
use support::netns::{Host, Net};

/// Datagrams that are sent without a pause between them: fewer than any queue on their way holds.
const BATCH: u32 = 50;
/// A datagram of so many bytes is three fragments at an MTU of 1500.
const THREE_FRAGMENTS_BYTES: usize = 4_000;

/// Creates two hosts; `None` if the machine cannot, which records the test as skipped.
fn two_hosts(test: &str) -> Option<(Net, Host, Host)> {
    if let Some(reason) = support::netns::requires_root() {
        support::skip(test, &reason);
        return None;
    }
    let net = Net::new(&["publisher", "slow"]);
    let (publisher, slow) = (net.host("publisher").clone(), net.host("slow").clone());
    Some((net, publisher, slow))
}

/// A datagram that has arrived: its number, when it was sent and when it came.
struct Received {
    number: u32,
    sent: Instant,
    came: Instant,
}

/// Numbered datagrams between two hosts, all sent by this process.
struct Flow {
    from: UdpSocket,
    to: UdpSocket,
    sent: Vec<Instant>,
    bytes: usize,
}

impl Flow {
    fn new(from: &Host, to: &Host, bytes: usize) -> Self {
        let (from, to) = (from.udp_socket(), to.udp_socket());
        // A large buffer, so that no datagram that the link lets pass is lost here.
        setsockopt(&to, sockopt::RcvBufForce, &(64 << 20)).unwrap();
        to.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
        from.connect(to.local_addr().unwrap()).unwrap();
        Self { from, to, sent: Vec::new(), bytes }
    }

    fn send(&mut self, count: u32) {
        let mut datagram = vec![0; self.bytes];
        for _ in 0..count {
            let number = self.sent.len() as u32;
            datagram[..4].copy_from_slice(&number.to_le_bytes());
            self.sent.push(Instant::now());
            self.from.send(&datagram).unwrap();
            if number % BATCH == BATCH - 1 {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    }

    /// Receives in a thread of its own from now on.
    fn receive(&self) -> Receiver {
        let socket = self.to.try_clone().unwrap();
        let end = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&end);
        let count = Arc::new(AtomicUsize::new(0));
        let counted = Arc::clone(&count);
        let thread = std::thread::spawn(move || {
            let mut datagram = [0; 65_536];
            let mut came = Vec::new();
            loop {
                // Takes the datagrams that have arrived also after a request to end.
                let last = asked.load(Ordering::Acquire);
                match socket.recv(&mut datagram) {
                    Ok(bytes) => {
                        assert!(bytes >= 4, "a datagram of {bytes} bytes");
                        let number = u32::from_le_bytes(datagram[..4].try_into().unwrap());
                        came.push((number, Instant::now()));
                        counted.store(came.len(), Ordering::Release);
                    }
                    Err(_) if last => return came,
                    Err(_) => {}
                }
            }
        });
        Receiver { thread, end, count }
    }

    /// The datagrams in the order of their arrival. To be called when none is in transit any more.
    fn received(&self, receiver: Receiver) -> Vec<Received> {
        receiver.end.store(true, Ordering::Release);
        let came = receiver.thread.join().unwrap();
        let received = came.into_iter().map(|(number, came)| {
            let sent = self.sent[number as usize];
            Received { number, sent, came }
        });
        received.collect()
    }
}

struct Receiver {
    thread: JoinHandle<Vec<(u32, Instant)>>,
    end: Arc<AtomicBool>,
    count: Arc<AtomicUsize>,
}

impl Receiver {
    fn wait_received(&self, datagrams: usize) {
        support::wait_until(format!("{datagrams} datagrams"), || {
            self.count.load(Ordering::Acquire) >= datagrams
        });
    }
}

fn numbers(received: &[Received]) -> BTreeSet<u32> {
    let numbers: BTreeSet<u32> = received.iter().map(|received| received.number).collect();
    assert_eq!(numbers.len(), received.len(), "datagrams that came twice");
    numbers
}

/// For each of a number of consecutive packets, whether the model of a link lets it pass.
fn passing(loss: GilbertElliott, seed: u64, packets: u32) -> BTreeSet<u32> {
    let mut link = Link::new(&Model { loss, delay: NormalDelay::NONE, seed });
    let arrival = |packet| Arrival { packet, bytes: 0, fragment: false };
    (0..packets).filter(|packet| link.arrive(arrival(*packet), MonotonicNs(0)) == Fate::Pass).collect()
}

/// The number of rules that send packets to a queue, and of queues with a listening program.
fn traces(host: &Host) -> (usize, usize) {
    let rules = host.run("iptables", &["-t", "mangle", "-S", "PREROUTING"]);
    let queues = host.run("cat", &["/proc/self/net/netfilter/nfnetlink_queue"]);
    (rules.lines().filter(|rule| rule.contains("NFQUEUE")).count(), queues.lines().count())
}

#[test]
fn loss_is_that_of_the_chain_packet_by_packet_and_by_its_variance() {
    let Some((_net, publisher, slow)) =
        two_hosts("loss_is_that_of_the_chain_packet_by_packet_and_by_its_variance")
    else {
        return;
    };
    const PACKETS: u32 = 20_000;
    for (level, name) in [(Level::Mild, "mild"), (Level::Strong, "strong")] {
        for (reading, reading_name) in [(Reading::AsPrinted, "as-printed"), (Reading::AsRun, "as-run")] {
            let arguments = format!("--level {name} --reading {reading_name} --seed 11");
            let mut link = Impairment::start(&slow, &publisher, &arguments);
            let mut flow = Flow::new(&publisher, &slow, 100);
            let receiver = flow.receive();
            flow.send(PACKETS);
            let counters = link.wait_seen(u64::from(PACKETS));
            let received = numbers(&flow.received(receiver));

            let model = level.model(reading);
            assert_eq!(received, passing(model, 11, PACKETS), "{arguments}");
            assert_eq!(counters["passed"], received.len(), "{counters}");
            assert_eq!((&counters["kernel_dropped"], &counters["overflowed"]), (&0.into(), &0.into()));
            let lost = counters["loss"].as_f64().unwrap();
            let tolerance = 5.0 * model.loss_standard_error(u64::from(PACKETS));
            assert!((lost - model.stationary_loss()).abs() <= tolerance, "{arguments}: {counters}");
            assert_eq!(link.end()["seen"], PACKETS);
        }
    }
}

#[test]
fn another_seed_loses_other_packets() {
    let Some((_net, publisher, slow)) = two_hosts("another_seed_loses_other_packets") else { return };
    let run = |seed: u64| {
        let arguments = format!("--gilbert-elliott 0.02 0.1 0.01 0.5 --seed {seed}");
        let mut link = Impairment::start(&slow, &publisher, &arguments);
        let mut flow = Flow::new(&publisher, &slow, 100);
        let receiver = flow.receive();
        flow.send(2_000);
        link.wait_seen(2_000);
        numbers(&flow.received(receiver))
    };
    let first = run(1);
    assert_eq!(first, run(1));
    assert_ne!(first, run(2));
}

#[test]
fn fragments_are_lost_one_by_one() {
    let Some((_net, publisher, slow)) = two_hosts("fragments_are_lost_one_by_one") else { return };
    const DATAGRAMS: u32 = 1_000;
    let mut link = Impairment::start(&slow, &publisher, "--level strong --reading as-printed --seed 5");
    let mut flow = Flow::new(&publisher, &slow, THREE_FRAGMENTS_BYTES);
    let receiver = flow.receive();
    flow.send(DATAGRAMS);
    let counters = link.wait_seen(3 * u64::from(DATAGRAMS));
    let received = numbers(&flow.received(receiver));
    assert_eq!(
        (&counters["seen"], &counters["fragments"]),
        (&(3 * DATAGRAMS).into(), &(3 * DATAGRAMS).into())
    );
    assert_eq!(counters["largest_bytes"], 1_500);
    // A datagram arrives when all its three fragments do.
    let fragments = passing(Level::Strong.model(Reading::AsPrinted), 5, 3 * DATAGRAMS);
    let whole = |number: &u32| (0..3).all(|fragment| fragments.contains(&(3 * number + fragment)));
    assert_eq!(received, (0..DATAGRAMS).filter(whole).collect());
}

/// Mean and standard deviation.
fn spread(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (mean, (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / n).sqrt())
}

#[test]
fn delays_are_those_of_the_seed_and_have_its_mean_and_spread() {
    let Some((_net, publisher, slow)) =
        two_hosts("delays_are_those_of_the_seed_and_have_its_mean_and_spread")
    else {
        return;
    };
    const PACKETS: u32 = 1_000;
    let delay = NormalDelay::new(20.0, 10.0).unwrap();
    let mut link = Link::new(&Model { loss: GilbertElliott::CLEAN, delay, seed: 3 });
    let mut drawn_ms = vec![0.0; PACKETS as usize];
    for packet in 0..PACKETS {
        let arrival = Arrival { packet, bytes: 0, fragment: false };
        assert_eq!(link.arrive(arrival, MonotonicNs(0)), Fate::Hold);
    }
    while let Some(release) = link.next_release() {
        let packet = link.pop_due(release).unwrap();
        drawn_ms[packet as usize] = release.0 as f64 / 1e6;
    }

    // A busy machine wakes threads late, so the measurement is repeated until it had an idle second.
    support::wait_until("delays whose mean and spread are those that were drawn", || {
        let mut link = Impairment::start(&slow, &publisher, "--delay-ms 20 --jitter-ms 10 --seed 3");
        let mut flow = Flow::new(&publisher, &slow, 100);
        let receiver = flow.receive();
        for _ in 0..PACKETS {
            flow.send(1);
            std::thread::sleep(Duration::from_micros(500));
        }
        link.wait_seen(u64::from(PACKETS));
        let received = flow.received(receiver);
        assert_eq!(received.len(), PACKETS as usize);
        let delays_ms: Vec<f64> =
            received.iter().map(|it| it.came.duration_since(it.sent).as_secs_f64() * 1e3).collect();
        for (received, delay_ms) in received.iter().zip(&delays_ms) {
            let drawn_ms = drawn_ms[received.number as usize];
            assert!(*delay_ms >= drawn_ms, "packet {}: {delay_ms} of {drawn_ms} ms", received.number);
        }
        let (expected, seen) = (spread(&drawn_ms), spread(&delays_ms));
        println!("drawn {:.2} ± {:.2} ms, seen {:.2} ± {:.2} ms", expected.0, expected.1, seen.0, seen.1);
        (seen.0 - expected.0).abs() < 2.0 && (seen.1 - expected.1).abs() < 2.0
    });
}

#[test]
fn a_link_is_switched_while_packets_flow() {
    let Some((_net, publisher, slow)) = two_hosts("a_link_is_switched_while_packets_flow") else { return };
    let mut link =
        Impairment::start(&slow, &publisher, "--level strong --reading as-run --seed 9 --state off");
    let mut flow = Flow::new(&publisher, &slow, 100);
    let receiver = flow.receive();
    let mut seen = 0;
    let mut send = |link: &mut Impairment, flow: &mut Flow, count: u32| {
        flow.send(count);
        seen += u64::from(count);
        link.wait_seen(seen)
    };
    assert_eq!(send(&mut link, &mut flow, 500)["judged"], 0);
    link.on();
    send(&mut link, &mut flow, 500);
    link.down();
    assert_eq!(send(&mut link, &mut flow, 500)["cut"], 500);
    link.on();
    send(&mut link, &mut flow, 500);
    assert_eq!(link.off()["state"], LinkState::Off.to_string());
    let counters = send(&mut link, &mut flow, 500);
    let received = numbers(&flow.received(receiver));

    // The chain continues in the state in which the link was cut.
    let judged = passing(Level::Strong.model(Reading::AsRun), 9, 1_000);
    let expected = |number: &u32| match number / 500 {
        1 => judged.contains(&(number - 500)),
        3 => judged.contains(&(number - 1_000)),
        phase => phase != 2,
    };
    assert_eq!(received, (0..2_500).filter(expected).collect());
    assert_eq!(
        (counters["judged"].as_u64(), counters["passed"].as_u64()),
        (Some(1_000), Some(received.len() as u64))
    );
}

/// A file with these lines that is there as long as the folder.
fn trace_file(rows: &str) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.csv");
    std::fs::write(&path, format!("time_s,loss,delay_ms\n{rows}")).unwrap();
    let path = path.to_str().unwrap().to_owned();
    (folder, path)
}

/// `judged` and `lost` of each row of a trace.
fn counts_of_rows(ended: &serde_json::Value) -> Vec<(u32, u32)> {
    let rows = ended["trace"]["rows"].as_array().unwrap().iter();
    let number = |value: &serde_json::Value| value.as_u64().unwrap() as u32;
    rows.map(|row| (number(&row["judged"]), number(&row["lost"]))).collect()
}

#[test]
fn a_trace_is_played_row_by_row_and_loses_what_its_model_loses() {
    let test = "a_trace_is_played_row_by_row_and_loses_what_its_model_loses";
    let Some((_net, publisher, slow)) = two_hosts(test) else { return };
    let rows = [(0.0, 0.0), (0.3, 5.0), (1.0, 0.0), (0.1, 30.0)];
    let lines = rows.iter().enumerate().map(|(at, (loss, delay_ms))| format!("{at},{loss},{delay_ms}\n"));
    let (_folder, path) = trace_file(&lines.collect::<String>());
    // A busy machine may miss a row, so the measurement is repeated.
    support::wait_until("packets in every row of the trace", || {
        let arguments = format!("--trace {path} --trace-speed 1.25 --seed 4 --state off");
        let mut link = Impairment::start(&slow, &publisher, &arguments);
        let mut flow = Flow::new(&publisher, &slow, 100);
        let receiver = flow.receive();
        assert_eq!(link.counters()["trace"]["row"], serde_json::Value::Null, "it has not begun");
        link.on();
        let mut behind = 0;
        while behind < 50 {
            flow.send(20);
            std::thread::sleep(Duration::from_millis(5));
            behind += u32::from(link.counters()["trace"]["row"] == 3);
        }
        let sent = flow.sent.len() as u32;
        let counters = link.wait_seen(u64::from(sent));
        let received = flow.received(receiver);
        let ended = link.end();
        let counts = counts_of_rows(&ended);
        assert_eq!(counts.iter().map(|(judged, _)| judged).sum::<u32>(), sent, "{ended}");
        assert_eq!((&ended["trace"]["repeat"], &ended["trace"]["length_s"]), (&false.into(), &3.2.into()));

        // The same rows, in virtual time, with as many packets in each.
        let model = |(loss, delay_ms): (f64, f64)| {
            (GilbertElliott::independent(loss).unwrap(), NormalDelay::new(delay_ms, 0.0).unwrap())
        };
        let (loss, delay) = model(rows[0]);
        let mut virtual_link = Link::new(&Model { loss, delay, seed: 4 });
        let mut expected = BTreeSet::new();
        let mut delays_ms = Vec::new();
        for (row, (judged, lost)) in rows.iter().zip(&counts) {
            let (loss, delay) = model(*row);
            virtual_link.set(loss, delay);
            for _ in 0..*judged {
                let packet = delays_ms.len() as u32;
                delays_ms.push(row.1);
                let fate = virtual_link.arrive(Arrival { packet, bytes: 0, fragment: false }, MonotonicNs(0));
                if fate != Fate::Drop {
                    expected.insert(packet);
                }
            }
            let share = f64::from(*lost) / f64::from((*judged).max(1));
            let tolerance = 5.0 * loss.loss_standard_error(u64::from(*judged));
            assert!((share - loss.stationary_loss()).abs() <= tolerance, "{row:?}: {lost} of {judged}");
        }
        assert_eq!(numbers(&received), expected);
        for Received { number, sent, came } in received {
            let (seen_ms, delay_ms) =
                (came.duration_since(sent).as_secs_f64() * 1e3, delays_ms[number as usize]);
            assert!(seen_ms >= delay_ms, "packet {number}: {seen_ms} of {delay_ms} ms");
        }
        let number = |key: &str| counters[key].as_f64().unwrap();
        let off = (number("loss") - number("loss_expected")).abs();
        assert!(off <= 5.0 * number("loss_standard_error"), "{counters}");
        counts.iter().all(|(judged, _)| *judged >= 100)
    });
}

#[test]
fn a_trace_that_is_repeated_begins_anew_and_goes_on_while_the_link_is_off() {
    let test = "a_trace_that_is_repeated_begins_anew_and_goes_on_while_the_link_is_off";
    let Some((_net, publisher, slow)) = two_hosts(test) else { return };
    let (_folder, path) = trace_file("0,0,0\n0.2,1,0\n");
    let mut link = Impairment::start(&slow, &publisher, &format!("--trace {path} --trace-repeat"));
    let mut flow = Flow::new(&publisher, &slow, 100);
    let receiver = flow.receive();
    let mut send_until_round = |link: &mut Impairment, round: u64| {
        while link.counters()["trace"]["round"].as_u64() < Some(round) {
            flow.send(10);
            std::thread::sleep(Duration::from_millis(5));
        }
        link.wait_seen(flow.sent.len() as u64)
    };
    let round = send_until_round(&mut link, 5)["trace"]["round"].as_u64().unwrap();
    let judged = link.off()["judged"].clone();
    // The trace continues while the link is off.
    assert_eq!(send_until_round(&mut link, round + 2)["judged"], judged);
    let counters = link.counters();
    let counts = counts_of_rows(&link.end());
    assert_eq!(counts.iter().map(|(judged, _)| u64::from(*judged)).sum::<u64>(), judged.as_u64().unwrap());
    let ((first, lost_of_first), (second, lost_of_second)) = (counts[0], counts[1]);
    assert!(first > 0 && second > 0, "{counts:?}");
    assert_eq!((lost_of_first, lost_of_second), (0, second), "all or nothing, by the row");
    assert_eq!((&counters["lost"], &counters["lost_expected"]), (&second.into(), &f64::from(second).into()));
    assert_eq!(flow.received(receiver).len(), flow.sent.len() - second as usize);
}

#[test]
fn only_the_source_is_impaired_and_a_large_burst_is_not_lost() {
    let test = "only_the_source_is_impaired_and_a_large_burst_is_not_lost";
    if let Some(reason) = support::netns::requires_root() {
        support::skip(test, &reason);
        return;
    }
    let net = Net::new(&["publisher", "other", "slow"]);
    let [publisher, other, slow] = ["publisher", "other", "slow"].map(|name| net.host(name).clone());
    let mut link = Impairment::start(&slow, &publisher, "--state down");
    let mut flow = Flow::new(&other, &slow, 100);
    let receiver = flow.receive();
    flow.send(500);
    receiver.wait_received(500);
    assert_eq!(numbers(&flow.received(receiver)).len(), 500);
    assert_eq!(link.counters()["seen"], 0);

    // 850 fragments at once: faster than the program handles them, and fewer than a network queue of the
    // kernel holds (1,000).
    link.off();
    let mut flow = Flow::new(&publisher, &slow, 50_000);
    let receiver = flow.receive();
    flow.send(25);
    let counters = link.wait_seen(25 * 34);
    assert_eq!((&counters["kernel_dropped"], &counters["cut"]), (&0.into(), &0.into()));
    assert_eq!(numbers(&flow.received(receiver)).len(), 25);
}

#[test]
fn what_a_link_is_too_slow_for_is_counted_apart_from_what_its_model_loses() {
    let test = "what_a_link_is_too_slow_for_is_counted_apart_from_what_its_model_loses";
    let Some((_net, publisher, slow)) = two_hosts(test) else { return };
    // More than the queue holds, which is 100,000 or less.
    const PACKETS: u64 = 110_000;
    let mut link = Impairment::start(&slow, &publisher, "--level strong --reading as-printed --seed 6");
    let mut flow = Flow::new(&publisher, &slow, 100);
    let receiver = flow.receive();
    link.signal(Signal::SIGSTOP);
    flow.send(PACKETS as u32);
    link.signal(Signal::SIGCONT);
    let count = |counters: &serde_json::Value, key: &str| counters[key].as_u64().unwrap();
    let counters = support::wait_for("a verdict on every packet", || {
        let counters = link.counters();
        let seen = count(&counters, "seen") + count(&counters, "kernel_dropped");
        (seen == PACKETS).then_some(counters)
    });
    let received = numbers(&flow.received(receiver));
    let (seen, unseen) = (count(&counters, "seen"), count(&counters, "kernel_dropped"));
    assert!(seen > 0 && unseen > 0, "{counters}");
    assert_eq!(count(&counters, "seen"), count(&counters, "lost") + count(&counters, "passed"), "{counters}");
    // The first ones were in the queue; the model loses the same ones of them as without the overflow.
    assert_eq!(received, passing(Level::Strong.model(Reading::AsPrinted), 6, seen as u32));
}

#[test]
fn nothing_is_left_by_one_that_ends_and_one_that_is_killed_is_cleaned_up_after_by_the_next() {
    let test = "nothing_is_left_by_one_that_ends_and_one_that_is_killed_is_cleaned_up_after_by_the_next";
    let Some((_net, publisher, slow)) = two_hosts(test) else { return };
    let link = Impairment::start(&slow, &publisher, "--state down");
    assert_eq!(traces(&slow), (1, 1));
    link.end();
    assert_eq!(traces(&slow), (0, 0));

    Impairment::start(&slow, &publisher, "--state down --queue 3").kill9();
    assert_eq!(traces(&slow), (1, 0), "a killed program leaves its rule");
    // Without a listening program the host is not cut off.
    let mut flow = Flow::new(&publisher, &slow, 100);
    let receiver = flow.receive();
    flow.send(10);
    receiver.wait_received(10);

    let link = Impairment::start(&slow, &publisher, "--state down");
    assert_eq!(traces(&slow), (1, 1), "{}", link.log());
    // A second link beside it takes none of its packets.
    let second = Impairment::start(&slow, &publisher, "--state down --queue 3");
    assert_eq!(traces(&slow), (2, 2));
    second.end();
    assert_eq!(traces(&slow), (1, 1));
    link.end();
    assert_eq!(traces(&slow), (0, 0));
}

#[test]
fn what_can_not_be_is_said() {
    let Some((_net, publisher, slow)) = two_hosts("what_can_not_be_is_said") else { return };
    let _link = Impairment::start(&slow, &publisher, "--queue 4");
    let (_folder, bad) = trace_file("0,3,0\n");
    let run = |arguments: &str| {
        let mut command = slow.command(support::impairment::program());
        command.args(arguments.split_whitespace());
        let output = command.stdin(std::process::Stdio::null()).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    for (arguments, code, message) in [
        ("impair --source 10.0.0.1 --backend nfqueue --queue 4", 1, "another program listens on NFQUEUE 4"),
        ("impair --source 10.0.0.1 --gilbert-elliott 2 0 0 0", 2, "p is 2, but must be 0 to 1"),
        ("impair --source 10.0.0.1 --delay-ms -1", 2, "unexpected argument"),
        ("impair --source 10.0.0.1 --jitter-ms 1e9", 2, "0 to 60000 ms"),
        ("impair --source 10.0.0.1 --level mild", 2, "--reading"),
        ("impair --source 10.0.0.1 --trace /nowhere.csv", 2, "/nowhere.csv: No such file"),
        (
            &format!("impair --source 10.0.0.1 --trace {bad}"),
            2,
            "trace.csv:2: loss is '3', but must be 0 to 1",
        ),
        ("impair --source 10.0.0.1 --trace a.csv --level mild", 2, "cannot be used with"),
        ("impair --source 10.0.0.1 --trace a.csv --delay-ms 3", 2, "cannot be used with"),
        ("impair --source 10.0.0.1 --trace-repeat", 2, "--trace"),
        ("impair --source 10.0.0.1 --trace a.csv --trace-speed 0", 2, "must be 0.001 to"),
        ("impair --source nowhere", 2, "invalid value 'nowhere'"),
        ("impair", 2, "--source"),
    ] {
        let (status, stderr) = run(arguments);
        assert_eq!(status, Some(code), "{arguments}: {stderr}");
        assert!(stderr.contains(message), "{arguments}: {stderr}");
    }
    assert_eq!(traces(&slow), (1, 1), "the one that runs is not disturbed");
}

#[test]
fn every_key_of_the_output_is_documented_and_every_documented_key_exists() {
    let Some((_net, publisher, slow)) =
        two_hosts("every_key_of_the_output_is_documented_and_every_documented_key_exists")
    else {
        return;
    };
    let page = support::root().join("docs/eval-json.md");
    let page = std::fs::read_to_string(page).unwrap();
    let rows = page.lines().filter_map(|line| line.strip_prefix("| `")?.split(" |").next());
    let documented: BTreeSet<&str> =
        rows.flat_map(|cell| cell.split(',').map(|key| key.trim_matches([' ', '`']))).collect();
    let (_folder, trace) = trace_file("0,0.5,0\n");
    let ended = Impairment::start(&slow, &publisher, &format!("--trace {trace}")).end();
    let keys = |prefix: &str, value: &serde_json::Value| -> Vec<String> {
        value.as_object().unwrap().keys().map(|key| format!("{prefix}{key}")).collect()
    };
    let mut printed: BTreeSet<String> = keys("", &ended).into_iter().collect();
    printed.extend(keys("trace.", &ended["trace"]));
    printed.extend(keys("trace.rows[].", &ended["trace"]["rows"][0]));
    let documented: BTreeSet<String> = documented.into_iter().map(str::to_owned).collect();
    assert_eq!(printed, documented);
    let counters = Impairment::start(&slow, &publisher, "--level mild --reading as-run").end();
    assert_eq!(keys("", &counters), keys("", &ended), "a trace changes no key");
    assert_eq!(counters["trace"], serde_json::Value::Null);
    assert_eq!((&counters["backend"], &counters["seed"]), (&"nfqueue".into(), &1.into()));
    assert_eq!(counters["loss"], serde_json::Value::Null);
}
