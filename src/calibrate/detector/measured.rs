//! What the air frames of each beam say, given the offset.

use super::air::{self, AirMap};
use super::bad_pixels;
use super::error::DetectorError;
use super::groups::Group;
use super::offset::Offset;
use super::transfer::{self, Transfer};
use crate::image::Image;

/// What the air frames of a beam say.
pub(super) struct MeasuredBeam<'a> {
    pub group: air::Consistent<'a>,
    pub air: AirMap,
    pub transfer: Transfer,
}

/// All beams, and the pixels that are bad in any.
pub(super) fn all<'a>(
    groups: &[Group<'a>],
    offset: &Offset,
    size_px: [usize; 2],
    saturation: Option<f64>,
) -> Result<(Vec<MeasuredBeam<'a>>, Image<u8>), DetectorError> {
    let mut bad = bad_pixels::hot(offset, size_px);
    let mut measured = Vec::new();
    for group in groups {
        let group = air::consistent(group, offset)?;
        let air = air::map(&group, offset, &bad)?;
        bad_pixels::add_dead(&mut bad, &air);
        let transfer = transfer::find(&group, offset, &bad, saturation)?;
        bad_pixels::add_unstable(&mut bad, &group, &air, offset, &transfer);
        // Once more without the pixels that turned out to be unstable.
        let transfer = transfer::find(&group, offset, &bad, saturation)?;
        measured.push(MeasuredBeam { group, air, transfer });
    }
    Ok((measured, bad))
}

/// A variance this many of its standard deviations above zero gives the electronic noise to a tenth.
const READOUT_SIGMAS: f64 = 5.0;

/// Electronic noise without two darks, from the beam that gives it best; `None` where the quanta's noise drowns it.
pub(super) fn readout_sigma(measured: &[MeasuredBeam], notes: &mut Vec<String>) -> Option<f64> {
    let ends = measured.iter().filter_map(|beam| beam.transfer.end_variance);
    let [variance, sigma] = ends.min_by(|a, b| a[1].total_cmp(&b[1]))?;
    if !(variance > READOUT_SIGMAS * sigma) {
        notes.push(format!(
            "the electronic noise is not known: the air frames give its variance as {variance:.1} ± {sigma:.1}; take two dark frames (--dark)"
        ));
        return None;
    }
    let readout = variance.sqrt();
    notes.push(format!(
        "electronic noise of {readout:.2} ± {:.2} from the air frames, where their variance ends without signal",
        0.5 * sigma / readout
    ));
    Some(readout)
}
