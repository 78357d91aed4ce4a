//! A declaration that was looked at, ready to read lines.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::super::device::DeviceKind;
use super::super::line_fault::LineFault;
use super::super::sample::Sample;
use super::declaration::Declaration;
use super::error::AdapterError;
use super::reading::{Cyclic, Texts};
use super::sample::{CarmPlan, Plan, RobotPlan, Stamp};
use super::split::{Columns, Names, Split, Splitter};

/// Kind of what a C-arm leaves open that tells of no exposure, in [`LineAdapter::unknowns`].
pub const NO_EXPOSURES: &str = "no exposures";

/// Standard deviation of arrivals where the declaration says none: 100 characters at 115200 baud take 9 ms, and a USB adapter hands over
/// every 16 ms.
pub const HOST_TIME_SIGMA_MS: f64 = 20.0;
/// Times of arrival worse than this place no sample.
const WORST_SIGMA_MS: f64 = 10_000.0;

/// How the lines of a device are read.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(try_from = "Declaration", into = "Declaration")]
pub struct LineAdapter(Arc<Parts>);

#[derive(Debug)]
struct Parts {
    declaration: Declaration,
    splitter: Splitter,
    time: Option<Cyclic>,
    sequence: Option<Cyclic>,
    plan: Plan,
    device: DeviceKind,
    /// What no line says, in words.
    constants: Vec<String>,
}

impl PartialEq for LineAdapter {
    /// All else follows from the declaration.
    fn eq(&self, other: &Self) -> bool {
        self.0.declaration == other.0.declaration
    }
}

impl From<LineAdapter> for Declaration {
    fn from(adapter: LineAdapter) -> Self {
        adapter.0.declaration.clone()
    }
}

impl TryFrom<Declaration> for LineAdapter {
    type Error = AdapterError;

    /// # Errors
    /// Where the declaration contradicts itself, a unit is that of another quantity, or a pattern is none.
    fn try_from(declaration: Declaration) -> Result<Self, AdapterError> {
        if declaration.origin.trim().is_empty() {
            return Err(AdapterError::new("origin", "is empty, expected who says that the lines are so, and when"));
        }
        let mut names = Names::default();
        let time = declaration.device_time.as_ref().map(|source| Cyclic::time(source, &mut names)).transpose()?;
        check_host_time(&declaration)?;
        let sequence = declaration.sequence.as_ref().map(|source| Cyclic::sequence(source, &mut names)).transpose()?;
        let (device, plan) = match (&declaration.robot, &declaration.carm) {
            (Some(fields), None) => (DeviceKind::Robot, Plan::Robot(Box::new(RobotPlan::new(fields, &mut names)?))),
            (None, Some(fields)) => (DeviceKind::Carm, Plan::Carm(Box::new(CarmPlan::new(fields, &mut names)?))),
            _ => {
                return Err(AdapterError::new("the top level", "expected one of the keys robot and carm: whose lines these are"));
            }
        };
        let constants = std::mem::take(&mut names.constants);
        let splitter = Splitter::new(&declaration.format, &declaration.ignore, names)?;
        Ok(Self(Arc::new(Parts { declaration, splitter, time, sequence, plan, device, constants })))
    }
}

fn check_host_time(declaration: &Declaration) -> Result<(), AdapterError> {
    let Declaration { device_time, host_time_sigma_ms, host_time_delay_ms, .. } = declaration;
    let told = [("host_time_sigma_ms", *host_time_sigma_ms, 0.1), ("host_time_delay_ms", *host_time_delay_ms, 0.0)];
    for (key, value_ms, least_ms) in told {
        let Some(value_ms) = value_ms else { continue };
        if device_time.is_some() {
            let detail = "stands for a device clock, which device_time declares: leave one of the two out";
            return Err(AdapterError::new(key, detail));
        }
        if !(value_ms >= least_ms && value_ms <= WORST_SIGMA_MS) {
            return Err(AdapterError::new(key, format!("is {value_ms}, expected {least_ms} to {WORST_SIGMA_MS} ms")));
        }
    }
    Ok(())
}

/// What stands in a line.
#[derive(Debug)]
pub(super) struct Line<'a> {
    parts: &'a Parts,
    texts: Vec<Option<String>>,
}

/// What a line is.
#[derive(Debug)]
pub(super) enum Read<'a> {
    Values(Line<'a>),
    Header(Columns),
    Nothing,
}

impl Line<'_> {
    fn texts(&self) -> Texts<'_> {
        Texts { texts: &self.texts, splitter: &self.parts.splitter }
    }

    /// Device time as it stands there, µs.
    pub(super) fn time_us(&self) -> Option<Result<i64, LineFault>> {
        self.parts.time.as_ref().map(|time| time.read(&self.texts()))
    }

    /// Its number as it stands there.
    pub(super) fn sequence(&self) -> Option<Result<i64, LineFault>> {
        self.parts.sequence.as_ref().map(|sequence| sequence.read(&self.texts()))
    }

    /// All that is read of it, as text; none where it is no sample.
    pub(super) fn told(&self) -> Option<String> {
        let stamps = (self.time_us().transpose().ok()?, self.sequence().transpose().ok()?);
        let sample = self.sample(Stamp { sequence: 0, device_us: 0 }).ok()?;
        Some(format!("{stamps:?} {sample:?}"))
    }

    /// The sample at a stamp.
    pub(super) fn sample(&self, stamp: Stamp) -> Result<Sample, LineFault> {
        self.parts.plan.read(stamp, &self.texts())
    }
}

impl LineAdapter {
    /// Whose lines these are.
    #[must_use]
    pub fn device(&self) -> DeviceKind {
        self.0.device
    }

    /// As typed.
    #[must_use]
    pub fn declaration(&self) -> &Declaration {
        &self.0.declaration
    }

    /// Whether a line (without its end) names all columns that are read.
    pub(in crate::telemetry) fn is_header(&self, line: &[u8]) -> bool {
        let text = std::str::from_utf8(line).unwrap_or_default();
        self.0.splitter.has_header && matches!(self.read(text, None), Ok(Read::Header(_)))
    }

    /// Where the host's time of arrival stands for a clock of the device: its standard deviation, µs.
    #[must_use]
    pub fn host_time_sigma_us(&self) -> Option<f64> {
        let sigma_ms = self.0.declaration.host_time_sigma_ms.unwrap_or(HOST_TIME_SIGMA_MS);
        self.0.time.is_none().then_some(sigma_ms * 1e3)
    }

    /// How long after its measurement a line arrives, µs.
    pub(super) fn host_time_delay_us(&self) -> i64 {
        (self.0.declaration.host_time_delay_ms.unwrap_or(0.0) * 1e3).round() as i64
    }

    /// Where the device's clock begins anew, µs, and where its count does.
    pub(super) fn periods(&self) -> [Option<i64>; 2] {
        [&self.0.time, &self.0.sequence].map(|cyclic| cyclic.as_ref().and_then(|cyclic| cyclic.period))
    }

    /// What cannot be known of this device because its lines do not say it: of what, and a sentence.
    #[must_use]
    pub fn unknowns(&self) -> Vec<(&'static str, String)> {
        let Parts { device, declaration, constants, .. } = &*self.0;
        let mut words = Vec::new();
        if let Some(sigma_us) = self.host_time_sigma_us() {
            let sigma_ms = sigma_us * 1e-3;
            words.push((
                "no device time",
                format!("the {device}'s lines carry no device time: the host's time of arrival stands for it, ±{sigma_ms} ms"),
            ));
        }
        if self.0.sequence.is_none() {
            words.push((
                "no line number",
                format!("the {device}'s lines carry no number: what of them is lost on the way cannot be known"),
            ));
        }
        if !constants.is_empty() {
            words.push((
                "constants",
                format!("the {device}'s lines do not say {}: taken as its adapter declares", constants.join(", ")),
            ));
        }
        if declaration.carm.as_ref().is_some_and(|carm| carm.xray_on.is_none() && carm.exposure_counter.is_none()) {
            let said = "the C-arm's lines say neither when X-ray is on nor how many exposures there were: no exposure is known, and no frame is tied to one";
            words.push((NO_EXPOSURES, said.to_owned()));
        }
        words
    }

    /// Whether the declaration says of a line, without its end, that it means nothing.
    pub(super) fn is_ignored(&self, line: &str) -> bool {
        self.0.splitter.is_ignored(line)
    }

    /// A line without its end; `header` are the columns that an earlier one has named.
    pub(super) fn read(&self, line: &str, header: Option<&Columns>) -> Result<Read<'_>, LineFault> {
        Ok(match self.0.splitter.split(line, header)? {
            Split::Texts(texts) => Read::Values(Line { parts: &self.0, texts }),
            Split::Header(columns) => Read::Header(columns),
            Split::Nothing => Read::Nothing,
        })
    }
}
