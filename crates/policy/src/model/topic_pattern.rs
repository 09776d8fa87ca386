//! Patterns of topic names, and the places of the topics that match one.

use alloc::borrow::ToOwned;
use alloc::format;
use alloc::string::String;
use core::fmt;

use serde::{Deserialize, Deserializer, Serialize};

use super::health::FixedText;
use super::names::{NameError, TopicName};

/// A pattern of fully qualified topic names, such as `/camera/**`. The token `*` stands for exactly one token
/// of a name, `**` for any number of them, also none; every other token stands for itself.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
pub struct TopicPattern(String);

impl TopicPattern {
    /// The allowed texts, as a phrase that completes "must be …".
    pub const ALLOWED: &'static str = "a pattern of ROS 2 topic names of at most 246 characters: /tokens, each a \
                                       name, * for any one token, or ** for any number of tokens, no two ** in a \
                                       row";

    /// The pattern as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// What all topics of the pattern begin with: the tokens before the first wild card.
    pub fn literal_start(&self) -> &str {
        self.0.find("/*").map_or(&self.0, |end| &self.0[..end])
    }

    /// Whether the pattern matches a topic name. It takes at most the product of their lengths in steps.
    pub fn matches(&self, topic: &str) -> bool {
        let (Some(pattern), Some(topic)) = (self.0.strip_prefix('/'), topic.strip_prefix('/')) else {
            return false;
        };
        // A mismatch after a `**` is tried again with one more token for that `**`. An earlier `**` needs no
        // further attempt: what follows it up to the last one has matched, and the last one takes any tokens.
        let (mut pattern, mut topic) = (Some(pattern), Some(topic));
        let mut retry: Option<(Option<&str>, Option<&str>)> = None;
        loop {
            let (token, after) = split(pattern);
            if token == Some("**") {
                pattern = after;
                retry = Some((after, topic));
                continue;
            }
            let (name, rest) = split(topic);
            match (token, name) {
                (None, None) => return true,
                (Some(token), Some(name)) if token == "*" || token == name => {
                    (pattern, topic) = (after, rest)
                }
                _ => {
                    let Some((then, Some(from))) = retry else { return false };
                    let (_, shorter) = split(Some(from));
                    retry = Some((then, shorter));
                    (pattern, topic) = (then, shorter);
                }
            }
        }
    }
}

/// The first token, and what follows it; `None` after the last one.
fn split(text: Option<&str>) -> (Option<&str>, Option<&str>) {
    match text {
        None => (None, None),
        Some(text) => match text.split_once('/') {
            Some((token, rest)) => (Some(token), Some(rest)),
            None => (Some(text), None),
        },
    }
}

impl TryFrom<&str> for TopicPattern {
    type Error = NameError;

    fn try_from(text: &str) -> Result<Self, NameError> {
        // A wild card takes the place of one token, so a name with a valid token in each of these places is
        // valid exactly if the pattern is.
        let tokens = text.split('/').map(|token| if matches!(token, "*" | "**") { "x" } else { token });
        let mut name = String::new();
        for (index, token) in tokens.enumerate() {
            name += if index == 0 { "" } else { "/" };
            name += token;
        }
        let is_valid = text.len() <= 246
            && TopicName::try_from(name.as_str()).is_ok()
            && !format!("{text}/").contains("/**/**/");
        let error = NameError { kind: "topic pattern", allowed: Self::ALLOWED };
        if is_valid { Ok(Self(text.to_owned())) } else { Err(error) }
    }
}

impl fmt::Display for TopicPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl<'de> Deserialize<'de> for TopicPattern {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        Self::try_from(text.as_str()).map_err(serde::de::Error::custom)
    }
}

/// What the outputs of a pattern's topics begin with: `/bridge/critical` of `/bridge/critical/**`, in which
/// `**` stands for the input topic.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TopicPrefix(TopicName);

impl TopicPrefix {
    /// The allowed texts, as a phrase that completes "must be …".
    pub const ALLOWED: &'static str =
        "a topic name and /**, such as /adaptive_bridge/critical/**, in which ** stands for the input topic";

    /// Parses a name with `/**` at its end.
    pub fn parse(text: &str) -> Option<Self> {
        Some(Self(TopicName::try_from(text.strip_suffix("/**")?).ok()?))
    }

    /// The output of an input topic; `None` if its name would be too long.
    pub fn output_of(&self, input: &TopicName) -> Option<TopicName> {
        TopicName::try_from(format!("{}{input}", self.0).as_str()).ok()
    }

    /// The input topic of an output with this prefix; `None` for another topic.
    pub fn input_of<'a>(&self, output: &'a TopicName) -> Option<&'a str> {
        output.as_str().strip_prefix(self.0.as_str()).filter(|input| input.starts_with('/'))
    }

    /// Whether a topic name contains the tokens of the prefix, one after the other, and another token: it is
    /// an output with this prefix, or one that another bridge forwards below a prefix of its own.
    pub fn is_within(&self, topic: &str) -> bool {
        topic.contains(&format!("{}/", self.0))
    }
}

impl fmt::Display for TopicPrefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/**", self.0)
    }
}

/// The state of a pattern, from ingress.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct PatternRecord {
    /// Topics that match and wait for a place.
    pub waiting: u64,
    /// Places that a topic has had to leave for another one.
    pub released: u64,
    /// Matching topics that are not bridged because the name is too long or an output has it, each time one
    /// is discovered.
    pub refused: u64,
    /// Times that a waiting topic was forgotten because too many waited.
    pub forgotten: u64,
    /// The topic that has waited longest.
    pub first_waiting: FixedText,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(text: &str) -> TopicPattern {
        TopicPattern::try_from(text).unwrap()
    }

    #[test]
    fn one_star_is_one_token_and_two_are_any_number() {
        let cases = [
            ("/camera/*/image", "/camera/front/image", true),
            ("/camera/*/image", "/camera/image", false),
            ("/camera/*/image", "/camera/front/left/image", false),
            ("/camera/**", "/camera/front/image", true),
            ("/camera/**", "/camera", true),
            ("/camera/**", "/camera_2/front", false),
            ("/**/image", "/image", true),
            ("/**/image", "/a/image/b/image", true),
            ("/**/image", "/a/image/b", false),
            ("/a/**/b/*/c", "/a/b/x/b/y/c", true),
            ("/a/**/b/*/c", "/a/b/x/b/c", false),
            ("/a/**/b/**", "/a/x/y/b", true),
            ("/**", "/x", true),
            ("/*", "/x/y", false),
            ("/scan", "/scan", true),
            ("/scan", "scan", false),
        ];
        for (text, topic, expected) in cases {
            assert_eq!(pattern(text).matches(topic), expected, "{text} {topic}");
        }
    }

    #[test]
    fn a_wild_card_is_a_whole_token() {
        let wrong = [
            "",
            "/",
            "camera/**",
            "/camera//**",
            "/***",
            "/cam*",
            "/**x",
            "/a/**/**",
            "/2d/*",
            "/camera/**/",
        ];
        for text in wrong {
            assert!(TopicPattern::try_from(text).is_err(), "{text:?}");
        }
        for text in ["/**", "/*/*", "/a/**/b/**", "/a"] {
            assert_eq!(pattern(text).to_string(), text);
        }
    }

    #[test]
    fn an_output_has_the_prefix_and_the_input_topic() {
        let prefix = TopicPrefix::parse("/bridge/critical/**").unwrap();
        let input = TopicName::try_from("/camera/front").unwrap();
        let output = prefix.output_of(&input).unwrap();
        assert_eq!(output.as_str(), "/bridge/critical/camera/front");
        for within in [output.as_str(), "/other/bridge/critical/x"] {
            assert!(prefix.is_within(within), "{within}");
        }
        for other in ["/bridge/critical_2/x", "/my_bridge/critical/x", "/bridge/x", "/bridge/critical"] {
            assert!(!prefix.is_within(other), "{other}");
        }
        assert_eq!(prefix.to_string(), "/bridge/critical/**");
        let starts = ["/a/b/**", "/a/*/c", "/**", "/a"].map(|text| pattern(text).literal_start().to_owned());
        assert_eq!(starts, ["/a/b", "/a", "", "/a"]);
        for wrong in ["/bridge/critical", "/**", "/bridge/*/**", "/bridge/critical/", "bridge/**"] {
            assert_eq!(TopicPrefix::parse(wrong), None, "{wrong}");
        }
        let long = TopicName::try_from(format!("/{}", "x".repeat(240)).as_str()).unwrap();
        assert_eq!(prefix.output_of(&long), None);
    }
}
