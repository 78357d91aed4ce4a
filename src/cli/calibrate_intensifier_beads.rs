//! `sidecarm calibrate intensifier --beads`: what is read of the phantom, of K and of where the phantom is expected.

use std::path::PathBuf;

use super::calibrate_intensifier_args::IntensifierArgs;
use super::calibrate_intensifier_error::CalibrateIntensifierError;
use super::shot_files::{doubted, read_priors};
use crate::beads::{BeadLayout, read_markups};
use crate::calibrate::intensifier::{GridFrame, PhantomRequest};
use crate::geometry::{AnglesFrom, Glare};
use crate::mask::Disc;
use crate::pose::{IntrinsicsFile, Prior, whole_binning};
use crate::reporter::Reporter;

/// What is known of the phantom before a frame is looked at.
pub(super) struct Phantom {
    layout: BeadLayout,
    /// K and its file.
    intrinsics: (IntrinsicsFile, PathBuf),
    /// None, or one for each frame.
    priors: Vec<Prior>,
    /// Of frames whose priors are in doubt, why.
    pub doubts: Vec<String>,
}

/// The phantom that was given; `None`: the frames show a grid. Priors in doubt are warned of.
pub(super) fn phantom(args: &IntensifierArgs, reporter: &Reporter) -> Result<Option<Phantom>, CalibrateIntensifierError> {
    let Some((beads, k)) = args.beads.as_deref().zip(args.intrinsics.as_ref()) else { return Ok(None) };
    let (priors, frames) = (args.prior.len(), args.grid.len());
    if !(priors == 0 || priors == frames) {
        return Err(CalibrateIntensifierError::Priors { priors, frames });
    }
    let (priors, doubts) = read_priors(&args.prior)?;
    Ok(Some(Phantom {
        layout: read_markups(beads)?,
        intrinsics: (IntrinsicsFile::read(k)?, k.clone()),
        priors,
        doubts: doubted(&args.grid, &doubts, reporter),
    }))
}

impl Phantom {
    /// The request for `frames`, with disc, source of the angles, glare and origin as for a grid.
    pub fn request(
        &self,
        args: &IntensifierArgs,
        frames: &[GridFrame],
        (disc, angles_from, glare, origin): (Option<Disc>, AnglesFrom, Option<Glare>, String),
    ) -> Result<PhantomRequest<'_>, CalibrateIntensifierError> {
        let (file, path) = &self.intrinsics;
        let first = frames.first().map(|frame| &frame.frame);
        let found = first.map_or([0, 0], |frame| frame.size_px.map(|n| n as u32));
        let expected = file.size_px.unwrap_or(found);
        let factor = whole_binning(expected, found).ok_or_else(|| CalibrateIntensifierError::Size {
            path: path.clone(),
            expected,
            found,
        })?;
        let factor = f64::from(factor);
        let tagged_mm = first.and_then(|frame| frame.tags.pitch_mm).map(|pitch| pitch[0]);
        let pitch_mm = file.pitch_mm.map(|pitch| pitch * factor).or(tagged_mm);
        Ok(PhantomRequest {
            layout: &self.layout,
            intrinsics: file.intrinsics.binned(factor),
            pitch_mm: pitch_mm.ok_or_else(|| CalibrateIntensifierError::NoPitch { path: path.clone() })?,
            priors: &self.priors,
            bead_radius_mm: args.bead_radius,
            order: args.order,
            disc,
            angles_from,
            glare,
            origin,
        })
    }
}
