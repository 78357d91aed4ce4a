//! Devices that send lines of text: a declaration (`telemetry/*.json`) says what stands in them.

mod adapter;
mod blank;
mod cycle;
mod declaration;
mod decoder;
mod error;
mod nameless;
mod quantity;
mod reading;
mod sample;
mod split;

pub use adapter::{HOST_TIME_SIGMA_MS, LineAdapter, NO_EXPOSURES};
pub use blank::LineBlanker;
pub use declaration::{
    BaseFields, CarmFields, CounterSource, CsvFormat, Declaration, Direction, FlagSource, Format, JsonFormat, RegexFormat,
    RobotFields, SequenceSource, Source, TendonFields, TimeSource,
};
pub use decoder::{LineDecoder, MAX_LINE_BYTES};
pub use error::AdapterError;
pub(super) use quantity::is_unit;
