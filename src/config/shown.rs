//! The values of settings as they are written in the file: for operators as text, for ROS 2 with their type.

use std::fmt;
use std::net::Ipv4Addr;
use std::path::PathBuf;

use super::choices::Choice;
use super::settings::{InputTopic, MetricsListener, NetworkSelector, OutputTopic, SecretSource};
use crate::model::{History, InstanceName, LaneName, NodeName, TopicName, TopicPattern, TypeName};

/// A value as in the file. It is displayed as text for operators.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// No value.
    None,
    /// A boolean.
    Flag(bool),
    /// A whole number.
    Whole(u64),
    /// A number.
    Decimal(f64),
    /// A text.
    Text(String),
    /// A list.
    List(Vec<Value>),
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::None => f.write_str("none"),
            Self::Flag(flag) => flag.fmt(f),
            Self::Whole(number) => number.fmt(f),
            Self::Decimal(number) => number.fmt(f),
            Self::Text(text) => f.write_str(text),
            Self::List(items) => {
                let items: Vec<String> = items.iter().map(Self::to_string).collect();
                write!(f, "[{}]", items.join(", "))
            }
        }
    }
}

/// A value that can be shown as in the file. Secrets do not implement it.
pub(super) trait Shown {
    fn value(&self) -> Value;
}

macro_rules! shown_as {
    ($($type:ty: $kind:ident),+) => {
        $(impl Shown for $type {
            fn value(&self) -> Value {
                Value::$kind((*self).into())
            }
        })+
    };
}

macro_rules! shown_as_displayed {
    ($($type:ty),+) => {
        $(impl Shown for $type {
            fn value(&self) -> Value {
                Value::Text(self.to_string())
            }
        })+
    };
}

shown_as!(bool: Flag, u8: Whole, u16: Whole, u32: Whole, u64: Whole, f64: Decimal);
shown_as_displayed!(String, Ipv4Addr, InstanceName, LaneName, NodeName, TopicName, TypeName, NetworkSelector);
shown_as_displayed!(InputTopic, OutputTopic, TopicPattern);

impl Shown for usize {
    fn value(&self) -> Value {
        Value::Whole(*self as u64)
    }
}

impl<T: Choice> Shown for T {
    fn value(&self) -> Value {
        let word = T::WORDS.iter().find(|(_, value)| value == self);
        Value::Text(word.map_or_else(String::new, |(word, _)| (*word).to_owned()))
    }
}

impl Shown for History {
    fn value(&self) -> Value {
        Value::Text(match self {
            Self::KeepLast { depth } => format!("KEEP_LAST {depth}"),
            Self::KeepAll => "KEEP_ALL".to_owned(),
        })
    }
}

impl Shown for SecretSource {
    fn value(&self) -> Value {
        Value::Text(match self {
            Self::File(path) => format!("the file {}", path.display()),
            Self::Environment(variable) => format!("the variable {variable}"),
            Self::ConfigFile => "in this file".to_owned(),
        })
    }
}

impl Shown for MetricsListener {
    fn value(&self) -> Value {
        Value::Text(match self {
            Self::Tcp(address, port) => std::net::SocketAddr::new(*address, *port).to_string(),
            Self::Unix(path) => format!("unix:{}", path.display()),
        })
    }
}

impl Shown for PathBuf {
    fn value(&self) -> Value {
        Value::Text(self.display().to_string())
    }
}

impl<T: Shown> Shown for Option<T> {
    fn value(&self) -> Value {
        self.as_ref().map_or(Value::None, Shown::value)
    }
}

impl<T: Shown> Shown for Vec<T> {
    fn value(&self) -> Value {
        Value::List(self.iter().map(Shown::value).collect())
    }
}
