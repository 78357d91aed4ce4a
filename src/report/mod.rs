//! What people look at afterwards: the strip of each pair, the session's report in one HTML file, and `pairs.json` for scripts.

mod alone;
mod bead_row;
mod canvas;
pub mod colour;
mod drawn;
pub mod figures;
mod files;
mod html;
mod html_exposures;
mod html_parts;
mod html_time;
mod k_source;
mod marks;
mod overlay;
mod pair;
mod panels;
mod session;
mod shut_off;
mod signed_difference;
mod strip;
mod unmatched;

pub use alone::Alone;
pub use bead_row::BeadRow;
pub use canvas::{Align, Canvas, Rgb};
pub use colour::{diverging, gray, short, window};
pub use files::{ReportError, png_bytes, write_pairs, write_session};
pub use html::report_page;
pub use k_source::KSource;
pub use marks::{BeadMark, LandmarkMark, PairMarks, RobotMark, ShadowMark};
pub use overlay::overlay;
pub use pair::{Heading, Innovation, Pair, PairStatus, PoseSource, Standing, TruthError, score_words};
pub use session::{Counts, Gap, LinkReport, PairsFile, Provenance, SessionReport, Track, counted, counted_of};
pub use shut_off::{calm, dimmed};
pub use signed_difference::{NOT_COMPARABLE, SignedDifference};
pub use strip::{StripInput, restated, strip};
