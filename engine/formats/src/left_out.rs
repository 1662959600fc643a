//! The things that a command could do and does not.

/// A pass or an effect that a request and its inputs do not call for.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct LeftOut {
    /// The name of the thing.
    pub what: String,
    /// Why it is not needed.
    pub why: String,
}

impl LeftOut {
    /// One of them.
    pub fn new(what: impl Into<String>, why: impl Into<String>) -> Self {
        Self { what: what.into(), why: why.into() }
    }
}
