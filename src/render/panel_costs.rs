//! What beam shape, noise and panel cost: all that comes between attenuation and the page, which the processor does for either executor.

use serde::{Deserialize, Serialize};

/// Nanoseconds of one core, by pixel where nothing else is said. Of a stage that runs on one core of several, as many times more.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PanelCosts {
    /// N₀(u) with the whole panel open.
    pub flood_ns: f64,
    /// The same where the field is a circle, a rectangle, or for each corner of a polygon; and what it leaves of the line integral.
    pub field_ns: [f64; 3],
    /// A line integral that is blurred as an intensity.
    pub blurred_ns: f64,
    /// A weight of a blur's kernel, along a row and along a column.
    pub weight_ns: [f64; 2],
    /// Scatter that is known, added.
    pub scatter_ns: f64,
    /// An intensifier's raster: of the line integral alone, and with what noise needs.
    pub distorted_ns: [f64; 2],
    /// A Poisson deviate.
    pub drawn_ns: f64,
    /// What it is as noise of the intensity.
    pub quanta_ns: f64,
    /// A weight of the crosstalk.
    pub crosstalk_ns: f64,
    /// Readout noise.
    pub readout_ns: f64,
    /// Veiling glare, but for its spread.
    pub veiled_ns: f64,
    /// Two blocks between which the glare is spread, not a pixel.
    pub block_pair_ns: f64,
    /// The page: of a line integral without noise, and of anything else.
    pub page_ns: [f64; 2],
}

impl Default for PanelCosts {
    /// Of one 4 GHz core.
    fn default() -> Self {
        Self {
            flood_ns: 10.0,
            field_ns: [40.0, 120.0, 20.0],
            blurred_ns: 30.0,
            weight_ns: [1.5, 0.7],
            scatter_ns: 150.0,
            distorted_ns: [300.0, 400.0],
            drawn_ns: 60.0,
            quanta_ns: 15.0,
            crosstalk_ns: 12.0,
            readout_ns: 50.0,
            veiled_ns: 80.0,
            block_pair_ns: 2.0,
            page_ns: [2.0, 20.0],
        }
    }
}

/// What a scene asks of them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PanelWork {
    /// Pixels of the image.
    pub pixels: f64,
    /// Whether N₀(u) is wanted of a panel that is open throughout, and that neither heel nor bow-tie shade.
    pub flood: bool,
    /// 1 where the field is a circle, 1 where it is a rectangle, the corners where it is a polygon.
    pub field: [f64; 3],
    /// Line integrals that are blurred.
    pub blurred: f64,
    /// Weights of the kernels of all that is blurred, along rows and along columns.
    pub weights: [f64; 2],
    /// Whether scatter is added.
    pub scatter: bool,
    /// Whether there is an intensifier.
    pub distorted: bool,
    /// Whether there is noise.
    pub noise: bool,
    /// Whether the processor draws it.
    pub drawn: bool,
    /// Weights of the crosstalk.
    pub crosstalk: f64,
    /// Whether there is readout noise.
    pub readout: bool,
    /// Pairs of blocks between which glare is spread; 0 without any.
    pub block_pairs: f64,
    /// Whether the page is a line integral without noise.
    pub plain_page: bool,
}

impl PanelCosts {
    /// Nanoseconds of one core for a pixel of `work`.
    #[must_use]
    pub fn pixel_ns(&self, work: &PanelWork) -> f64 {
        let where_so = |is_so: bool, ns: f64| if is_so { ns } else { 0.0 };
        let sum = |counts: &[f64], ns: &[f64]| counts.iter().zip(ns).map(|(count, ns)| count * ns).sum::<f64>();
        let beam = where_so(work.flood, self.flood_ns)
            + sum(&work.field, &self.field_ns)
            + self.blurred_ns * work.blurred
            + sum(&work.weights, &self.weight_ns)
            + where_so(work.scatter, self.scatter_ns)
            + where_so(work.distorted, self.distorted_ns[usize::from(work.noise)]);
        let noise = where_so(work.drawn, self.drawn_ns)
            + where_so(work.noise, self.quanta_ns)
            + self.crosstalk_ns * work.crosstalk
            + where_so(work.readout, self.readout_ns);
        let page = where_so(work.block_pairs > 0.0, self.veiled_ns) + self.page_ns[usize::from(!work.plain_page)];
        beam + noise + page
    }

    pub(super) fn all_mut(&mut self) -> impl Iterator<Item = &mut f64> {
        let single = [
            &mut self.flood_ns,
            &mut self.blurred_ns,
            &mut self.scatter_ns,
            &mut self.drawn_ns,
            &mut self.quanta_ns,
            &mut self.crosstalk_ns,
            &mut self.readout_ns,
            &mut self.veiled_ns,
            &mut self.block_pair_ns,
        ];
        let several = self.field_ns.iter_mut().chain(&mut self.weight_ns).chain(&mut self.distorted_ns).chain(&mut self.page_ns);
        single.into_iter().chain(several)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every cost counts: with another one free, the same work is cheaper by what it was, and by nothing else.
    #[test]
    fn each_stage_costs_what_was_measured_of_it() {
        let costs = PanelCosts::default();
        let all = PanelWork {
            pixels: 1.0,
            flood: true,
            field: [1.0, 1.0, 5.0],
            blurred: 2.0,
            weights: [9.0, 11.0],
            scatter: true,
            distorted: true,
            noise: true,
            drawn: true,
            crosstalk: 9.0,
            readout: true,
            block_pairs: 1.0,
            plain_page: false,
        };
        let whole_ns = costs.pixel_ns(&all);
        let count = costs.clone().all_mut().count();
        let mut counted = 0;
        for free in 0..count {
            let mut cheaper = costs.clone();
            let saved_ns = cheaper.all_mut().nth(free).map(|ns| std::mem::replace(ns, 0.0)).expect("one of them");
            let found_ns = whole_ns - cheaper.pixel_ns(&all);
            assert!(found_ns == 0.0 || found_ns > 0.99 * saved_ns, "{free}: {found_ns} of {saved_ns} ns");
            counted += usize::from(found_ns > 0.0);
        }
        // All but the intensifier's raster without noise, the page without noise, and the spread, which is by block.
        assert_eq!((count, counted), (18, 15));
        let quiet = PanelWork { noise: false, plain_page: true, ..all };
        assert!(costs.pixel_ns(&quiet) < whole_ns);
        assert_eq!(costs.pixel_ns(&PanelWork { plain_page: true, ..PanelWork::default() }), costs.page_ns[0]);
    }
}
