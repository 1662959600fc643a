/// A pass or effect that a request does not need.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct SkippedPass {
    /// Name.
    pub what: String,
    /// Reason.
    pub why: String,
}

impl SkippedPass {
    /// Creates an entry.
    pub fn new(what: impl Into<String>, why: impl Into<String>) -> Self {
        Self { what: what.into(), why: why.into() }
    }
}
