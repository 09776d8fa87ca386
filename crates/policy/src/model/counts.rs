//! Counts of events by reason, and the macro that declares the reasons of one kind of event.

use core::fmt;
use core::marker::PhantomData;

use serde::ser::{Serialize, SerializeMap, Serializer};

/// A closed list of reasons, whose text form is the label in logs, `status` and metrics.
pub trait Reason: Copy + fmt::Display + 'static {
    /// Every reason, in the order of its index.
    const ALL: &'static [Self];

    /// The index in [`Reason::ALL`].
    fn index(self) -> usize;
}

/// Declares an enum of reasons: each variant with its label and its text for users, which begins its comment.
macro_rules! reasons {
    ($(#[$attribute:meta])* $name:ident:
     $($(#[doc = $doc:literal])* $variant:ident = $label:literal, $meaning:literal,)+) => {
        $(#[$attribute])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        #[repr(u8)]
        pub enum $name {
            $(#[doc = $meaning] #[doc = ""] $(#[doc = $doc])* $variant,)+
        }

        impl $name {
            /// Every reason, in the order of its index.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)+];

            /// The number of reasons.
            pub const COUNT: usize = Self::ALL.len();

            /// The label in logs, `status` and metrics.
            pub const fn label(self) -> &'static str {
                match self {
                    $(Self::$variant => $label,)+
                }
            }

            /// A text for users: the cause and, where there is one, the remedy.
            pub const fn meaning(self) -> &'static str {
                match self {
                    $(Self::$variant => $meaning,)+
                }
            }
        }

        impl $crate::model::Reason for $name {
            const ALL: &'static [Self] = Self::ALL;

            fn index(self) -> usize {
                self as usize
            }
        }

        impl core::fmt::Display for $name {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                f.write_str(self.label())
            }
        }
    };
}
pub(super) use reasons;

/// Counts of events by reason. Sums saturate: the counts may come from shared memory, where any process of
/// the same user could have written any number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct Counts<R, const N: usize>([u64; N], PhantomData<R>);

impl<R, const N: usize> Default for Counts<R, N> {
    fn default() -> Self {
        Self([0; N], PhantomData)
    }
}

impl<R: Reason, const N: usize> Counts<R, N> {
    /// Counts `n` more events for `reason`.
    pub fn add(&mut self, reason: R, n: u64) {
        let count = &mut self.0[reason.index()];
        *count = count.saturating_add(n);
    }

    /// Adds the counts of `other`.
    pub fn merge(&mut self, other: &Self) {
        for (count, more) in self.0.iter_mut().zip(other.0) {
            *count = count.saturating_add(more);
        }
    }

    /// Events for `reason`.
    pub fn get(&self, reason: R) -> u64 {
        self.0[reason.index()]
    }

    /// Events for all reasons together.
    pub fn total(&self) -> u64 {
        self.0.iter().fold(0, |total, count| total.saturating_add(*count))
    }

    /// The events since `earlier`, an earlier reading of the same counts.
    pub fn since(&self, earlier: &Self) -> Self {
        let mut difference = *self;
        for (count, before) in difference.0.iter_mut().zip(earlier.0) {
            *count = count.saturating_sub(before);
        }
        difference
    }

    /// The events since an earlier reading; none without one.
    pub fn since_reading(&self, earlier: Option<Self>) -> Self {
        earlier.map_or_else(Self::default, |earlier| self.since(&earlier))
    }

    /// The reasons that occurred, with their counts.
    pub fn iter(&self) -> impl Iterator<Item = (R, u64)> + '_ {
        R::ALL.iter().map(|&reason| (reason, self.get(reason))).filter(|&(_, n)| n > 0)
    }
}

/// A map with every reason as a key, so that a reader can tell a count of 0 from a misspelt reason.
impl<R: Reason, const N: usize> Serialize for Counts<R, N> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(N))?;
        for reason in R::ALL {
            map.serialize_entry(&format_args!("{reason}"), &self.get(*reason))?;
        }
        map.end()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{DropCounts, DropReason, ProbeRefusal};

    #[test]
    fn every_reason_has_its_own_index_and_label() {
        fn check<R: Reason>() {
            for (index, reason) in R::ALL.iter().enumerate() {
                assert_eq!(reason.index(), index);
                let same = R::ALL.iter().filter(|other| other.to_string() == reason.to_string());
                assert_eq!(same.count(), 1, "{reason}");
            }
        }
        check::<DropReason>();
        check::<ProbeRefusal>();
    }

    #[test]
    fn counts_are_summed_by_reason_and_never_overflow() {
        let mut counts = DropCounts::default();
        counts.add(DropReason::Stale, 2);
        counts.add(DropReason::TooLarge, 1);
        counts.add(DropReason::Stale, 3);
        assert_eq!((counts.get(DropReason::Stale), counts.total()), (5, 6));
        let listed: Vec<_> = counts.iter().collect();
        assert_eq!(listed, [(DropReason::TooLarge, 1), (DropReason::Stale, 5)]);
        let mut full = DropCounts::default();
        DropReason::ALL.iter().for_each(|&reason| full.add(reason, u64::MAX));
        full.add(DropReason::Stale, 1);
        full.merge(&counts);
        assert_eq!(full.total(), u64::MAX);
    }

    #[test]
    fn a_difference_of_counts_is_never_negative() {
        let (mut now, mut earlier) = (DropCounts::default(), DropCounts::default());
        now.add(DropReason::Stale, 5);
        earlier.add(DropReason::Stale, 2);
        earlier.add(DropReason::QueueFull, 9);
        let since: Vec<_> = now.since(&earlier).iter().collect();
        assert_eq!(since, [(DropReason::Stale, 3)]);
    }

    #[test]
    fn merged_counts_are_added_reason_by_reason() {
        let (mut counts, mut more) = (DropCounts::default(), DropCounts::default());
        counts.add(DropReason::Stale, 2);
        more.add(DropReason::Stale, 3);
        more.add(DropReason::NoReader, 4);
        counts.merge(&more);
        let merged: Vec<_> = counts.iter().collect();
        assert_eq!(merged, [(DropReason::NoReader, 4), (DropReason::Stale, 5)]);
    }

    #[test]
    fn without_an_earlier_reading_there_is_no_difference() {
        let mut now = DropCounts::default();
        now.add(DropReason::Stale, 5);
        assert_eq!(now.since_reading(None), DropCounts::default());
        assert_eq!(now.since_reading(Some(DropCounts::default())), now);
    }
}
