//! `sidecarm read-foreign`: the helper process that decodes one foreign file (see [`crate::foreign`]). Not for people.

use crate::foreign::{self, Kind, Request};
use crate::{acquire, scene};

/// Decodes the file on standard input within limits and answers on standard output.
#[derive(Debug, clap::Args)]
#[command(hide = true)]
pub struct ReadForeignArgs {
    /// What is asked for, as JSON; without it, that comes on standard input before the file.
    pub request: Option<String>,
}

/// Why a helper cannot even start.
#[derive(Debug, thiserror::Error)]
pub enum ReadForeignError {
    /// The request is not one that this version knows.
    #[error("the request to read a foreign file is not understood ({0})")]
    Request(#[from] serde_json::Error),
    /// Limits, input or output.
    #[error("reading a foreign file: {0}")]
    Io(#[from] std::io::Error),
}

/// Serves one request. The limits come first, before a byte of the file is looked at.
///
/// # Errors
/// When the request is unknown, a limit cannot be set, or the parent has gone.
pub fn run(args: &ReadForeignArgs) -> Result<u8, ReadForeignError> {
    let mut file = foreign::standard_input()?;
    let asked = match &args.request {
        Some(asked) => Some(asked.clone()),
        None => foreign::request(&mut file)?,
    };
    // One that stood ready, and was not needed.
    let Some(asked) = asked else { return Ok(0) };
    let request: Request = serde_json::from_str(&asked)?;
    foreign::impose(&request.limits)?;
    let out = std::io::stdout().lock();
    match request.kind {
        Kind::Frames => acquire::serve(&request, file, out)?,
        Kind::Volume | Kind::VolumeFacts | Kind::VolumeHeader | Kind::Slices | Kind::Mesh => scene::serve(&request, file, out)?,
    }
    Ok(0)
}
