//! OpenIGTLink: what a session knows, as messages for 3D Slicer, PLUS and others (`github.com/openigtlink/OpenIGTLink`, `Documents/Protocol`).
//!
//! ```text
//! Message ─ encode ─┬─ outbox ─ writer ─ client
//!                   └─ outbox ─ writer ─ client ─ reader ─ Decoder ─ queries
//! ```
//! [`header`], [`message`], [`picture`], [`decode`] and [`outbox`] do no input or output; [`server`] has the sockets. Whoever sends hands a
//! message over and goes on: a client that stands still loses messages, and holds nobody up.

pub mod header;
pub mod message;
pub mod picture;
pub mod decode;
pub mod outbox;
mod client;
pub mod server;

pub use decode::{Decoder, IgtlFault, Received};
pub use header::HeaderVersion;
pub use message::{Content, Message, Status};
pub use picture::{Picture, Placement};
pub use server::{IgtlError, MOST_CLIENTS, Server};
