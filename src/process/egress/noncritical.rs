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
    /// The samples of a latched topic that may wait, unless `queue_samples` is more.
    latched_queue: usize,
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
        let latched_queue = latched_queue(rules);
        let shapers = lane
            .outputs
            .iter()
            .map(|output| RouteShaper::new(rates_of(rates, latched_queue, output.qos.durability), now))
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
            latched_queue,
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
        self.latched_queue = latched_queue(rules);
        self.budget.set_mode(&rates, self.mode, now);
        self.follow_durability(outputs, now);
    }

    /// Applies the rates again after the durability of an output has changed.
    pub fn follow_durability(&mut self, outputs: &mut [Output], now: MonotonicNs) {
        for (shaper, output) in self.shapers.iter_mut().zip(outputs.iter_mut()) {
            let rates = rates_of(self.rates, self.latched_queue, output.durability.get());
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
            fill_queue(shaper, output, self.rates, self.latched_queue, now);
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
                            // send more samples at once than the channel has room for.
                            waits_for_sample |= output.durability.get() == Durability::TransientLocal;
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
            fill_queue(shaper, output, self.rates, self.latched_queue, now);
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
    latched_queue: usize,
    now: MonotonicNs,
) {
    while let Some(sample) = output.take() {
        if output.durability.take_change() {
            let rates = rates_of(rates, latched_queue, output.durability.get());
            shaper.set_rates(rates, now, |dropped, _, reason| output.drop_sample(&dropped, reason));
        }
        let stamps = SampleStamps::new(sample.header(), sample.payload().len() as u64);
        shaper.offer(sample, stamps, |dropped, _, reason| output.drop_sample(&dropped, reason));
    }
}

/// The queue for a latched topic: room for a sample of each publisher, because all may be discovered at once,
/// but not so much that the queue counts as overflowing. What it holds in shared memory is bounded by
/// `max_borrowed`; more waits in the channel.
fn latched_queue(rules: &SafetyRules) -> usize {
    rules.max_noncritical_queue.min(MAX_PUBLISHERS)
}

/// The rates of an output. TRANSIENT_LOCAL publishers publish state (a map, static transforms): their samples
/// do not become stale and do not supersede each other, so they are sent in order, at the lane's rate.
fn rates_of(lane: LaneRates, latched_queue: usize, durability: Durability) -> LaneRates {
    let mut rates = lane;
    if durability == Durability::TransientLocal {
        for rate in [&mut rates.normal, &mut rates.degraded] {
            rate.stale_threshold_ms = 0;
            rate.drop_policy = DropPolicy::DropStale;
            rate.queue_samples = rate.queue_samples.max(latched_queue);
        }
    }
    rates
}
