//! Limits how often announcements of unknown participants reach discovery.
//!
//! For each new participant the event loop matches its built-in endpoints and sends it
//! the announcements of all local endpoints. Announcements can be forged at any rate,
//! and the same thread receives samples.

use std::{
  collections::{BTreeMap, BTreeSet},
  net::IpAddr,
  time::{Duration, Instant},
};

use crate::structure::guid::GuidPrefix;

// A host that starts 100 nodes at once is within the burst. What is dropped of a
// larger start is repeated within 3 s (Fast DDS) to 8 s (Cyclone DDS).
const OF_ONE_ADDRESS: Limit = Limit {
  interval: Duration::from_millis(31),
  burst: 128,
};
const OF_ALL: Limit = Limit {
  interval: Duration::from_millis(8),
  burst: 1_024,
};
// Source addresses can be forged, too.
const MAX_ADDRESSES: usize = 256;

struct Limit {
  interval: Duration,
  burst: u32,
}

// The time up to which announcements have used their share.
#[derive(Clone, Copy)]
struct PaidUntil(Instant);

impl PaidUntil {
  fn admits(&self, limit: &Limit, now: Instant) -> bool {
    self.0 <= now + limit.interval * (limit.burst - 1)
  }

  fn pay(&mut self, limit: &Limit, now: Instant) {
    self.0 = self.0.max(now) + limit.interval;
  }
}

#[derive(Default)]
pub(crate) struct Newcomers {
  known: BTreeSet<GuidPrefix>,
  by_address: BTreeMap<IpAddr, PaidUntil>,
  // Of addresses beyond MAX_ADDRESSES, together.
  of_others: Option<PaidUntil>,
  of_all: Option<PaidUntil>,
}

impl Newcomers {
  pub fn insert_known(&mut self, prefix: GuidPrefix) {
    self.known.insert(prefix);
  }

  pub fn remove_known(&mut self, prefix: GuidPrefix) {
    self.known.remove(&prefix);
  }

  /// Whether an announcement that came from `address` is to be handled.
  pub fn admit(&mut self, prefix: GuidPrefix, address: IpAddr, now: Instant) -> bool {
    if self.known.contains(&prefix) {
      return true;
    }
    let unused = PaidUntil(now);
    let is_full = |by_address: &BTreeMap<IpAddr, PaidUntil>| {
      by_address.len() >= MAX_ADDRESSES && !by_address.contains_key(&address)
    };
    if is_full(&self.by_address) {
      self.by_address.retain(|_, paid| paid.0 > now);
    }
    let of_address = if is_full(&self.by_address) {
      self.of_others.get_or_insert(unused)
    } else {
      self.by_address.entry(address).or_insert(unused)
    };
    let of_all = self.of_all.get_or_insert(unused);
    let admitted = of_address.admits(&OF_ONE_ADDRESS, now) && of_all.admits(&OF_ALL, now);
    if admitted {
      of_address.pay(&OF_ONE_ADDRESS, now);
      of_all.pay(&OF_ALL, now);
    }
    admitted
  }
}

#[cfg(test)]
mod tests {
  use super::*;

  fn prefix(number: u32) -> GuidPrefix {
    let mut bytes = [7; 12];
    bytes[8..].copy_from_slice(&number.to_be_bytes());
    GuidPrefix::new(&bytes)
  }

  fn address(number: u32) -> IpAddr {
    IpAddr::from(number.to_be_bytes())
  }

  #[test]
  fn one_address_has_a_burst_and_a_rate_of_newcomers() {
    let (mut newcomers, start) = (Newcomers::default(), Instant::now());
    let mut admitted = |from: u32, ms: u64| {
      let now = start + Duration::from_millis(ms);
      (0..10_000).filter(|n| newcomers.admit(prefix(from + n), address(1), now)).count()
    };
    assert_eq!(admitted(0, 0), 128);
    assert_eq!(admitted(10_000, 1_000), 32);
    assert_eq!(admitted(20_000, 60_000), 128);
  }

  #[test]
  fn a_flood_from_one_address_leaves_room_for_others_and_for_the_known() {
    let (mut newcomers, now) = (Newcomers::default(), Instant::now());
    newcomers.insert_known(prefix(5));
    for n in 0..100_000 {
      newcomers.admit(prefix(10 + n), address(1), now);
    }
    assert!(newcomers.admit(prefix(5), address(1), now), "a known participant");
    assert!(!newcomers.admit(prefix(6), address(1), now));
    assert!(newcomers.admit(prefix(6), address(2), now), "another host");
  }

  #[test]
  fn a_flood_from_forged_addresses_is_limited_in_rate_and_in_memory() {
    let now = Instant::now();
    let admitted_from = |newcomers: &mut Newcomers, addresses: u32| {
      let flood = 0..100_000;
      flood.filter(|n| newcomers.admit(prefix(*n), address(*n % addresses), now)).count()
    };
    assert_eq!(admitted_from(&mut Newcomers::default(), 100), 1_024);
    // One for each of the counted addresses, and a burst for all others together.
    let mut newcomers = Newcomers::default();
    assert_eq!(admitted_from(&mut newcomers, 100_000), MAX_ADDRESSES + 128);
    assert!(newcomers.by_address.len() <= MAX_ADDRESSES);
    let later = now + Duration::from_secs(100);
    assert!(newcomers.admit(prefix(1), address(200_000), later));
  }
}
