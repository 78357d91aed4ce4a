//! X-ray spectra: tungsten anodes at 40–140 kV, single energies, files; filtration by any material.

use std::sync::LazyLock;

use super::{Material, PhysicsError};

/// Tube voltages of the tables.
pub const KVP_RANGE: (f64, f64) = (40.0, 140.0);

/// Anode angles of the tables, first and last.
pub const ANODE_ANGLES_DEG: (f64, f64) = (6.0, 20.0);

/// Energy bins below this carry nothing through any real tube's window and are left out of tungsten spectra.
const LOWEST_KEV: f64 = 5.0;

/// Photons in one energy bin.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Bin {
    /// Centre of the bin.
    pub energy_kev: f64,
    /// Photons in the bin, in any unit common to all bins.
    pub fluence: f64,
}

/// Photons by energy, energies ascending.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Spectrum {
    /// At least one bin; fluences finite and ≥ 0, their sum > 0.
    pub bins: Vec<Bin>,
}

/// Anode output at one voltage and angle, integrated over half-keV bins.
struct Tabulated {
    kvp: f64,
    angle_deg: f64,
    first_edge_kev: f64,
    bin_kev: f64,
    /// Photons below each bin edge, the first edge included: one value more than bins.
    below_edge: Vec<f64>,
}

impl Tabulated {
    /// From fluences per keV of bins whose first centre is `first_kev`.
    fn new([kvp, angle_deg, first_kev, bin_kev]: [f64; 4], fluence_per_kev: &[f64]) -> Self {
        let mut below_edge = Vec::with_capacity(fluence_per_kev.len() + 1);
        let mut sum = 0.0;
        below_edge.push(sum);
        for fluence in fluence_per_kev {
            sum += fluence * bin_kev;
            below_edge.push(sum);
        }
        Self { kvp, angle_deg, first_edge_kev: first_kev - 0.5 * bin_kev, bin_kev, below_edge }
    }

    /// Photons below `energy_kev`, spread evenly within each bin.
    fn below(&self, energy_kev: f64) -> f64 {
        let bins = self.below_edge.len() - 1;
        let position = ((energy_kev - self.first_edge_kev) / self.bin_kev).clamp(0.0, bins as f64);
        let index = (position as usize).min(bins - 1);
        let (low, high) = (self.below_edge[index], self.below_edge[index + 1]);
        low + (high - low) * (position - index as f64)
    }

    /// Photons between two energies. Integrals, unlike values at bin centres, keep each characteristic line whole and in its bin.
    fn between(&self, from_kev: f64, to_kev: f64) -> f64 {
        self.below(to_kev) - self.below(from_kev)
    }
}

static TABLE: LazyLock<Vec<Tabulated>> = LazyLock::new(|| {
    let parse = |line: &str| {
        let n: Vec<f64> = line.split(',').map(str::parse).collect::<Result<_, _>>().ok()?;
        let [kvp, angle_deg, first_kev, bin_kev, fluence_per_kev @ ..] = n.as_slice() else { return None };
        (!fluence_per_kev.is_empty()).then(|| Tabulated::new([*kvp, *angle_deg, *first_kev, *bin_kev], fluence_per_kev))
    };
    include_str!("../../../calibration/spectra/tungsten.csv").lines().filter_map(parse).collect()
});

/// Mass energy-absorption coefficient of air: (ln keV, ln cm²/g).
static AIR_KERMA: LazyLock<Vec<(f64, f64)>> = LazyLock::new(|| {
    let row = |line: &str| {
        let (energy, value) = line.split_once(',')?;
        Some((energy.parse::<f64>().ok()?.ln(), value.parse::<f64>().ok()?.ln()))
    };
    include_str!("../../../calibration/materials/air-kerma.csv").lines().filter_map(row).collect()
});

/// The two tabulated values around `wanted` and the weight of the upper one.
fn bracket(wanted: f64, mut values: Vec<f64>) -> (f64, f64, f64) {
    values.sort_by(f64::total_cmp);
    values.dedup();
    let above = values.partition_point(|value| *value < wanted).clamp(1, values.len() - 1);
    let (low, high) = (values[above - 1], values[above]);
    (low, high, ((wanted - low) / (high - low)).clamp(0.0, 1.0))
}

impl Spectrum {
    /// A tungsten anode's spectrum behind `filtration` (material and mm), in 1-keV bins up to the tube voltage, Σφ = 1.
    ///
    /// # Errors
    /// When voltage, angle or a thickness is outside its range, or nothing passes.
    pub fn tungsten(kvp: f64, anode_angle_deg: f64, filtration: &[(Material, f64)]) -> Result<Self, PhysicsError> {
        Self::tungsten_output(kvp, anode_angle_deg, filtration)?.normalised()
    }

    /// As [`Spectrum::tungsten`], but in photons per bin, per cm² and mAs at 1 m from the focal spot, without air on the way.
    ///
    /// # Errors
    /// As [`Spectrum::tungsten`].
    pub fn tungsten_output(kvp: f64, anode_angle_deg: f64, filtration: &[(Material, f64)]) -> Result<Self, PhysicsError> {
        let (from_kvp, to_kvp) = KVP_RANGE;
        if !(kvp >= from_kvp && kvp <= to_kvp) {
            return Err(PhysicsError::TubeVoltage { kvp, from_kvp, to_kvp });
        }
        let (from_deg, to_deg) = ANODE_ANGLES_DEG;
        if !(anode_angle_deg >= from_deg && anode_angle_deg <= to_deg) {
            return Err(PhysicsError::AnodeAngle { angle_deg: anode_angle_deg, from_deg, to_deg });
        }
        let (kvp_low, kvp_high, kvp_weight) = bracket(kvp, TABLE.iter().map(|t| t.kvp).collect());
        let (angle_low, angle_high, angle_weight) = bracket(anode_angle_deg, TABLE.iter().map(|t| t.angle_deg).collect());
        let find = |kvp: f64, angle: f64| TABLE.iter().find(|t| t.kvp == kvp && t.angle_deg == angle);
        let corners = [
            (find(kvp_low, angle_low), (1.0 - kvp_weight) * (1.0 - angle_weight)),
            (find(kvp_high, angle_low), kvp_weight * (1.0 - angle_weight)),
            (find(kvp_low, angle_high), (1.0 - kvp_weight) * angle_weight),
            (find(kvp_high, angle_high), kvp_weight * angle_weight),
        ];
        // The continuum ends at the tube voltage, so near its end neighbours are blended at equal fractions of their own voltage;
        // the characteristic lines (57.4 to 70 keV, above the K edge at 69.5) stand at fixed energies, so there, and far below the
        // end, they are blended at equal energies.
        let photons = |from_kev: f64, to_kev: f64| {
            let middle_kev = 0.5 * (from_kev + to_kev);
            let lines = (57.0..70.5).contains(&middle_kev) && kvp > 70.0;
            let blend = if lines { 0.0 } else { ((middle_kev / kvp - 0.75) / 0.15).clamp(0.0, 1.0) };
            let one = |table: &Tabulated| {
                let scale = table.kvp / kvp;
                (1.0 - blend) * table.between(from_kev, to_kev) + blend * table.between(from_kev * scale, to_kev * scale)
            };
            corners.iter().filter_map(|(table, weight)| table.map(|table| weight * one(table))).sum::<f64>()
        };
        let mut bins = Vec::new();
        let mut edge_kev = LOWEST_KEV;
        while edge_kev < kvp - 1e-9 {
            let width_kev = (kvp - edge_kev).min(1.0);
            let parts = 4;
            let part_kev = width_kev / f64::from(parts);
            let part = |i: i32| edge_kev + f64::from(i) * part_kev;
            let fluence: f64 = (0..parts).map(|i| photons(part(i), part(i + 1))).sum();
            bins.push(Bin { energy_kev: edge_kev + 0.5 * width_kev, fluence });
            edge_kev += width_kev;
        }
        let behind = Self { bins }.filtered(filtration)?;
        // Normalising refuses what lets nothing pass.
        behind.normalised()?;
        Ok(behind)
    }

    /// One energy.
    ///
    /// # Errors
    /// When the energy is outside the attenuation tables.
    pub fn mono(energy_kev: f64) -> Result<Self, PhysicsError> {
        super::element_attenuation(1, energy_kev)?;
        Ok(Self { bins: vec![Bin { energy_kev, fluence: 1.0 }] })
    }

    /// Behind `filtration`: each bin times exp(−Σ μ t).
    ///
    /// # Errors
    /// When a thickness is negative or not finite, or a material has no density.
    pub fn filtered(&self, filtration: &[(Material, f64)]) -> Result<Self, PhysicsError> {
        let mut bins = self.bins.clone();
        for (material, thickness_mm) in filtration {
            if !(*thickness_mm >= 0.0 && thickness_mm.is_finite()) {
                return Err(PhysicsError::Filter { material: material.name.clone(), thickness_mm: *thickness_mm });
            }
            let area_density = material.nominal_density_g_per_cm3()? * thickness_mm * 0.1;
            for bin in &mut bins {
                bin.fluence *= (-material.attenuation(bin.energy_kev)?.total_cm2_per_g * area_density).exp();
            }
        }
        Ok(Self { bins })
    }

    /// Scaled to Σφ = 1; bins without photons at either end are dropped.
    ///
    /// # Errors
    /// When there are no photons.
    pub fn normalised(&self) -> Result<Self, PhysicsError> {
        let sum: f64 = self.bins.iter().map(|bin| bin.fluence).sum();
        if !(sum > 0.0 && sum.is_finite()) {
            return Err(PhysicsError::Empty);
        }
        let first = self.bins.iter().position(|bin| bin.fluence > 0.0).unwrap_or(0);
        let last = self.bins.iter().rposition(|bin| bin.fluence > 0.0).unwrap_or(0);
        let scale = |bin: &Bin| Bin { energy_kev: bin.energy_kev, fluence: bin.fluence / sum };
        Ok(Self { bins: self.bins[first..=last].iter().map(scale).collect() })
    }

    /// Mean photon energy.
    #[must_use]
    pub fn mean_kev(&self) -> f64 {
        let sum: f64 = self.bins.iter().map(|bin| bin.fluence).sum();
        self.bins.iter().map(|bin| bin.fluence * bin.energy_kev).sum::<f64>() / sum
    }

    /// First half-value layer by air kerma, mm of aluminium.
    ///
    /// # Errors
    /// Never for a spectrum within the tables.
    pub fn hvl1_mm_al(&self) -> Result<f64, PhysicsError> {
        self.layer_mm_al(0.5)
    }

    /// Second half-value layer by air kerma: from a half to a quarter, mm of aluminium.
    ///
    /// # Errors
    /// Never for a spectrum within the tables.
    pub fn hvl2_mm_al(&self) -> Result<f64, PhysicsError> {
        Ok(self.layer_mm_al(0.25)? - self.layer_mm_al(0.5)?)
    }

    /// Aluminium that lets `share` of the air kerma pass.
    fn layer_mm_al(&self, share: f64) -> Result<f64, PhysicsError> {
        let aluminium = Material::parse("aluminium")?;
        let density = aluminium.nominal_density_g_per_cm3()?;
        let mut terms = Vec::with_capacity(self.bins.len());
        for bin in &self.bins {
            let mu_per_mm = aluminium.attenuation(bin.energy_kev)?.total_cm2_per_g * density * 0.1;
            terms.push((bin.fluence * bin.energy_kev * mu_en_air(bin.energy_kev), mu_per_mm));
        }
        let kerma = |mm: f64| terms.iter().map(|(weight, mu)| weight * (-mu * mm).exp()).sum::<f64>();
        let wanted = share * kerma(0.0);
        let (mut low, mut high) = (0.0, 1.0);
        while kerma(high) > wanted && high < 1e4 {
            high *= 2.0;
        }
        for _ in 0..80 {
            let middle = 0.5 * (low + high);
            if kerma(middle) > wanted { low = middle } else { high = middle }
        }
        Ok(0.5 * (low + high))
    }
}

/// Mass energy-absorption of air, log–log interpolated.
fn mu_en_air(energy_kev: f64) -> f64 {
    let x = energy_kev.ln();
    let above = AIR_KERMA.partition_point(|(e, _)| *e < x).clamp(1, AIR_KERMA.len() - 1);
    let ((x0, y0), (x1, y1)) = (AIR_KERMA[above - 1], AIR_KERMA[above]);
    (y0 + (y1 - y0) * (x - x0) / (x1 - x0)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn aluminium(mm: f64) -> Vec<(Material, f64)> {
        vec![(Material::parse("aluminium").expect("known"), mm)]
    }

    /// SpekPy 2.5, 12 degrees, 4.3 mm Al: HVL₁ in mm Al and mean energy in keV.
    #[test]
    fn tungsten_spectra_agree_with_spekpy() {
        let mut cases = 0;
        for (kvp, hvl, mean) in [
            (40.0, 1.81, 29.9),
            (60.0, 2.80, 38.4),
            (80.0, 3.69, 45.8),
            (100.0, 4.60, 52.2),
            (120.0, 5.49, 57.5),
            (140.0, 6.32, 62.2),
        ] {
            let spectrum = Spectrum::tungsten(kvp, 12.0, &aluminium(4.3)).expect("inside");
            let (found_hvl, found_mean) = (spectrum.hvl1_mm_al().expect("inside"), spectrum.mean_kev());
            assert!((found_hvl / hvl - 1.0).abs() < 0.01, "{kvp} kV: HVL {found_hvl}, SpekPy {hvl}");
            assert!((found_mean / mean - 1.0).abs() < 0.01, "{kvp} kV: mean {found_mean}, SpekPy {mean}");
            let unfiltered = Spectrum::tungsten(kvp, 12.0, &aluminium(4.0)).expect("inside");
            assert!((unfiltered.hvl1_mm_al().expect("inside") / hvl - 1.0).abs() > 0.01, "control: 0.3 mm Al less is seen");
            cases += 1;
        }
        assert_eq!(cases, 6);
    }

    /// Every voltage and angle here lies between those of the tables; SpekPy itself was asked, with its default attenuation data.
    #[test]
    fn spectra_between_the_tables_agree_with_spekpy() {
        let mut cases = 0;
        for line in
            include_str!("../../../tests/data/spekpy-off-grid.csv").lines().filter(|line| line.starts_with(char::is_numeric))
        {
            let cells: Vec<f64> = line.split(',').filter_map(|cell| cell.parse().ok()).collect();
            let [kvp, angle_deg, aluminium_mm, copper_mm, mean, hvl1, hvl2] = cells[..] else { panic!("row '{line}'") };
            let filters = [("aluminium", aluminium_mm), ("copper", copper_mm)]
                .map(|(name, mm)| (Material::parse(name).expect("known"), mm));
            let spectrum = Spectrum::tungsten(kvp, angle_deg, &filters).expect("inside");
            let hvl = [spectrum.hvl1_mm_al().expect("inside"), spectrum.hvl2_mm_al().expect("inside")];
            assert!((spectrum.mean_kev() / mean - 1.0).abs() < 0.0025, "{line}: mean {}", spectrum.mean_kev());
            assert!((hvl[0] / hvl1 - 1.0).abs() < 0.005 && (hvl[1] / hvl2 - 1.0).abs() < 0.005, "{line}: HVL {hvl:?}");
            let other = Spectrum::tungsten(kvp - 1.0, angle_deg, &filters).expect("inside").hvl1_mm_al().expect("inside");
            assert!((other / hvl1 - 1.0).abs() > 0.002, "{line}: control, 1 kV less is seen: {other}");
            cases += 1;
        }
        assert_eq!(cases, 60);
    }

    /// Interpolating between half-keV bin centres once moved an eighth of each line into the neighbouring bin: 1 % of all photons at 133 kV.
    #[test]
    fn characteristic_lines_stay_in_their_bins() {
        let spectrum = Spectrum::tungsten(120.0, 12.0, &[]).expect("inside");
        let share = |kev: f64| spectrum.bins.iter().find(|bin| bin.energy_kev == kev).expect("a bin").fluence;
        // SpekPy's half-keV bins of the unfiltered output, photons per keV at 120 kV and 12 degrees.
        assert!((share(57.5) / share(58.5) / ((6.083_09 + 27.185_17) / (5.904_24 + 5.816_52)) - 1.0).abs() < 1e-3);
        assert!((share(59.5) / share(60.5) / ((43.223_95 + 5.644_42) / (5.560_48 + 5.477_48)) - 1.0).abs() < 1e-3);
    }

    /// TG-195 case 1: 2.273 mm Al at 30 keV.
    #[test]
    fn one_energy_has_its_exponential_half_value_layer() {
        let hvl = Spectrum::mono(30.0).expect("inside").hvl1_mm_al().expect("inside");
        assert!((hvl / 2.273 - 1.0).abs() < 3e-3, "{hvl}");
        let hvl = Spectrum::mono(100.0).expect("inside").hvl1_mm_al().expect("inside");
        assert!((hvl / 15.11 - 1.0).abs() < 3e-3, "{hvl}");
    }

    #[test]
    fn what_is_outside_is_refused() {
        assert!(matches!(Spectrum::tungsten(500.0, 12.0, &[]), Err(PhysicsError::TubeVoltage { .. })));
        assert!(matches!(Spectrum::tungsten(f64::NAN, 12.0, &[]), Err(PhysicsError::TubeVoltage { .. })));
        assert!(matches!(Spectrum::tungsten(80.0, 1.0, &[]), Err(PhysicsError::AnodeAngle { .. })));
        assert!(matches!(Spectrum::tungsten(80.0, 12.0, &aluminium(-1.0)), Err(PhysicsError::Filter { .. })));
        assert!(Spectrum::mono(0.0).is_err());
    }
}
