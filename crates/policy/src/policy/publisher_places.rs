//! Chooses the account that a new publisher of a route replaces.

use crate::model::{MonotonicNs, PublisherAccount};

/// The silence after which the account of a matched publisher may be replaced.
pub const PUBLISHER_SILENT_MS: u64 = 60_000;

/// The index of the account that a new publisher replaces, of `accounts` with whether the publisher is gone.
///
/// A vacant account comes first, then that of the gone publisher that has been silent longest, then that of
/// the publisher that has been silent longest if its silence is at least [`PUBLISHER_SILENT_MS`]. `None` when
/// all accounts belong to publishers that still write: announcing many publishers replaces none of these.
pub fn publisher_place<'a>(
    accounts: impl IntoIterator<Item = (&'a PublisherAccount, bool)>,
    now: MonotonicNs,
) -> Option<usize> {
    let rank = |account: &PublisherAccount, is_gone: bool| {
        if account.is_vacant() {
            Some(0)
        } else if is_gone {
            Some(1)
        } else {
            (now.since(account.last_at) >= PUBLISHER_SILENT_MS * 1_000_000).then_some(2)
        }
    };
    let candidates = accounts.into_iter().enumerate();
    candidates
        .filter_map(|(place, (account, is_gone))| Some((rank(account, is_gone)?, account.last_at, place)))
        .min()
        .map(|(.., place)| place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Guid;

    fn account(writer: u8, last_ms: u64) -> PublisherAccount {
        let last_at = MonotonicNs(0).plus_ms(last_ms);
        PublisherAccount { last_at, ..PublisherAccount::new(Guid([writer; 16]), 1) }
    }

    #[test]
    fn vacant_accounts_are_replaced_first_then_gone_publishers_then_silent_ones() {
        let now = MonotonicNs(0).plus_ms(100_000);
        let (old, older, live) = (account(1, 30_000), account(2, 20_000), account(3, 99_000));
        let vacant = PublisherAccount::default();
        let place = |accounts: &[(&PublisherAccount, bool)]| publisher_place(accounts.iter().copied(), now);
        assert_eq!(place(&[(&old, true), (&vacant, false), (&vacant, false)]), Some(1));
        assert_eq!(place(&[(&older, false), (&live, true), (&old, true)]), Some(2));
        assert_eq!(place(&[(&old, false), (&older, false), (&live, false)]), Some(1));
        assert_eq!(place(&[(&live, false), (&live, false)]), None);
    }
}
