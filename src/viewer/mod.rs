//! The window: acquired frame and matched DRR large, difference and overlay beside them; what is known of the exposure, the devices and the
//! agreement on the left; the exposures in a row below. Panes draw what a [`crate::session::board::BoardState`] holds; they decide nothing.
//! What a person edits goes the other way as plain requests ([`crate::session::edit::EditRequest`]), through a channel.

mod theme;
mod told;
mod sight;
mod player;
mod picture_cache;
mod editing;
mod note;
mod state;
mod keys;
mod marks;
mod readout;
mod arrange;
mod pictures;
mod standing;
mod devices;
mod pose_pane;
mod scores;
mod time_axis;
mod timeline;
mod toolbar;
mod layout;
mod window;

pub use editing::{Chosen, EditCommand, Editing};
pub use layout::draw;
pub use player::{Player, Speed};
pub use sight::Sight;
pub use state::{Arrangement, Mark, Overlay, ViewState};
pub use window::{ViewerError, run};
