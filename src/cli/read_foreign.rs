//! `sidecarm read-foreign`: the helper process that decodes one foreign file (see [`crate::foreign`]). Not for people.

use std::io::{Read, Write};

use crate::foreign::{self, Kind, Request};
use crate::{acquire, scene};

/// Decodes the file on standard input within limits and answers on standard output.
#[derive(Debug, clap::Args)]
#[command(hide = true)]
pub struct ReadForeignArgs {
    /// What is asked for, as JSON; without it, requests come on standard input, each before its file.
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

/// Serves one request, or all that come. The limits come before a byte of the file is looked at.
///
/// # Errors
/// When the request is unknown, a limit cannot be set, or the parent has gone.
pub fn run(args: &ReadForeignArgs) -> Result<u8, ReadForeignError> {
    foreign::end_unheard()?;
    let mut input = foreign::standard_input()?;
    let mut out = std::io::stdout().lock();
    let Some(asked) = &args.request else { return frames(&mut input, &mut out) };
    let request: Request = serde_json::from_str(asked)?;
    foreign::impose(&request.limits)?;
    match request.kind {
        Kind::Frames => acquire::serve(&request, input, out)?,
        Kind::Volume | Kind::VolumeFacts | Kind::VolumeHeader | Kind::Slices | Kind::Mesh => scene::serve(&request, input, out)?,
    }
    Ok(0)
}

/// One file of frames after the other, until no more is asked.
fn frames(input: &mut impl Read, out: &mut impl Write) -> Result<u8, ReadForeignError> {
    while let Some((asked, bytes)) = foreign::next_request(input)? {
        let request: Request = serde_json::from_str(&asked)?;
        foreign::impose_on_next(&request.limits)?;
        let mut file = input.by_ref().take(bytes);
        acquire::serve(&request, &mut file, &mut *out)?;
        // A decoder that had its reasons left a rest.
        std::io::copy(&mut file, &mut std::io::sink())?;
    }
    Ok(0)
}
