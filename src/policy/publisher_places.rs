//! Which publisher's account gives way when another one comes.

use crate::model::{MonotonicNs, PublisherAccount};

/// A publisher that is matched and has been silent for so long may give way to another one.
pub const PUBLISHER_SILENT_MS: u64 = 60_000;

/// The place for the account of a new publisher: a vacant one; else that of the publisher silent longest of
/// those that are gone; else that of the one silent longest, if for [`PUBLISHER_SILENT_MS`].
///
/// `None` when all places belong to publishers that are there and write: a flood of announced publishers
/// pushes none of these out.
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
    fn vacant_places_then_gone_publishers_then_silent_ones_give_way() {
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
