//! What is declared of a configuration key.

/// The declaration of a key, or of several that differ in their place only. The list of known keys, the
/// reading and checking of the value, its default, the messages, what a reload applies and the tables of
/// `config/README.md` come from it.
#[derive(Debug)]
pub struct Row {
    /// The paths. `[]` is an item of a list; a name in angle brackets is a name that the user chooses.
    pub paths: &'static [&'static str],
    /// Type and range.
    pub kind: Kind,
    /// The default as in the documentation: a value, or where it is taken from.
    pub default: &'static str,
    /// Whether a reload applies a change; if not, it waits for a restart.
    pub reloads: bool,
    /// One line of documentation.
    pub documentation: &'static str,
}

/// The type and the range of a value.
#[derive(Clone, Copy, Debug)]
pub enum Kind {
    /// A boolean.
    Flag,
    /// A whole number, with the least, the greatest, and what the documentation adds, such as the unit.
    Whole(u64, u64, &'static str),
    /// A number, likewise.
    Decimal(f64, f64, &'static str),
    /// One of these words.
    Choice(fn() -> Vec<&'static str>),
    /// Another type, which its reader checks; the allowed values as in the documentation.
    Other(&'static str),
}

pub(super) const TOPIC: Kind = Kind::Other("absolute topic name");
pub(super) const AGE: Kind = Kind::Whole(0, 86_400_000, " ms");

/// A key that a reload applies.
pub(super) const fn reloads(paths: &'static [&'static str], kind: Kind, default: &'static str) -> Row {
    Row { paths, kind, default, reloads: true, documentation: "" }
}

/// A key whose change waits for a restart of the whole bridge.
pub(super) const fn restarts(paths: &'static [&'static str], kind: Kind, default: &'static str) -> Row {
    Row { paths, kind, default, reloads: false, documentation: "" }
}

impl Row {
    pub(super) const fn doc(self, documentation: &'static str) -> Self {
        Self { documentation, ..self }
    }

    /// The range and the unit, for the documentation.
    pub fn range(&self) -> String {
        match self.kind {
            Kind::Flag => "`true`, `false`".to_owned(),
            Kind::Whole(least, most, unit) => format!("{least} to {most}{unit}"),
            Kind::Decimal(least, most, unit) => format!("{least} to {most}{unit}"),
            Kind::Choice(names) => format!("`{}`", names().join("`, `")),
            Kind::Other(allowed) => allowed.to_owned(),
        }
    }

    /// The row of this key in the tables of `config/README.md`.
    pub fn documented(&self) -> String {
        let Self { paths, default, documentation, reloads, .. } = self;
        let keys = paths.join("` `");
        let sign = if *reloads { " ↻" } else { "" };
        format!("| `{keys}`{sign} | {documentation} | {} | {default} |", self.range())
    }
}
