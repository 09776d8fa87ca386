//! Decides which pool may take more shared memory: one budget for the pools of all routes.

use alloc::vec::Vec;

use crate::model::MonotonicNs;

/// What a pool on the critical lane can always take, whatever the others have taken: 300 scans.
const CRITICAL_RESERVE_BYTES: u64 = 1 << 20;
/// What a pool on noncritical lanes alone can always take.
const NONCRITICAL_RESERVE_BYTES: u64 = 256 << 10;

/// For how long a slot is idle until the memory of its payload is given back: longer than between the samples
/// of a flow, which would pay for it with an allocation each.
const IDLE_MS: u64 = 60_000;
/// The same while a route is short of memory. With the default of eight retained samples, a slot has a sample
/// each 9 s at 1 Hz: a flow of images at this rate or more keeps its memory.
const SHORT_IDLE_MS: u64 = 10_000;
/// For how long after a refusal a route counts as short.
const SHORT_MS: u64 = 2_000;

/// Why a pool gets no more shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BudgetRefusal {
    /// The route holds as much as one route may.
    Quota,
    /// What is left of the budget is withheld for other routes, or there is none.
    Budget,
}

/// The pool of a route, as it is when ingress starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolDemand {
    /// What the pool takes at the start.
    pub first_bytes: u64,
    /// What it takes if each slot has the largest sample.
    pub most_bytes: u64,
    /// The samples of a steady flow: those that are retained, those that ingress fills, and one that waits. A
    /// retained sample leaves its slot only when the next one is published, so with fewer a route that is
    /// refused memory never gets any.
    pub steady_samples: u64,
    /// Whether the critical lane serves the route.
    pub is_critical: bool,
}

#[derive(Clone, Copy, Debug)]
struct Pool {
    first_bytes: u64,
    used_bytes: u64,
    peak_bytes: u64,
    /// What the pool can always have, with what it has at the start.
    reserve_bytes: u64,
    largest_bytes: u64,
    most_bytes: u64,
    steady_samples: u64,
}

impl Pool {
    /// What a steady flow of the largest sample needs, with what the pool has at the start.
    fn steady_bytes(&self) -> u64 {
        self.first_bytes.saturating_add(self.largest_bytes.saturating_mul(self.steady_samples))
    }
}

/// The shared memory that the pools of all routes may take together, and what each has taken.
///
/// No route can take what another one needs: its reserve and, once its samples are known, room for a steady
/// flow of the largest, up to an equal share of the budget. If all pools fit the budget, nothing is refused.
#[derive(Clone, Debug)]
pub struct MemoryBudget {
    limit_bytes: u64,
    /// The equal share of a route in what the start leaves.
    share_bytes: u64,
    /// The most that a route may take beside what it has at the start.
    quota_bytes: u64,
    used_bytes: u64,
    peak_bytes: u64,
    pools: Vec<Pool>,
    /// Whether memory was refused since `idle_ms` was called last.
    refused: bool,
    short_until: MonotonicNs,
}

impl MemoryBudget {
    /// The budget of these pools, which have what they take at the start.
    pub fn new(limit_bytes: u64, demands: &[PoolDemand]) -> Self {
        let used_bytes = demands.iter().fold(0_u64, |sum, one| sum.saturating_add(one.first_bytes));
        let free_bytes = limit_bytes.saturating_sub(used_bytes);
        let share_bytes = free_bytes / (demands.len() as u64).max(1);
        let pools = demands.iter().map(|one| {
            let reserve = if one.is_critical { CRITICAL_RESERVE_BYTES } else { NONCRITICAL_RESERVE_BYTES };
            Pool {
                first_bytes: one.first_bytes,
                used_bytes: one.first_bytes,
                peak_bytes: one.first_bytes,
                // Half a share, so that most of a small budget goes to the routes that need it.
                reserve_bytes: one.first_bytes.saturating_add(reserve.min(share_bytes / 2)),
                largest_bytes: 0,
                most_bytes: one.most_bytes,
                steady_samples: one.steady_samples,
            }
        });
        let most_bytes = demands.iter().fold(0_u64, |sum, one| sum.saturating_add(one.most_bytes));
        let has_quota = demands.len() > 1 && most_bytes > limit_bytes;
        Self {
            limit_bytes,
            share_bytes,
            quota_bytes: if has_quota { free_bytes / 2 } else { free_bytes },
            used_bytes,
            peak_bytes: used_bytes,
            pools: pools.collect(),
            refused: false,
            short_until: MonotonicNs(0),
        }
    }

    /// Notes that a route has samples that take so many bytes in a slot.
    pub fn note_sample(&mut self, route: usize, sample_bytes: u64) {
        let pool = &mut self.pools[route];
        pool.largest_bytes = pool.largest_bytes.max(sample_bytes);
    }

    /// Takes memory for the pool of a route.
    ///
    /// # Errors
    /// The memory is not granted, and nothing is taken.
    pub fn take(&mut self, route: usize, bytes: u64) -> Result<(), BudgetRefusal> {
        let taken = self.try_take(route, bytes);
        self.refused |= taken.is_err();
        taken
    }

    fn try_take(&mut self, route: usize, bytes: u64) -> Result<(), BudgetRefusal> {
        let pool = &self.pools[route];
        let used = pool.used_bytes.saturating_add(bytes);
        let in_reserve = used <= pool.reserve_bytes;
        let over_quota =
            used.saturating_sub(pool.first_bytes) > self.quota_bytes && used > pool.steady_bytes();
        let withheld = |(index, pool): (usize, &Pool)| {
            let kept = pool.steady_bytes().min(pool.first_bytes.saturating_add(self.share_bytes));
            let kept = kept.max(pool.reserve_bytes).min(pool.most_bytes);
            if index == route { 0 } else { kept.saturating_sub(pool.used_bytes) }
        };
        // What the others need does not count against the reserve, which was withheld from them.
        let withheld = match in_reserve {
            true => 0,
            false => self.pools.iter().enumerate().map(withheld).fold(0_u64, u64::saturating_add),
        };
        let all = self.used_bytes.saturating_add(bytes);
        if all.saturating_add(withheld) > self.limit_bytes {
            return Err(BudgetRefusal::Budget);
        }
        if over_quota && !in_reserve {
            return Err(BudgetRefusal::Quota);
        }
        let pool = &mut self.pools[route];
        pool.used_bytes = used;
        pool.peak_bytes = pool.peak_bytes.max(used);
        self.used_bytes = all;
        self.peak_bytes = self.peak_bytes.max(all);
        Ok(())
    }

    /// Returns memory of the pool of a route.
    pub fn give_back(&mut self, route: usize, bytes: u64) {
        let pool = &mut self.pools[route];
        let bytes = bytes.min(pool.used_bytes);
        pool.used_bytes -= bytes;
        self.used_bytes -= bytes;
    }

    /// Notes that the system had no memory, as if the budget had refused it.
    pub fn note_refusal(&mut self) {
        self.refused = true;
    }

    /// For how long, in milliseconds, a free slot must have had no sample of its size until its memory is
    /// given back: a minute, and 10 s while a route is short of memory.
    pub fn idle_ms(&mut self, now: MonotonicNs) -> u64 {
        if core::mem::take(&mut self.refused) {
            self.short_until = now.plus_ms(SHORT_MS);
        }
        if now < self.short_until { SHORT_IDLE_MS } else { IDLE_MS }
    }

    /// The budget.
    pub fn limit_bytes(&self) -> u64 {
        self.limit_bytes
    }

    /// What all pools have taken, and the most that they ever had.
    pub fn used_and_peak(&self) -> (u64, u64) {
        (self.used_bytes, self.peak_bytes)
    }

    /// What the pool of a route has taken, and the most that it ever had.
    pub fn used_and_peak_of(&self, route: usize) -> (u64, u64) {
        (self.pools[route].used_bytes, self.pools[route].peak_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::BudgetRefusal::{Budget, Quota};
    use super::*;

    const MIB: u64 = 1 << 20;

    fn critical(count: usize) -> Vec<PoolDemand> {
        let demand = PoolDemand {
            first_bytes: 480 << 10,
            most_bytes: 2_000 * MIB,
            steady_samples: 3,
            is_critical: true,
        };
        vec![demand; count]
    }

    /// Takes memory for samples of that size until there is none, and returns their number and why.
    fn fill(budget: &mut MemoryBudget, route: usize, sample_bytes: u64) -> (usize, BudgetRefusal) {
        for count in 0.. {
            budget.note_sample(route, sample_bytes);
            if let Err(refusal) = budget.take(route, sample_bytes) {
                return (count, refusal);
            }
        }
        unreachable!()
    }

    #[test]
    fn sixty_scans_four_cameras_and_two_clouds_fit_512_mib() {
        let mut budget = MemoryBudget::new(512 * MIB, &critical(66));
        for _ in 0..10 {
            for route in 0..66 {
                let bytes = match route {
                    0..60 => 4 << 10,
                    60..64 => 6 * MIB,
                    _ => 2 * MIB,
                };
                budget.note_sample(route, bytes);
                assert_eq!(budget.take(route, bytes), Ok(()), "{route}");
            }
        }
        assert!(budget.used_and_peak().0 < 512 * MIB);
    }

    #[test]
    fn a_route_cannot_take_the_last_slot_of_another_one() {
        let mut budget = MemoryBudget::new(256 * MIB, &critical(8));
        // A second camera has been seen once; the first one is stuck and takes all that it may.
        budget.note_sample(1, 6 * MIB);
        budget.take(1, 6 * MIB).unwrap();
        let (count, refusal) = fill(&mut budget, 0, 6 * MIB);
        assert_eq!((count, refusal), (21, Quota));
        for _ in 1..3 {
            budget.note_sample(1, 6 * MIB);
            budget.take(1, 6 * MIB).unwrap();
        }
        for other in 2..8 {
            budget.note_sample(other, 64 << 10);
            budget.take(other, 64 << 10).unwrap();
        }
        assert!(budget.used_and_peak().0 <= budget.limit_bytes());
        // A route that was never seen has its reserve of 1 MiB, although others wait for memory.
        let mut scans = MemoryBudget::new(256 * MIB, &critical(8));
        for route in 0..7 {
            fill(&mut scans, route, 6 * MIB);
        }
        assert_eq!(fill(&mut scans, 7, 8 << 10), (128, Budget));
    }

    #[test]
    fn critical_routes_keep_a_larger_reserve_and_a_small_pool_none_that_it_cannot_use() {
        let mut demands = critical(3);
        demands[1].is_critical = false;
        demands[2].most_bytes = demands[2].first_bytes;
        demands.iter_mut().for_each(|one| one.first_bytes = 0);
        demands[2].most_bytes = 0;
        let mut budget = MemoryBudget::new(64 * MIB, &demands);
        let mut others = budget.clone();
        fill(&mut budget, 1, 4 << 10);
        fill(&mut budget, 2, 4 << 10);
        assert_eq!(fill(&mut budget, 0, 4 << 10), (256, Budget));
        fill(&mut others, 0, 4 << 10);
        fill(&mut others, 2, 4 << 10);
        assert_eq!(fill(&mut others, 1, 4 << 10), (64, Budget));
    }

    #[test]
    fn nothing_is_refused_if_all_pools_fit_the_budget() {
        let mut demands = critical(3);
        demands.iter_mut().for_each(|one| one.most_bytes = 85 * MIB);
        let mut budget = MemoryBudget::new(256 * MIB, &demands);
        for route in 0..3 {
            for _ in 0..42 {
                budget.note_sample(route, 2 * MIB);
                budget.take(route, 2 * MIB).unwrap();
            }
        }
    }

    #[test]
    fn a_route_has_room_for_its_steady_flow_although_that_exceeds_the_quota() {
        let mut demands = critical(2);
        demands[0].steady_samples = 12;
        let mut budget = MemoryBudget::new(100 * MIB, &demands);
        assert_eq!(fill(&mut budget, 0, 6 * MIB), (12, Quota));
    }

    #[test]
    fn idle_memory_is_given_back_sooner_while_a_route_is_short() {
        let at = |ms| MonotonicNs(0).plus_ms(ms);
        let mut budget = MemoryBudget::new(10 * MIB, &critical(1));
        assert_eq!(budget.idle_ms(at(0)), 60_000);
        fill(&mut budget, 0, MIB);
        assert_eq!(
            [5_000, 5_001, 6_999, 7_000].map(|ms| budget.idle_ms(at(ms))),
            [10_000, 10_000, 10_000, 60_000]
        );
        budget.note_refusal();
        assert_eq!(budget.idle_ms(at(8_000)), 10_000);
        // A refusal while the route is short makes that longer.
        fill(&mut budget, 0, MIB);
        assert_eq!([9_500, 11_499, 11_500].map(|ms| budget.idle_ms(at(ms))), [10_000, 10_000, 60_000]);
    }

    #[test]
    fn what_is_only_claimed_costs_other_routes_nothing() {
        let mut claimed = MemoryBudget::new(96 * MIB, &critical(3));
        let mut noted = claimed.clone();
        for route in [0, 2] {
            claimed.take(route, 16 * MIB).unwrap();
            claimed.give_back(route, 16 * MIB);
            noted.note_sample(route, 16 * MIB);
        }
        let [claimed, noted] = [claimed, noted].map(|mut budget| fill(&mut budget, 1, MIB).0);
        assert!(noted < claimed, "{noted}, {claimed}: room is kept for samples that were complete");
    }

    #[test]
    fn what_is_given_back_can_be_taken_again_and_the_peak_stays() {
        let mut budget = MemoryBudget::new(10 * MIB, &critical(1));
        assert_eq!(fill(&mut budget, 0, MIB), (9, Budget));
        budget.give_back(0, 3 * MIB);
        assert_eq!(fill(&mut budget, 0, MIB).0, 3);
        budget.give_back(0, 100 * MIB);
        assert_eq!(budget.used_and_peak_of(0), (0, 9 * MIB + (480 << 10)));
        assert_eq!(budget.used_and_peak(), (0, 9 * MIB + (480 << 10)));
    }
}
