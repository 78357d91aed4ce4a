//! The panel, from frames without a specimen: offset, gain by photon transfer, the air signal by tube voltage and added filter, bad pixels,
//! noise power, and the presampled MTF where an edge was imaged.
//!
//! ```text
//! darks ── offset ─┐
//! airs  ── groups ─┴─ consistent ── air maps ── bad pixels ── photon transfer ── noise power ── DetectorCalibration
//! edge  ─────────────────────────────────────────────────── MTF ─────────────────────────────┘
//! ```
//! Photon transfer: a panel that stores `offset + gain · quanta` has a variance of `gain · (mean − offset)` plus its electronics'. The
//! fixed pattern would add to the variance, so it is taken from differences of two frames of the same exposure. An energy-integrating
//! panel sums photons of different energies; one quantum of its noise is ⟨E²⟩/⟨E⟩, and photons outnumber quanta by ⟨E²⟩/⟨E⟩².
//!
//! Without darks the air frames are measured twice: what they say with a first offset gives a sharper one.

mod air;
mod bad_pixels;
mod edge;
mod error;
mod groups;
mod intercept;
mod measured;
mod measurement;
mod noise_power;
mod offset;
mod surface;
mod transfer;

use crate::acquire::{
    AddedFilter, AirBeam, DetectorCalibration, DetectorRecord, EdgeMtf, ExposureLevel, FilterMaterial, Likeness, PanelResponse,
    panel_maps::PanelMaps,
};
use crate::image::Image;

pub use error::DetectorError;
pub use measurement::{Measurement, PanelFrame};

/// Calibrates.
///
/// # Errors
/// When the frames do not determine offset, air signal or gain, or contradict each other; the message says which frame and what to do.
pub fn calibrate(measurement: &Measurement) -> Result<DetectorCalibration, DetectorError> {
    let size_px = check_frames(measurement)?;
    let mut notes = Vec::new();
    let saturation = saturation_value(measurement, &mut notes);
    let groups = groups::group(&measurement.air, saturation)?;
    check_filtration(measurement.filter.as_deref(), &groups)?;
    let mut offset = offset::find(&measurement.dark, &groups, saturation, &mut notes)?;
    let (mut measured, mut bad) = measured::all(&groups, &offset, size_px, saturation)?;
    if measurement.dark.is_empty()
        && let Some(refined) = intercept::refined(&offset, &measured, &bad, &mut notes)?
    {
        offset = refined;
        (measured, bad) = measured::all(&groups, &offset, size_px, saturation)?;
    }
    let mut beams = Vec::new();
    let mut maps = PanelMaps { offset_value: offset.map.clone(), ..PanelMaps::default() };
    let nps = measured.iter().find_map(|of| noise_power::find(&of.group, &offset, &of.air, &bad, measurement.pitch_mm));
    let readout_sigma = offset.readout_sigma.or_else(|| measured::readout_sigma(&measured, &mut notes));
    for measured::MeasuredBeam { group, air, transfer } in measured {
        beams.push(beam(measurement, &group, &air, &transfer));
        notes.extend(transfer.notes);
        maps.air_share.push(air.share);
    }
    let mtf = match &measurement.edge {
        Some(edge) => {
            let air = air_for(edge, &beams, &maps);
            Some(edge_mtf(edge, &offset, air, &bad, measurement.pitch_mm)?)
        }
        None => {
            notes.push("no MTF: no edge frame was given (--edge)".into());
            None
        }
    };
    if measurement.pitch_mm.is_none() {
        notes.push("the pixel pitch is not known: frequencies are per pixel".into());
    }
    let record = DetectorRecord {
        origin: measurement.origin.clone(),
        columns_px: size_px[0] as u32,
        rows_px: size_px[1] as u32,
        pitch_mm: measurement.pitch_mm,
        response: measurement.response,
        bits: measurement.bits,
        saturation_value: saturation,
        offset_value: Some(offset.median),
        offset_sigma_value: Some(offset.sigma),
        offset_from: Some(offset.from.to_owned()),
        readout_sigma_value: readout_sigma,
        air_value: None,
        photons_per_pixel: None,
        noise_correlation_first_neighbour: None,
        noise_correlation_second_neighbour: None,
        beams,
        bad_pixels: bad_pixels::count(&bad),
        mtf,
        nps,
        notes,
        maps: None,
    };
    maps.bad = Some(bad);
    Ok(DetectorCalibration { record, maps })
}

fn check_frames(measurement: &Measurement) -> Result<[usize; 2], DetectorError> {
    let first = measurement.air.first().ok_or(DetectorError::NoAir)?;
    let expected = [first.pixels.width, first.pixels.height];
    let all = measurement.air.iter().chain(&measurement.dark).chain(&measurement.edge);
    for frame in all.clone() {
        let count = frame.pixels.pixels.iter().filter(|value| !value.is_finite()).count();
        if count > 0 {
            return Err(DetectorError::NotFinite { label: frame.label.clone(), count });
        }
    }
    match all.map(|frame| (frame, [frame.pixels.width, frame.pixels.height])).find(|(_, size)| *size != expected) {
        None => Ok(expected),
        Some((frame, found)) => {
            Err(DetectorError::Size { label: frame.label.clone(), found, first: first.label.clone(), expected })
        }
    }
}

/// Equal values at the very top of a frame are a plateau when there are this many …
const PLATEAU_PIXELS: usize = 20;
/// … and this many times as many as at the value below.
const PLATEAU_RATIO: usize = 5;

/// The stored value at which the panel saturates: the end of its bits, or a plateau that the frames show.
fn saturation_value(measurement: &Measurement, notes: &mut Vec<String>) -> Option<f64> {
    let values = || measurement.air.iter().flat_map(|frame| frame.pixels.pixels.iter().copied());
    let top = values().fold(f32::MIN, f32::max);
    let at = |value: f32| values().filter(|v| *v == value).count();
    let plateau = at(top);
    let shown = plateau >= PLATEAU_PIXELS && plateau >= PLATEAU_RATIO * at(top - 1.0).max(1);
    let by_bits = measurement.bits.map(|bits| f64::from(2u32.saturating_pow(bits.min(31))) - 1.0);
    if shown && by_bits.is_none_or(|end| f64::from(top) < end) {
        notes.push(format!("the panel saturates at {top}: {plateau} pixels stand there"));
        return Some(f64::from(top));
    }
    by_bits
}

/// Whether `declared` (`aluminium=4.3,copper=0.2`) says how much of `material` is in the beam.
fn declares(declared: &str, material: FilterMaterial) -> bool {
    declared.split(',').filter_map(|part| part.split('=').next()).any(|name| FilterMaterial::named(name) == Some(material))
}

/// What is declared holds for all beams: what the frames state of its materials is one thickness, as two statements of one filter are.
fn check_filtration(declared: Option<&str>, groups: &[groups::Group]) -> Result<(), DetectorError> {
    let filters: Vec<&AddedFilter> = groups.iter().filter_map(|group| group.beam.filter.as_ref()).collect();
    let declared = |material: &FilterMaterial| declared.is_some_and(|declared| declares(declared, *material));
    for material in FilterMaterial::ALL.into_iter().filter(declared) {
        let of_it = |filter: &AddedFilter| {
            let layers = filter.layers.iter().filter(|layer| layer.material == material).copied().collect();
            AddedFilter { stated_by: filter.stated_by, form: None, layers }
        };
        let Some(first) = filters.first().map(|filter| of_it(filter)) else { return Ok(()) };
        if filters.iter().any(|filter| first.likeness(&of_it(filter)) != Likeness::Same) {
            let filters = filters.iter().map(|filter| filter.words()).collect::<Vec<_>>().join("; ");
            return Err(DetectorError::Filtration { material: material.names()[0], filters });
        }
    }
    Ok(())
}

/// Everything that filters a beam: what is declared, and what the frames state of other materials. `None` where a thickness is not known, or what
/// a material is.
fn filtration(declared: Option<&str>, added: Option<&AddedFilter>) -> Option<String> {
    let declared = declared?;
    let mut all = declared.to_owned();
    let others = added.into_iter().flat_map(AddedFilter::materials).filter(|(material, _)| !declares(declared, *material));
    for (material, thickness_mm) in others {
        let [least_mm, most_mm] = thickness_mm.filter(|_| material != FilterMaterial::Other)?;
        all += &format!(",{}={}", material.names()[0], 0.5 * (least_mm + most_mm));
    }
    Some(all)
}

fn beam(measurement: &Measurement, group: &air::Consistent, air: &air::AirMap, transferred: &transfer::Transfer) -> AirBeam {
    let kvp = group.beam.kvp;
    let filter = filtration(measurement.filter.as_deref(), group.beam.filter.as_ref());
    let moments = kvp.zip(filter.as_deref()).and_then(|(kvp, filter)| (measurement.spectrum_moments_kev)(kvp, filter));
    let moments = moments.filter(|_| measurement.response == PanelResponse::Energy);
    let gain = transferred.gain;
    let photons_per_quantum = match measurement.response {
        PanelResponse::Counting => Some(1.0),
        PanelResponse::Energy => moments.map(|[mean, square]| square / (mean * mean)),
    };
    let quanta_per_mas = air.per_mas.map(|value| value / gain);
    let levels = group.levels.iter().map(|level| ExposureLevel {
        exposure_mas: level.mas,
        frames: level.frames.len(),
        air_value: level.median,
        quanta_per_pixel: Some(level.median / gain),
        saturated_share: 0.0,
    });
    let mut levels: Vec<ExposureLevel> = levels.chain(group.saturated.iter().cloned()).collect();
    levels.sort_by(|a, b| a.air_value.total_cmp(&b.air_value));
    AirBeam {
        tube_kvp: kvp,
        filter,
        added_filter: group.beam.filter.clone(),
        source_to_detector_mm: group.source_to_detector_mm,
        air_value_per_mas: air.per_mas,
        air_value: air.per_mas.is_none().then_some(air.median),
        air_relative_sigma: air.relative_sigma,
        gain_value_per_quantum: Some(gain),
        gain_relative_sigma: Some(transferred.relative_sigma),
        quanta_per_pixel_per_mas: quanta_per_mas,
        photons_per_quantum,
        photons_per_pixel_per_mas: quanta_per_mas.zip(photons_per_quantum).map(|(quanta, photons)| quanta * photons),
        gain_value_per_kev: moments.map(|[mean, square]| gain * mean / square),
        heel_share: Some(air.heel_share),
        levels,
        frames_left_out: group.left_out.clone(),
    }
}

/// The air map of the edge's filter and of the tube voltage nearest to its own, of the first where none is known.
fn air_for<'m>(edge: &PanelFrame, beams: &[AirBeam], maps: &'m PanelMaps) -> Option<&'m Image<f32>> {
    let away = |beam: &AirBeam| match (beam.tube_kvp, edge.tube_kvp) {
        (Some(air), Some(edge)) => (air - edge).abs(),
        _ => f64::INFINITY,
    };
    let pairs = beams.iter().zip(&maps.air_share);
    let likeness = |beam: &AirBeam| Likeness::between(edge.filter.as_ref(), beam.added_filter.as_ref());
    let order = |a: &AirBeam, b: &AirBeam| likeness(a).cmp(&likeness(b)).then(away(a).total_cmp(&away(b)));
    pairs.min_by(|a, b| order(a.0, b.0)).map(|(_, map)| map)
}

/// Bad pixels are left out: each would turn up in the edge's profile, and twice in its derivative.
fn edge_mtf(
    edge: &PanelFrame,
    offset: &offset::Offset,
    air: Option<&Image<f32>>,
    bad: &Image<u8>,
    pitch_mm: Option<f64>,
) -> Result<EdgeMtf, DetectorError> {
    let mut flat = edge.pixels.clone();
    for (at, value) in flat.pixels.iter_mut().enumerate() {
        let share = air.map_or(1.0, |map| map.pixels[at]);
        let good = bad.pixels[at] == 0;
        *value = if good { (f64::from(*value) - offset.at(at)) as f32 / if share > 0.0 { share } else { 1.0 } } else { f32::NAN };
    }
    edge::mtf(&flat, pitch_mm.unwrap_or(1.0)).map_err(|detail| DetectorError::Edge { label: edge.label.clone(), detail })
}

#[cfg(test)]
mod tests {
    use super::groups::{Beam, Group};
    use super::*;

    #[test]
    fn a_declared_filter_is_one_where_the_frames_differ_by_digits_and_none_where_they_differ_by_a_sheet() {
        let checked = |thicknesses_mm: [&str; 2], declared: &str| {
            let group = |(n, text): (usize, &str)| {
                let filter = Some(text.parse().expect("a filter"));
                let beam = Beam { kvp: Some(60.0 + 30.0 * n as f64), filter };
                Group { beam, frames: Vec::new(), saturated: Vec::new(), left_out: Vec::new() }
            };
            let groups: Vec<Group> = thicknesses_mm.into_iter().enumerate().map(group).collect();
            check_filtration(Some(declared), &groups)
        };
        assert!(checked(["copper=0.1", "copper=0.1000001"], "copper=0.1").is_ok());
        let refused = checked(["copper=0.1", "copper=0.2"], "copper=0.1").expect_err("another sheet");
        assert!(refused.to_string().contains("0.20 mm of copper"), "{refused}");
        assert!(checked(["copper=0.1", "none"], "copper=0.1").is_err());
        // Of a material that is not declared each beam may have its own.
        assert!(checked(["copper=0.1", "copper=0.2"], "aluminium=4.3").is_ok());
    }
}
