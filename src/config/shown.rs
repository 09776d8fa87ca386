//! Formats settings for operators, as they are written in the file.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use super::choices::Choice;
use super::settings::{MetricsListener, NetworkSelector, SecretSource};
use crate::model::{History, InstanceName, LaneName, NodeName, TopicName, TypeName};

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
shown_as_displayed!(Ipv4Addr, InstanceName, LaneName, NodeName, TopicName, TypeName, NetworkSelector);

impl<T: Choice> Shown for T {
    fn shown(&self) -> String {
        let word = T::WORDS.iter().find(|(_, value)| value == self);
        word.map_or_else(String::new, |(word, _)| (*word).to_owned())
    }
}

impl Shown for History {
    fn shown(&self) -> String {
        match self {
            Self::KeepLast { depth } => format!("KEEP_LAST {depth}"),
            Self::KeepAll => "KEEP_ALL".to_owned(),
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
