//! What is typed after `sidecarm calibrate intensifier`.

use std::path::PathBuf;

use clap::Args;

use crate::acquire::Domain;

/// The distortion of an image intensifier from frames of a grid, or of a bead phantom: pincushion and S by angle of the C-arm, round mask,
/// veiling glare.
#[derive(Clone, Debug, Args)]
#[command(after_help = "Examples:
  sidecarm calibrate intensifier grid.dcm --pitch-mm 10 --out calibration/carm/lab-intensifier.json
  sidecarm calibrate intensifier grid-*.tif --holes --angles angles.json --opaque lead.tif --out lab-intensifier.json
  sidecarm calibrate intensifier shot-*.dcm --beads phantom.mrk.json --intrinsics K.json --out lab-intensifier.json

Fasten a plate with a square grid of beads (or holes, --holes) flat on the intensifier's input and leave it there for all angles; 42 spots
and more, 100 are better, over the whole disc. Angles come from DICOM positioner angles, or from --angles: [{\"frame\": \"grid-1.tif\",
\"orbital_deg\": 0, \"angulation_deg\": -30}, …]. register --distortion and \"intensifier\" of a scene's detector use the file. The figure
is the rms over spots of fits that did not have them. Exit code 1: no grid was recognised (said why).

With --beads the frames show one phantom whose bead places are known, not a grid: 24 beads and more, in depth, filling the disc. Turn and
shift it between the frames and take three frames or more at each angle: they share one distortion (frames without angles all do). K is
that of the undistorted picture, with pitch_mm. Frames in which the beads are not recognised are left out and named.")]
pub struct IntensifierArgs {
    /// Frames of the grid, one for each angle, or of the phantom of --beads: DICOM, PNG or TIFF
    #[arg(required = true, value_name = "FRAME")]
    pub grid: Vec<PathBuf>,
    /// The frames show a phantom with these beads instead of a grid: a 3D Slicer point list (.mrk.json or .fcsv)
    #[arg(long, value_name = "BEADS", requires = "intrinsics", conflicts_with_all = ["holes", "pitch_mm", "plate_moved"])]
    pub beads: Option<PathBuf>,
    /// K of the undistorted picture: {"intrinsics": 3x3, "size_px": [columns, rows], "pitch_mm": p}
    #[arg(long, value_name = "K.json", requires = "beads")]
    pub intrinsics: Option<PathBuf>,
    /// Where the phantom is expected: a pose file, once per frame, in their order
    #[arg(long, value_name = "POSE.json", requires = "beads")]
    pub prior: Vec<PathBuf>,
    /// Radius of beads whose description gives none
    #[arg(long, value_name = "MM", requires = "beads")]
    pub bead_radius: Option<f64>,
    /// The grid is of holes in a metal plate, bright where beads are dark
    #[arg(long)]
    pub holes: bool,
    /// Distance between neighbours on the plate; gives the side of a pixel there
    #[arg(long, value_name = "MM")]
    pub pitch_mm: Option<f64>,
    /// Orbital and angulation angle of each frame, by file name
    #[arg(long, value_name = "FILE.json")]
    pub angles: Option<PathBuf>,
    /// The plate was taken off between the frames: each keeps its own centre and direction
    #[arg(long)]
    pub plate_moved: bool,
    /// A frame with a disc of lead in the open beam, linear and with its offset taken out: gives the veiling glare
    #[arg(long, value_name = "FILE")]
    pub opaque: Option<PathBuf>,
    /// The round mask where the frames do not show it: column and row of its centre, radius, px
    #[arg(long, value_name = "U,V,R", value_delimiter = ',')]
    pub disc: Vec<f64>,
    /// Order of the polynomials; 5, with --beads 3 where beads do not suffice for it
    #[arg(long, value_name = "N")]
    pub order: Option<usize>,
    /// What the pixel values are: linear, log, display or unknown
    #[arg(long, value_name = "DOMAIN")]
    pub domain: Option<Domain>,
    /// Who measured, when, with which plate; goes into the file
    #[arg(long, value_name = "TEXT")]
    pub origin: Option<String>,
    /// Print the calibration as JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// The calibration
    #[arg(long, value_name = "FILE.json")]
    pub out: PathBuf,
}
