//! Formats settings for operators, as they are written in the file.

use std::path::PathBuf;

use super::choices::{
    DROP_POLICIES, DURABILITIES, RELIABILITIES, SCHEDULING_POLICIES, TRUST_MODES, VERBOSITIES,
};
use super::settings::{
    MetricsListener, NetworkSelector, SchedulingPolicy, SecretSource, TrustMode, Verbosity,
};
use crate::model::{
    DropPolicy, Durability, History, InstanceName, LaneName, Reliability, SubscriberState, TopicName,
    TypeName,
};

/// A value that can be shown as in the file. Secrets do not implement it.
pub(super) trait Shown {
    /// The value as it is written in the file.
    fn shown(&self) -> String;
}

macro_rules! shown_as_displayed {
    ($($type:ty),+) => {
        $(impl Shown for $type {
            fn shown(&self) -> String {
                self.to_string()
            }
        })+
    };
}

shown_as_displayed!(bool, u8, u16, u32, u64, usize, f64, String);
shown_as_displayed!(InstanceName, LaneName, SubscriberState, TopicName, TypeName);

macro_rules! shown_as_a_choice {
    ($($type:ty: $choices:ident),+) => {
        $(impl Shown for $type {
            fn shown(&self) -> String {
                let found = $choices.iter().find(|(_, value)| value == self);
                found.map_or_else(|| format!("{self:?}"), |(word, _)| (*word).to_owned())
            }
        })+
    };
}

shown_as_a_choice!(
    DropPolicy: DROP_POLICIES,
    Durability: DURABILITIES,
    Reliability: RELIABILITIES,
    SchedulingPolicy: SCHEDULING_POLICIES,
    TrustMode: TRUST_MODES,
    Verbosity: VERBOSITIES
);

impl Shown for History {
    fn shown(&self) -> String {
        match self {
            Self::KeepLast { depth } => format!("KEEP_LAST {depth}"),
            Self::KeepAll => "KEEP_ALL".to_owned(),
        }
    }
}

impl Shown for NetworkSelector {
    fn shown(&self) -> String {
        match self {
            Self::Name(name) => name.clone(),
            Self::Address(address) => address.to_string(),
        }
    }
}

impl Shown for SecretSource {
    fn shown(&self) -> String {
        match self {
            Self::File(path) => format!("the file {}", path.display()),
            Self::Environment(variable) => format!("the variable {variable}"),
            Self::ConfigFile => "in this file".to_owned(),
        }
    }
}

impl Shown for MetricsListener {
    fn shown(&self) -> String {
        match self {
            Self::Tcp(address, port) => std::net::SocketAddr::new(*address, *port).to_string(),
            Self::Unix(path) => format!("unix:{}", path.display()),
        }
    }
}

impl Shown for PathBuf {
    fn shown(&self) -> String {
        self.display().to_string()
    }
}

impl<T: Shown> Shown for Option<T> {
    fn shown(&self) -> String {
        self.as_ref().map_or_else(|| "none".to_owned(), Shown::shown)
    }
}

impl<T: Shown> Shown for Vec<T> {
    fn shown(&self) -> String {
        let items: Vec<String> = self.iter().map(Shown::shown).collect();
        format!("[{}]", items.join(", "))
    }
}
