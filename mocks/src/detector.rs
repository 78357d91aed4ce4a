//! A flat panel as it comes from the factory: offset, heel, fixed pattern, quanta, electronics, rounding, and pixels that are broken.

use std::path::{Path, PathBuf};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal, Poisson};
use serde_json::{Value, json};

use crate::MockError;
use crate::dicom::{BeamTags, FrameTags, deliver, encode};

/// An exposure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beam {
    /// Without X-rays 0.
    pub mas: f64,
    /// Tube voltage.
    pub kvp: f64,
    /// Filter in the beam.
    pub copper_mm: f64,
}

/// What the panel adds up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Response {
    /// Quanta, all alike.
    Counting,
    /// The energy of photons between two ends of a flat spectrum.
    Energy,
}

/// A panel and a tube.
#[derive(Clone, Debug)]
pub struct Panel {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// What is added up.
    pub response: Response,
    /// Stored value per quantum (counting) or per keV (energy).
    pub gain: f64,
    /// Stored value without X-rays, mean over the panel.
    pub offset: f64,
    /// Stored values end at 2^bits − 1.
    pub bits: u32,
    /// Signal lost from the first column to the last.
    pub heel: f64,
    /// Detected quanta (photons) per pixel and mAs at 90 kVp at the first column.
    pub quanta_per_mas: f64,
    /// Of the gain from pixel to pixel.
    pub pattern_sigma: f64,
    /// Of the offset from pixel to pixel, stored value.
    pub offset_sigma: f64,
    /// Electronic noise, stored value.
    pub readout_sigma: f64,
    /// Electronic noise that a whole column has in common, another in each frame, stored value.
    pub line_sigma: f64,
    /// Of the tube's output from exposure to exposure.
    pub output_sigma: f64,
    /// Share of a pixel's light that each of its four neighbours sees.
    pub spread: f64,
    /// Of each kind: dead, hot, unstable.
    pub broken: usize,
    /// Of everything random.
    pub seed: u64,
}

impl Default for Panel {
    fn default() -> Self {
        Self {
            size_px: [256, 192],
            response: Response::Counting,
            gain: 0.37,
            offset: 212.0,
            bits: 14,
            heel: 0.18,
            quanta_per_mas: 2000.0,
            pattern_sigma: 0.02,
            offset_sigma: 3.0,
            readout_sigma: 2.5,
            line_sigma: 0.0,
            output_sigma: 0.002,
            spread: 0.0,
            broken: 0,
            seed: 1,
        }
    }
}

/// What stands on the panel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Object {
    /// Nothing.
    Nothing,
    /// A bead: column, row, radius; lets through a third.
    Bead([f64; 3]),
    /// A metal edge through the middle, turned by so many degrees against the columns; lets nothing through.
    Edge(f64),
    /// Matter of known line integral: see [`wedge_nepers`].
    Wedge,
}

/// Line integral of the wedge: open air in the first tenth of the columns, rising to three nepers, wavy along the rows.
#[must_use]
pub fn wedge_nepers(column: usize, row: usize, [columns, _]: [usize; 2]) -> f64 {
    let along = (column as f64 / (columns - 1) as f64 - 0.1).max(0.0) / 0.9;
    3.0 * along * (0.8 + 0.2 * (row as f64 / 9.0).sin())
}

/// Ends of the flat spectrum, keV.
const SPECTRUM_KEV: [f64; 2] = [30.0, 90.0];

/// The panel's fixed pattern.
#[derive(Clone, Debug)]
pub struct Made {
    panel: Panel,
    gain: Vec<f64>,
    offset: Vec<f64>,
    /// Pixel indices: dead, hot, unstable.
    pub broken: [Vec<usize>; 3],
}

impl Panel {
    /// ⟨E⟩ and ⟨E²⟩/⟨E⟩ of what is added up: 1 and 1 for counting.
    #[must_use]
    pub fn quantum(&self) -> [f64; 2] {
        match self.response {
            Response::Counting => [1.0, 1.0],
            Response::Energy => {
                let [a, b] = SPECTRUM_KEV;
                let mean = 0.5 * (a + b);
                [mean, (a * a + a * b + b * b) / 3.0 / mean]
            }
        }
    }

    /// Draws the fixed pattern.
    #[must_use]
    pub fn make(&self) -> Made {
        let mut random = ChaCha8Rng::seed_from_u64(self.seed.wrapping_mul(7919));
        let count = self.size_px[0] * self.size_px[1];
        let mut normal = |sigma: f64| Normal::new(0.0, sigma).map_or(0.0, |normal| normal.sample(&mut random));
        let gain = (0..count).map(|_| 1.0 + normal(self.pattern_sigma)).collect();
        let offset = (0..count).map(|_| self.offset + normal(self.offset_sigma)).collect();
        let mut places: Vec<usize> = Vec::new();
        while places.len() < 3 * self.broken {
            let at = random.random_range(0..count);
            if !places.contains(&at) {
                places.push(at);
            }
        }
        let broken = std::array::from_fn(|kind| places[kind * self.broken..(kind + 1) * self.broken].to_vec());
        Made { panel: self.clone(), gain, offset, broken }
    }

    /// Share of the signal at a column.
    fn heel_at(&self, column: usize) -> f64 {
        1.0 - self.heel * (column as f64 / (self.size_px[0] - 1) as f64).powf(1.4)
    }

    /// Mean quanta at a column for an exposure.
    #[must_use]
    pub fn quanta(&self, column: usize, beam: &Beam) -> f64 {
        let Beam { mas, kvp, copper_mm } = *beam;
        // The heel's soft end loses more in copper: the field is another behind each filter.
        let along = column as f64 / (self.size_px[0] - 1) as f64;
        let copper = (-2.5 * copper_mm * (1.0 + 0.5 * along)).exp();
        self.quanta_per_mas * mas * (kvp / 90.0).powf(2.5) * self.heel_at(column) * copper
    }
}

impl Made {
    /// The `nth` frame.
    #[must_use]
    pub fn frame(&self, nth: u64, beam: &Beam, object: Object) -> Vec<u16> {
        let panel = &self.panel;
        let [columns, rows] = panel.size_px;
        let mut random = ChaCha8Rng::seed_from_u64(panel.seed.wrapping_mul(1_000_003).wrapping_add(nth));
        let normal = |sigma: f64, random: &mut ChaCha8Rng| Normal::new(0.0, sigma).map_or(0.0, |n| n.sample(random));
        let output = if beam.mas > 0.0 { 1.0 + normal(panel.output_sigma, &mut random) } else { 0.0 };
        let [mean_kev, quantum] = panel.quantum();
        let mut light = vec![0.0; columns * rows];
        for (at, value) in light.iter_mut().enumerate() {
            let photons = panel.quanta(at % columns, beam) * output * passed(object, at % columns, at / columns, panel.size_px);
            // Σ E of Poisson many photons, by a count of equal quanta with the right mean and variance.
            let expected = photons * mean_kev / quantum;
            *value = quantum * if expected > 0.0 { Poisson::new(expected).map_or(0.0, |p| p.sample(&mut random)) } else { 0.0 };
        }
        if panel.spread > 0.0 {
            light = spread(&light, columns, rows, panel.spread);
        }
        let end = f64::from((1u32 << panel.bits) - 1);
        let lines = (0..columns).map(|_| if panel.line_sigma > 0.0 { normal(panel.line_sigma, &mut random) } else { 0.0 });
        let lines: Vec<f64> = lines.collect();
        let mut values: Vec<f64> = light
            .iter()
            .enumerate()
            .map(|(at, light)| {
                let expected = self.offset[at] + panel.gain * self.gain[at] * light;
                expected + lines[at % columns] + normal(panel.readout_sigma, &mut random)
            })
            .collect();
        for &at in &self.broken[0] {
            values[at] = self.offset[at] + normal(panel.readout_sigma, &mut random);
        }
        for &at in &self.broken[1] {
            values[at] += 900.0;
        }
        for &at in &self.broken[2] {
            values[at] += normal(60.0 * panel.readout_sigma, &mut random);
        }
        values.iter().map(|value| value.round().clamp(0.0, end) as u16).collect()
    }
}

/// Share of the pixel's light that passes, over a grid of its area.
fn passed(object: Object, column: usize, row: usize, [columns, rows]: [usize; 2]) -> f64 {
    const GRID: usize = 8;
    let sample = |f: &dyn Fn(f64, f64) -> f64| {
        let at = |centre: usize, k: usize| centre as f64 + (k as f64 + 0.5) / GRID as f64 - 0.5;
        (0..GRID * GRID).map(|k| f(at(column, k % GRID), at(row, k / GRID))).sum::<f64>() / (GRID * GRID) as f64
    };
    match object {
        Object::Nothing => 1.0,
        Object::Wedge => (-wedge_nepers(column, row, [columns, rows])).exp(),
        Object::Bead([u, v, radius]) => {
            if (column as f64 - u).hypot(row as f64 - v) > radius + 2.0 {
                return 1.0;
            }
            sample(&|x, y| if (x - u).hypot(y - v) <= radius { 0.33 } else { 1.0 })
        }
        Object::Edge(angle_deg) => {
            let (sin, cos) = angle_deg.to_radians().sin_cos();
            let distance = |x: f64, y: f64| (x - 0.5 * columns as f64) * cos - (y - 0.5 * rows as f64) * sin;
            match distance(column as f64, row as f64) {
                far if far > 2.0 => 1.0,
                far if far < -2.0 => 0.0,
                _ => sample(&|x, y| if distance(x, y) > 0.0 { 1.0 } else { 0.0 }),
            }
        }
    }
}

/// Each neighbour on a side sees `share` of a pixel's light; at the border it is kept.
fn spread(light: &[f64], columns: usize, rows: usize, share: f64) -> Vec<f64> {
    let mut out = vec![0.0; light.len()];
    for (at, value) in light.iter().enumerate() {
        let (u, v) = (at % columns, at / columns);
        let mut kept = *value;
        let mut give = |beside: Option<usize>| {
            if let Some(beside) = beside {
                out[beside] += share * value;
                kept -= share * value;
            }
        };
        give((u > 0).then(|| at - 1));
        give((u + 1 < columns).then_some(at + 1));
        give((v > 0).then(|| at.wrapping_sub(columns)));
        give((v + 1 < rows).then_some(at + columns));
        out[at] += kept;
    }
    out
}

/// What to write.
#[derive(Clone, Debug)]
pub struct Series {
    /// Exposures, mAs.
    pub levels_mas: Vec<f64>,
    /// Tube voltages; every level is taken at each.
    pub kvps: Vec<f64>,
    /// Thicknesses of a copper filter, stated by the frames; every level is taken at each. Without any, frames state no filter.
    pub coppers_mm: Vec<f64>,
    /// Air frames per level.
    pub frames: usize,
    /// Dark frames.
    pub darks: usize,
    /// A bead stands in this many of the air frames, the first of the highest level on.
    pub beads: usize,
    /// An edge frame, too, at the highest exposure.
    pub edge: bool,
    /// A frame of the wedge, too, at the middle exposure.
    pub wedge: bool,
}

/// Tube current of all frames, mA.
const TUBE_MA: f32 = 4.0;
/// Focal spot to panel and pixel pitch, mm.
const GEOMETRY_MM: [f64; 2] = [1020.0, 0.194];

impl Series {
    /// Voltages with their filters.
    fn beams(&self) -> impl Iterator<Item = Beam> + '_ {
        let coppers_mm = if self.coppers_mm.is_empty() { vec![0.0] } else { self.coppers_mm.clone() };
        self.kvps
            .iter()
            .flat_map(move |kvp| coppers_mm.clone().into_iter().map(move |copper_mm| Beam { mas: 1.0, kvp: *kvp, copper_mm }))
    }
}

/// Writes `air-KVP-MAS-N.dcm` (`air-KVP-COPPER-MAS-N.dcm` with filters), `dark-N.dcm`, `edge.dcm`, `wedge.dcm` and `truth.json` into `folder`.
///
/// # Errors
/// When a file cannot be written.
pub fn write(folder: &Path, panel: &Panel, series: &Series) -> Result<(), MockError> {
    std::fs::create_dir_all(folder).map_err(MockError::io(folder.display()))?;
    let made = panel.make();
    let mut nth = 0u64;
    let [half_width_mm, half_height_mm] = panel.size_px.map(|side| 0.5 * side as f64 * GEOMETRY_MM[1]);
    let field_mm = [-half_width_mm, -half_height_mm, half_width_mm, half_height_mm];
    let mut put = |name: String, beam: Beam, object: Object| -> Result<PathBuf, MockError> {
        nth += 1;
        let values = made.frame(nth, &beam, object);
        let Beam { mas, kvp, copper_mm } = beam;
        let tags = FrameTags {
            size_px: panel.size_px,
            pitch_mm: GEOMETRY_MM[1],
            source_to_detector_mm: GEOMETRY_MM[0],
            tube_kvp: kvp as f32,
            tube_ma: if mas > 0.0 { TUBE_MA } else { 0.0 },
            exposure_ms: 1e3 * mas / f64::from(TUBE_MA),
            acquired_us: Some(1_795_237_262_250_000 + 1_000_000 * nth as i64),
            exposure_counter: Some(nth as u32),
            instance: nth as u32,
            beam: (!series.coppers_mm.is_empty()).then_some(BeamTags { filter_mm: [0.0, copper_mm], field_mm }),
        };
        let path = folder.join(name);
        deliver(&path, &encode(&tags, &values)?)?;
        Ok(path)
    };
    for dark in 0..series.darks {
        put(format!("dark-{:02}.dcm", dark + 1), Beam { mas: 0.0, kvp: 0.0, copper_mm: 0.0 }, Object::Nothing)?;
    }
    let bead = Object::Bead([0.3 * panel.size_px[0] as f64, 0.4 * panel.size_px[1] as f64, 3.5]);
    for beam in series.beams() {
        let mut beads = series.beads;
        let Beam { kvp, copper_mm, .. } = beam;
        let copper = if series.coppers_mm.is_empty() { String::new() } else { format!("{copper_mm:.2}cu-") };
        for mas in series.levels_mas.iter().copied().rev() {
            for frame in 0..series.frames {
                let object = if beads > 0 { bead } else { Object::Nothing };
                beads = beads.saturating_sub(1);
                put(format!("air-{kvp:.0}kvp-{copper}{mas:.2}mas-{:02}.dcm", frame + 1), Beam { mas, ..beam }, object)?;
            }
        }
    }
    let first = series.beams().next().unwrap_or(Beam { mas: 0.0, kvp: 90.0, copper_mm: 0.0 });
    if series.edge {
        let most = series.levels_mas.iter().copied().fold(0.0, f64::max);
        put("edge.dcm".to_owned(), Beam { mas: most, ..first }, Object::Edge(3.0))?;
    }
    if series.wedge {
        let level = series.levels_mas.len() / 2;
        put("wedge.dcm".to_owned(), Beam { mas: series.levels_mas[level], ..first }, Object::Wedge)?;
    }
    let path = folder.join("truth.json");
    std::fs::write(&path, format!("{:#}\n", truth(panel, &made, series))).map_err(MockError::io(path.display()))
}

/// Medians over the panel: quanta and photons per mAs, stored value per mAs, stored value per quantum.
fn truth(panel: &Panel, made: &Made, series: &Series) -> Value {
    let [columns, rows] = panel.size_px;
    let [mean_kev, quantum] = panel.quantum();
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let beams: Vec<Value> = series
        .beams()
        .map(|beam| {
            let photons: Vec<f64> = (0..columns).map(|column| panel.quanta(column, &beam)).collect();
            let values = (0..columns * rows).map(|at| panel.gain * made.gain[at] * mean_kev * photons[at % columns]).collect();
            let photons_per_mas = median(photons);
            json!({
                "tube_kvp": beam.kvp, "copper_mm": beam.copper_mm, "photons_per_pixel_per_mas": photons_per_mas,
                "quanta_per_pixel_per_mas": photons_per_mas * mean_kev / quantum, "air_value_per_mas": median(values)
            })
        })
        .collect();
    json!({
        "gain_value_per_quantum": panel.gain * quantum, "gain": panel.gain, "offset_value": panel.offset, "heel_share": panel.heel,
        "readout_sigma_value": (panel.readout_sigma * panel.readout_sigma + 1.0 / 12.0).sqrt(), "beams": beams,
        "dead": made.broken[0], "hot": made.broken[1], "unstable": made.broken[2]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const FOUR_MAS: Beam = Beam { mas: 4.0, kvp: 90.0, copper_mm: 0.0 };

    #[test]
    fn variance_and_mean_are_what_the_panel_says() {
        let plain = Panel { pattern_sigma: 0.0, offset_sigma: 0.0, heel: 0.0, output_sigma: 0.0, ..Panel::default() };
        for (panel, unit) in
            [(plain.clone(), 1.0), (Panel { response: Response::Energy, gain: 0.037, quanta_per_mas: 200.0, ..plain }, 65.0)]
        {
            let values = panel.make().frame(1, &FOUR_MAS, Object::Nothing);
            let n = values.len() as f64;
            let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / n - panel.offset;
            let variance = values.iter().map(|v| (f64::from(*v) - panel.offset - mean).powi(2)).sum::<f64>() / n;
            assert!((panel.quantum()[1] - unit).abs() < 1e-9, "⟨E²⟩/⟨E⟩ of 30 to 90 keV is 65 keV");
            let per_quantum = (variance - panel.readout_sigma.powi(2)) / mean;
            assert!((per_quantum / (panel.gain * unit) - 1.0).abs() < 0.03, "{per_quantum}");
        }
    }

    #[test]
    fn broken_pixels_are_as_many_as_asked() {
        let made = Panel { broken: 5, ..Panel::default() }.make();
        let frame = made.frame(1, &FOUR_MAS, Object::Nothing);
        assert!(made.broken.iter().all(|kind| kind.len() == 5));
        assert!(made.broken[0].iter().all(|&at| frame[at] < 260), "dead pixels stay at the offset");
    }
}
