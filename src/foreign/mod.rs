//! Files that others made are opened in a helper process: the same program, hidden command `read-foreign`, with limits on memory, time,
//! descriptors and written files. What goes wrong in there (a crash, a bomb, a stack overflow) is one refused file here.
//!
//! ```text
//! parent: open (regular files only) ─ spawn ─ messages in, checked ─ wall clock, exit status
//! child:  limits ─ decode standard input ─ messages out on standard output
//! ```
//! The open file is the child's standard input, so no path crosses over, and a file that is deleted meanwhile can still be read. Where
//! several files are one thing (the slices of a CT), their contents come one after the other on it.
//!
//! Small texts (scenes, poses, beads) need no helper: [`read_small`] takes regular files of a bounded size only. What opens a file, here and
//! everywhere, is [`crate::regular`].

mod blank;
mod feed;
mod helper;
mod kind;
mod limits;
mod open;
mod parent;
mod process;
mod request;
mod reserve;
mod wire;

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

pub use blank::{Written, ends_in_zeros};
pub use feed::{Fed, Input, next_request};
pub use helper::{ForeignFault, Helpers};
pub use kind::Kind;
pub use limits::{Limits, impose, impose_on_next};
pub use open::{has_hole, standard_input};
pub use parent::end_unheard;
pub use request::Request;
use reserve::Reserve;
pub use wire::{MAX_JSON_BYTES, Message, Receiver, Sender, WireError};

pub use crate::regular::{FileStamp, NotRegular, OpenFault, OpenFile, open_regular, read_small, read_small_text};

/// Opens foreign files: through a helper process, or (trusted files only) in this one.
#[derive(Clone, Debug)]
pub struct ForeignReader {
    program: Option<PathBuf>,
    limits: Option<Limits>,
    reserve: Option<Arc<Reserve>>,
}

impl ForeignReader {
    /// Helpers are the running program; in process where the system does not say which that is.
    #[must_use]
    pub fn this_program() -> Self {
        // On Linux by a name that holds even when the program's file is replaced during a long session.
        let own = PathBuf::from("/proc/self/exe");
        let program = if own.exists() { Some(own) } else { std::env::current_exe().ok() };
        Self { program, limits: None, reserve: None }
    }

    /// Helpers are `program`, which must know `read-foreign`.
    #[must_use]
    pub fn of(program: impl Into<PathBuf>) -> Self {
        Self { program: Some(program.into()), limits: None, reserve: None }
    }

    /// No helper: a crash of a decoder is a crash of this process. For files of one's own, and for the helper itself.
    #[must_use]
    pub fn in_process() -> Self {
        Self { program: None, limits: None, reserve: None }
    }

    /// With `limits` instead of those of the kind.
    #[must_use]
    pub fn with_limits(self, limits: Limits) -> Self {
        // Limits that were imposed on a helper are never raised again.
        Self { limits: Some(limits), reserve: None, ..self }
    }

    /// With a helper that has started before it is needed and reads one frame after the other, for whoever waits for them. One that fails on a
    /// file is replaced.
    #[must_use]
    pub fn with_reserve(self) -> Self {
        let reserve = self.program.as_deref().map(|program| Arc::new(Reserve::of(program)));
        Self { reserve, ..self }
    }

    /// Helpers to decode with; `None` in process.
    #[must_use]
    pub fn helpers(&self) -> Option<Helpers<'_>> {
        Some(Helpers { program: self.program.as_deref()?, reserve: self.reserve.as_deref() })
    }

    /// Process number of the helper that stands ready.
    #[must_use]
    pub fn waiting(&self) -> Option<u32> {
        self.reserve.as_deref()?.waiting()
    }

    /// The helper's program; `None` in process.
    #[must_use]
    pub fn program(&self) -> Option<&Path> {
        self.program.as_deref()
    }

    /// The limits for a file of this kind.
    #[must_use]
    pub fn limits(&self, kind: Kind) -> Limits {
        self.limits.clone().unwrap_or_else(|| Limits::of(kind))
    }
}

static INSTALLED: OnceLock<ForeignReader> = OnceLock::new();

/// Makes `reader` the one that everything in this process uses unless told otherwise. The program does this first of all; a library's user
/// who does not reads in process. Only the first call counts.
pub fn install(reader: ForeignReader) {
    let _ = INSTALLED.set(reader);
}

/// The installed reader, else one in process.
#[must_use]
pub fn installed() -> ForeignReader {
    INSTALLED.get().cloned().unwrap_or_else(ForeignReader::in_process)
}
