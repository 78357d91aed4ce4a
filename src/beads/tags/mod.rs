//! AprilTags: square marks that tell who they are, radio-opaque or optical.
//!
//! A tag gives identity and a start for the pose; beads give the precision. What is listed in `TAGS.json` is a [`TagLayout`], what a
//! frame shows is a [`SeenTag`]; `pose` puts the two together.
//!
//! **Tag frame.** Origin at the tag's centre, +x to the right and +y down as the tag is read, +z into the tag, away from the reader, as
//! the AprilTag library has it. Its side `size_mm` is that of the square whose corners are found: the outer edge of the border that all
//! data bits lie in, or, in the families with bits outside their border (`tagStandard…`, `tagCircle…`, `tagCustom…`), that border's edge.
//! Corners are named in the order of [`CORNERS`].
//!
//! **Pixels.** The library counts from the first pixel's corner, this program from its centre: half a pixel is taken off, once, in
//! `decoder`.

mod decoder;
mod family;
mod file;
mod find;
mod grey;
mod seen;

pub use family::Family;
pub use file::{Tag, TagLayout, TagsFileError, parse_tags, read_tags};
pub use find::find_tags;
pub use seen::{CORNERS, SeenTag, TagsError};
