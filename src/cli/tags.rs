//! `sidecarm tags IMAGE`: the AprilTags that a radiograph or a photograph shows.

use std::path::PathBuf;

use serde_json::json;

use crate::acquire::{AcquireError, Frame, read_photo};
use crate::beads::tags::{Family, SeenTag, TagsError, find_tags};
use crate::reporter::Reporter;

/// List the AprilTags in a radiograph or a photograph.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm tags photo.jpg --family tag36h11

Corners are in continuous pixels, the centre of the first pixel being (0, 0): lower left, lower right, upper right, upper left of the
tag as it is read. Exit code 0: tags were found; 1: none, or the file cannot be read.")]
pub struct TagsArgs {
    /// DICOM, PNG, TIFF or JPEG
    pub image: PathBuf,
    /// tag16h5, tag25h9, tag36h11, tagCircle21h7, tagCircle49h12, tagStandard41h12, tagStandard52h13 or tagCustom48h12
    #[arg(long, value_name = "FAMILY", default_value_t = Family::Tag36h11)]
    pub family: Family,
    /// Print JSON instead of a table
    #[arg(long)]
    pub json: bool,
}

/// Why no tags are listed.
#[derive(Debug, thiserror::Error)]
pub enum TagsCommandError {
    /// The image.
    #[error(transparent)]
    Image(#[from] AcquireError),
    /// The decoder.
    #[error(transparent)]
    Decoder(#[from] TagsError),
}

/// Lists the tags. Returns the exit code: 0 when there are any, else 1.
///
/// # Errors
/// When the image cannot be read, or this build reads no tags.
pub fn run(args: &TagsArgs, reporter: &Reporter) -> Result<u8, TagsCommandError> {
    let frame = read_photo(&args.image)?;
    let found = find_tags(&frame, args.family)?;
    if args.json {
        println!("{:#}", json!({ "family": args.family, "size_px": frame.size_px, "tags": found }));
    } else {
        print!("{}", table(&frame, &found));
    }
    if found.is_empty() {
        reporter.note(format!("sidecarm: no {} tags in {}", args.family, args.image.display()));
    }
    Ok(u8::from(found.is_empty()))
}

fn table(frame: &Frame, found: &[SeenTag]) -> String {
    let [width, height] = frame.size_px;
    let mut lines = vec![format!("{} tags in {width} x {height} px", found.len())];
    for tag in found {
        let corners: Vec<String> = tag.corners_px.iter().map(|corner| format!("({:.2}, {:.2})", corner.x, corner.y)).collect();
        let looks = match (tag.inverted, tag.mirrored) {
            (false, false) => "",
            (true, false) => "  inverted",
            (false, true) => "  mirrored",
            (true, true) => "  inverted and mirrored",
        };
        let (id, margin, centre) = (tag.id, tag.margin, tag.centre_px);
        let corners = corners.join(" ");
        lines.push(format!("{id:>6} at ({:8.2}, {:8.2})  margin {margin:5.1}  corners {corners}{looks}", centre.x, centre.y));
    }
    lines.join("\n") + "\n"
}
