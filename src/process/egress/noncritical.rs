//! Noncritical lanes: forward as many samples as their tokens allow, chosen by the lane's drop policy.

use std::ops::Range;

use super::Turn;
use super::arena::CopyArena;
use super::output::Output;
use crate::clock;
use crate::config::{DropPolicy, Lane, LaneRates, SafetyRules};
use crate::dds::Participant;
use crate::model::{DropReason, Durability, LaneMode, MAX_PUBLISHERS, MonotonicNs};
use crate::policy::{ByteBudget, Decision, PollOrder, RouteShaper, SampleStamps};
use crate::shm::ShmSample;

pub(super) struct Noncritical {
    rates: LaneRates,
    queues: Queues,
    mode: LaneMode,
    budget: ByteBudget,
    /// The outputs of each priority, the highest first. Outputs of the same priority take turns.
    turn_orders: Vec<(Range<usize>, PollOrder)>,
    shapers: Vec<RouteShaper<ShmSample>>,
}

impl Noncritical {
    /// Starts in normal mode. `more_urgent` is, for each output, the number of outputs before it that have a
    /// higher priority.
    pub fn new(
        lane: &Lane,
        more_urgent: &[usize],
        rates: LaneRates,
        rules: &SafetyRules,
        now: MonotonicNs,
    ) -> Self {
        let queues = Queues::of(rules, lane.max_borrowed_in_all());
        let shapers = lane
            .outputs
            .iter()
            .map(|output| RouteShaper::new(queues.rates_of(rates, output.qos.durability, false), now))
            .collect();
        let turn_orders = more_urgent
            .chunk_by(|one, other| one == other)
            .scan(0, |start, chunk| {
                let outputs = *start..*start + chunk.len();
                *start = outputs.end;
                Some((outputs, PollOrder::default()))
            })
            .collect();
        Self {
            rates,
            queues,
            mode: LaneMode::Normal,
            budget: ByteBudget::new(rates.normal.max_bytes_per_s, now),
            turn_orders,
            shapers,
        }
    }

    /// Applies other rates. Queued samples stay queued, except those beyond a new, shorter queue.
    pub fn set_rates(
        &mut self,
        rates: LaneRates,
        rules: &SafetyRules,
        outputs: &mut [Output],
        now: MonotonicNs,
    ) {
        self.rates = rates;
        self.queues = Queues::of(rules, self.queues.max_borrowed);
        self.budget.set_mode(&rates, self.mode, now);
        self.follow_publishers(outputs, now);
    }

    /// Applies the rates again after the durability of an output or its kind of topic has changed.
    pub fn follow_publishers(&mut self, outputs: &mut [Output], now: MonotonicNs) {
        for (shaper, output) in self.shapers.iter_mut().zip(outputs.iter_mut()) {
            let rates = self.queues.rates_of(self.rates, output.durability.get(), output.has_keys());
            shaper.set_rates(rates, now, |sample, _, reason| output.drop_sample(&sample, reason));
            output.set_queued(shaper.waiting());
        }
    }

    /// Queues the samples that wait in shared memory and forwards as many as the tokens allow.
    pub fn step(
        &mut self,
        outputs: &mut [Output],
        participant: &mut Participant,
        arena: &mut CopyArena,
        mode: LaneMode,
    ) -> Turn {
        let now = clock::monotonic();
        if mode != self.mode {
            self.mode = mode;
            self.budget.set_mode(&self.rates, mode, now);
            for (shaper, output) in self.shapers.iter_mut().zip(outputs.iter_mut()) {
                shaper.set_mode(mode, now, |sample, _, reason| output.drop_sample(&sample, reason));
            }
        }
        for (shaper, output) in self.shapers.iter_mut().zip(outputs.iter_mut()) {
            fill_queue(shaper, output, self.rates, self.queues, now);
        }
        let now = clock::monotonic();
        let now_wall = clock::wall();
        let mut token_at = MonotonicNs(u64::MAX);
        let mut waits_for_sample = false;
        let mut sent = false;
        for (same_priority, turn_order) in &mut self.turn_orders {
            for place in turn_order.order(same_priority.len()) {
                let index = same_priority.start + place;
                let (shaper, output) = (&mut self.shapers[index], &mut outputs[index]);
                loop {
                    let decision = shaper.poll(&mut self.budget, now, now_wall, |sample, _, reason| {
                        output.drop_sample(&sample, reason);
                    });
                    match decision {
                        Decision::Send(sample, _) => {
                            output.send(sample, participant, arena);
                            turn_order.sent(place);
                            sent = true;
                        }
                        Decision::SleepUntil(at) => {
                            token_at = MonotonicNs(token_at.0.min(at.0));
                            // Samples wake the lane also without a token: several latched publishers may
                            // send more samples at once than the channel has room for. Of a topic with keys,
                            // the channel would lose the end of a key.
                            waits_for_sample |=
                                output.durability.get() == Durability::TransientLocal || output.has_keys();
                            break;
                        }
                        Decision::WaitForSample => {
                            waits_for_sample = true;
                            break;
                        }
                        Decision::Closed => break,
                    }
                }
                output.set_queued(shaper.waiting());
            }
        }
        if sent {
            // More samples may have arrived meanwhile, and tokens may be left.
            Turn::Busy
        } else if waits_for_sample {
            Turn::UntilWoken(token_at)
        } else {
            Turn::Until(token_at)
        }
    }

    pub fn shut_down(&mut self, outputs: &mut [Output]) {
        let now = clock::monotonic();
        for (shaper, output) in self.shapers.iter_mut().zip(outputs.iter_mut()) {
            fill_queue(shaper, output, self.rates, self.queues, now);
            shaper.clear(DropReason::Shutdown, |sample, _, reason| output.drop_sample(&sample, reason));
            output.set_queued(0);
        }
    }
}

/// Moves the route's samples from the channel in shared memory to the lane's own queue. The first sample of a
/// publisher may change the durability, and with it the rates that apply to this sample.
fn fill_queue(
    shaper: &mut RouteShaper<ShmSample>,
    output: &mut Output,
    rates: LaneRates,
    queues: Queues,
    now: MonotonicNs,
) {
    while let Some(sample) = output.take() {
        if output.durability.take_change() {
            let rates = queues.rates_of(rates, output.durability.get(), output.has_keys());
            shaper.set_rates(rates, now, |dropped, _, reason| output.drop_sample(&dropped, reason));
        }
        let stamps = SampleStamps::new(sample.header(), sample.payload().len() as u64);
        shaper.offer(sample, stamps, |dropped, _, reason| output.drop_sample(&dropped, reason));
    }
}

/// The samples of a topic that may wait, unless `queue_samples` is more.
#[derive(Clone, Copy)]
struct Queues {
    /// Of a latched topic: room for a sample of each publisher, because all may be discovered at once, but
    /// not so much that the queue counts as overflowing. What it holds in shared memory is bounded by
    /// `max_borrowed`; more waits in the channel.
    latched: usize,
    /// Of a topic with keys, the freshest of each: not so many that more waits in the channel, which would
    /// lose the end of a key. The lane holds two more: the next one and the one that it sends.
    keyed: usize,
    max_borrowed: usize,
}

impl Queues {
    fn of(rules: &SafetyRules, max_borrowed: usize) -> Self {
        let latched = rules.max_noncritical_queue.min(MAX_PUBLISHERS);
        Self { latched, keyed: latched.min(max_borrowed.saturating_sub(2)), max_borrowed }
    }

    /// The rates of an output. TRANSIENT_LOCAL publishers publish state (a map, static transforms): their
    /// samples do not become stale and do not supersede each other, so they are sent in order, at the lane's
    /// rate.
    fn rates_of(self, lane: LaneRates, durability: Durability, has_keys: bool) -> LaneRates {
        let mut rates = lane;
        for rate in [&mut rates.normal, &mut rates.degraded] {
            if durability == Durability::TransientLocal {
                rate.stale_threshold_ms = 0;
                rate.drop_policy = DropPolicy::DropStale;
                rate.queue_samples = rate.queue_samples.max(self.latched);
            } else if has_keys && rate.drop_policy == DropPolicy::DropOldest {
                rate.queue_samples = rate.queue_samples.max(self.keyed);
            }
        }
        rates
    }
}
