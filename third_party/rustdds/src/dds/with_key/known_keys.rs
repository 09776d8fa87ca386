use std::collections::BTreeMap;

use crate::dds::key::{Key, KeyHash};

// How many keys are remembered. That is for disposes that have only the hash of the
// key: one of a key that is forgotten is ignored.
const MAX_KNOWN_KEYS: usize = 4096;

/// The keys of the instances that a Reader has received, for decoding key hashes
/// back to keys. This is needed when we receive a dispose message via hash only.
///
/// Keys whose hash is the key itself are not remembered. Others are until they
/// are disposed, and beyond a limit those go that were received longest ago.
#[derive(Debug)]
pub(crate) struct KnownKeys<K: Key> {
  keys: BTreeMap<KeyHash, (u64, K)>,
  // By the number in `keys`.
  in_order: BTreeMap<u64, KeyHash>,
  next: u64,
}

impl<K: Key> KnownKeys<K> {
  pub fn new() -> Self {
    Self {
      keys: BTreeMap::new(),
      in_order: BTreeMap::new(),
      next: 0,
    }
  }

  fn is_key_in_hash() -> bool {
    K::from_key_hash(KeyHash::zero()).is_some()
  }

  /// A sample of the instance is received.
  pub fn remember(&mut self, key: impl FnOnce() -> K) {
    if Self::is_key_in_hash() {
      return;
    }
    let key = key();
    let hash = key.hash_key(false);
    if let Some((former, _)) = self.keys.insert(hash, (self.next, key)) {
      self.in_order.remove(&former);
    }
    self.in_order.insert(self.next, hash);
    self.next += 1;
    if self.keys.len() > MAX_KNOWN_KEYS {
      if let Some((_, forgotten)) = self.in_order.pop_first() {
        self.keys.remove(&forgotten);
      }
    }
  }

  /// The instance is disposed.
  pub fn forget(&mut self, key: &K) {
    if !Self::is_key_in_hash() {
      self.remove(key.hash_key(false));
    }
  }

  /// The instance with this hash is disposed; its key, unless it is unknown.
  pub fn forget_by_hash(&mut self, hash: KeyHash) -> Option<K> {
    K::from_key_hash(hash).or_else(|| self.remove(hash))
  }

  fn remove(&mut self, hash: KeyHash) -> Option<K> {
    let (number, key) = self.keys.remove(&hash)?;
    self.in_order.remove(&number);
    Some(key)
  }
}

#[cfg(test)]
mod tests {
  use super::*;
  use crate::structure::guid::GUID;

  #[test]
  fn a_key_is_known_until_it_is_disposed() {
    let mut known = KnownKeys::new();
    let [a, b] = ["a", "b"].map(str::to_owned);
    for key in [&a, &b, &a] {
      known.remember(|| key.clone());
    }
    known.forget(&b);
    assert_eq!(known.forget_by_hash(b.hash_key(false)), None);
    assert_eq!(known.forget_by_hash(a.hash_key(false)), Some(a.clone()));
    assert_eq!(known.forget_by_hash(a.hash_key(false)), None);
    assert!(known.keys.is_empty() && known.in_order.is_empty());
  }

  #[test]
  fn the_keys_received_last_are_known() {
    let mut known = KnownKeys::new();
    for number in 0..2 * MAX_KNOWN_KEYS {
      known.remember(|| "constant".to_owned());
      known.remember(|| format!("{number}"));
    }
    assert_eq!(known.keys.len(), MAX_KNOWN_KEYS);
    assert_eq!(known.in_order.len(), MAX_KNOWN_KEYS);
    let last = 2 * MAX_KNOWN_KEYS - 1;
    for (key, is_known) in [
      ("constant".to_owned(), true),
      (last.to_string(), true),
      ("0".to_owned(), false),
    ] {
      let hash = key.hash_key(false);
      assert_eq!(known.forget_by_hash(hash).is_some(), is_known, "{key}");
    }
  }

  #[test]
  fn a_key_that_is_its_hash_is_not_remembered() {
    let mut known = KnownKeys::new();
    let guid = GUID::from_bytes([7; 16]);
    known.remember(|| guid);
    assert!(known.keys.is_empty());
    assert_eq!(known.forget_by_hash(guid.hash_key(false)), Some(guid));
  }
}
