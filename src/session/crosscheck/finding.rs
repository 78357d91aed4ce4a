//! What one check found, and what a person can do about it.

use serde::{Deserialize, Serialize};

use crate::reporter::Reporter;

/// How bad it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// As it should be, or nothing can be said.
    Pass,
    /// Results may be wrong; the session goes on.
    Warn,
    /// Results would be wrong.
    Fail,
}

/// The verdict of one check.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Finding {
    /// What was checked, in two or three words; the same words on any day.
    pub check: String,
    /// The verdict.
    pub level: Level,
    /// What was found: both sides of a disagreement.
    pub detail: String,
    /// What to do; present unless the check passed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub remedy: Option<String>,
}

impl Finding {
    /// Passed.
    #[must_use]
    pub fn pass(check: &str, detail: impl Into<String>) -> Self {
        Self { check: check.to_owned(), level: Level::Pass, detail: detail.into(), remedy: None }
    }

    /// Doubtful.
    #[must_use]
    pub fn warn(check: &str, detail: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { check: check.to_owned(), level: Level::Warn, detail: detail.into(), remedy: Some(remedy.into()) }
    }

    /// Wrong.
    #[must_use]
    pub fn fail(check: &str, detail: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { level: Level::Fail, ..Self::warn(check, detail, remedy) }
    }

    /// What was found and what to do, in one sentence.
    #[must_use]
    pub fn sentence(&self) -> String {
        match &self.remedy {
            Some(remedy) => format!("{}; {remedy}", self.detail),
            None => self.detail.clone(),
        }
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.check, self.sentence())
    }
}

/// The reason with which every registration is refused, where a check of the session's files failed.
#[must_use]
pub fn refusal(findings: &[Finding]) -> Option<String> {
    findings.iter().find(|finding| finding.level == Level::Fail).map(|finding| format!("crosscheck: {finding}"))
}

/// Everything that did not pass becomes a counted warning of its own kind.
pub fn tell(findings: &[Finding], reporter: &Reporter) {
    for finding in findings.iter().filter(|finding| finding.level > Level::Pass) {
        reporter.warn(&format!("check: {}", finding.check), finding);
    }
}
