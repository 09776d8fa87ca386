//! Checks the rules of this source tree that neither compiler, clippy nor cargo-deny knows: layers, circles,
//! purity, words, sizes, links, dependencies.
//! Pure: reads files, and lists the dependencies by cargo.
//!
//! Each rule is a function of a file's path and text that lists what breaks it, so that the tests can also
//! show that it finds what it is for.

mod circles;
mod dependencies;
mod docs;
mod layers;
mod path;
mod source;
mod text;
