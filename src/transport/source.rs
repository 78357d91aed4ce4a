//! Where photons start: the focal spot, evenly over the solid angle of the field, with the energies of the spectrum.
//!
//! Without `beam.field` the field is the image. Heel and bow-tie are carried as a weight: the share of a photon's energy that they leave in
//! its direction, against the principal ray without bow-tie.

use glam::{DVec2, DVec3};

use super::alias::Alias;
use super::beam_shape::Left;
use super::error::TransportError;
use super::panel::Panel;
use super::stream::Stream;
use crate::scene::model::Scene;
use crate::scene::optics::Field;

/// Points along each side of the field's bounds by which its solid angle is summed, where there is no closed form.
const SOLID_ANGLE_POINTS: usize = 2048;

/// Points along each side of a pixel by which what arrives in it is averaged.
const PIXEL_POINTS: usize = 4;

/// FWHM of a Gaussian in standard deviations: 2√(2 ln 2).
const FWHM_PER_SIGMA: f64 = 2.354_820_045;

/// A photon that has just started.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Start {
    /// Where, lps mm.
    pub position: DVec3,
    /// Unit vector.
    pub direction: DVec3,
    /// Distance to the detector plane along it.
    pub path_mm: f64,
    /// Where it would meet the plane, mm from the principal point.
    pub on_plane_mm: DVec2,
    /// Its energy.
    pub energy_kev: f64,
    /// Share that heel and bow-tie leave.
    pub weight: f64,
}

/// Energies of a spectrum put together.
#[derive(Clone, Debug)]
pub struct Groups {
    /// Mean by group, weighed by signal.
    pub energies_kev: Vec<f64>,
    of_bin: Vec<usize>,
    /// By bin, its share of the signal.
    of_signal: Vec<f64>,
}

/// The beam.
pub struct Source {
    pub(super) field: Option<Field>,
    /// Bounds of the field on the plane, mm from the principal point.
    pub(super) low_mm: DVec2,
    pub(super) high_mm: DVec2,
    pub(super) sigma_mm: DVec2,
    pub(super) energies_kev: Vec<f64>,
    fractions: Vec<f64>,
    pub(super) energies: Alias,
    pub(super) left: Left,
    /// ∫ (SDD/d)³ over the open field, mm².
    open_mm2: f64,
}

impl Source {
    /// The beam of `scene` onto `panel`.
    ///
    /// # Errors
    /// When it has no photons, or its field is empty.
    pub fn new(scene: &Scene, panel: &Panel) -> Result<Self, TransportError> {
        let bins: Vec<_> = scene.beam.spectrum.bins.iter().filter(|bin| bin.fluence > 0.0).collect();
        let total: f64 = bins.iter().map(|bin| bin.fluence).sum();
        if !(total > 0.0 && total.is_finite()) {
            return Err(TransportError::NoPhotons);
        }
        let energies_kev: Vec<f64> = bins.iter().map(|bin| bin.energy_kev).collect();
        let fractions: Vec<f64> = bins.iter().map(|bin| bin.fluence / total).collect();
        let shape = &scene.beam.shape;
        let (low_mm, high_mm) = match &shape.field {
            Some(field) => bounds_of(field),
            None => {
                let corners = [DVec2::ZERO, DVec2::X, DVec2::Y, DVec2::ONE].map(|share| panel.at_share(share));
                corners.iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), c| (low.min(*c), high.max(*c)))
            }
        };
        let left = Left::new(shape, &energies_kev)?;
        let sigma_mm = DVec2::from_array(shape.focal_spot_mm) / FWHM_PER_SIGMA;
        let energies = Alias::new(&fractions);
        let mut source = Self {
            field: shape.field.clone(),
            low_mm,
            high_mm,
            sigma_mm,
            energies_kev,
            fractions,
            energies,
            left,
            open_mm2: 0.0,
        };
        source.open_mm2 = source.open_area(panel);
        if !(source.open_mm2 > 0.0) {
            return Err(TransportError::NoField);
        }
        Ok(source)
    }

    fn is_open(&self, on_plane_mm: DVec2, panel: &Panel) -> bool {
        match &self.field {
            Some(field) => field.contains(on_plane_mm),
            None => panel.pixel(on_plane_mm).is_some(),
        }
    }

    /// ∫ (SDD/d)³ dA over the field: its solid angle times SDD².
    fn open_area(&self, panel: &Panel) -> f64 {
        let sdd = panel.distance_mm;
        let is_plain = match &self.field {
            Some(Field::Rectangle { rotation_deg, .. }) => *rotation_deg == 0.0,
            Some(_) => false,
            // Columns and rows at right angles.
            None => panel.at_share(DVec2::Y).x == panel.at_share(DVec2::ZERO).x,
        };
        if is_plain {
            // Solid angle between the principal point and (x, y): atan(x y/(SDD · d)).
            let corner = |x: f64, y: f64| (x * y / (sdd * (sdd * sdd + x * x + y * y).sqrt())).atan();
            let (a, b) = (self.low_mm, self.high_mm);
            return sdd * sdd * (corner(b.x, b.y) - corner(a.x, b.y) - corner(b.x, a.y) + corner(a.x, a.y));
        }
        let step = (self.high_mm - self.low_mm) / SOLID_ANGLE_POINTS as f64;
        let row = |j: usize| {
            let points = (0..SOLID_ANGLE_POINTS).map(|i| self.low_mm + step * (DVec2::new(i as f64, j as f64) + 0.5));
            points.filter(|point| self.is_open(*point, panel)).map(|point| obliquity(point, sdd)).sum::<f64>()
        };
        step.x * step.y * (0..SOLID_ANGLE_POINTS).map(row).sum::<f64>()
    }

    /// Opening of the collimator on the plane, by solid angle: ∫ (SDD/d)³ over it.
    #[must_use]
    pub fn open_mm2(&self) -> f64 {
        self.open_mm2
    }

    /// Photons that one history brings on average to a mm² of the plane on the principal ray, were the collimator open there.
    #[must_use]
    pub fn on_principal_ray_per_mm2(&self) -> f64 {
        let left: f64 = if self.left.is_everything() {
            1.0
        } else {
            self.fractions.iter().enumerate().map(|(bin, fraction)| fraction * self.left.share(bin, DVec3::Z)).sum()
        };
        left / self.open_mm2
    }

    /// Mean energy of the photons on the principal ray.
    #[must_use]
    pub fn mean_kev(&self) -> f64 {
        self.energies_kev.iter().zip(&self.fractions).map(|(energy_kev, fraction)| energy_kev * fraction).sum()
    }

    /// Share of the photons that collimator, heel and bow-tie leave in the direction of a point of the plane.
    #[must_use]
    pub fn open_share(&self, panel: &Panel, on_plane_mm: DVec2) -> f64 {
        if !self.is_open(on_plane_mm, panel) {
            return 0.0;
        }
        if self.left.is_everything() {
            return 1.0;
        }
        let ray = on_plane_mm.extend(panel.distance_mm);
        self.fractions.iter().enumerate().map(|(bin, fraction)| fraction * self.left.share(bin, ray)).sum()
    }

    /// The spectrum on the principal ray in `count` groups at most: neighbours of about as much signal are put together.
    #[must_use]
    pub fn grouped(&self, panel: &Panel, count: usize) -> Groups {
        let signal: Vec<f64> = self.energies_kev.iter().zip(&self.fractions).map(|(kev, n)| n * panel.response(*kev)).collect();
        let all: f64 = signal.iter().sum();
        let mut groups = Groups { energies_kev: vec![0.0; count], of_bin: Vec::new(), of_signal: Vec::new() };
        let (mut shares, mut sum) = (vec![0.0; count], 0.0);
        for (energy_kev, signal) in self.energies_kev.iter().zip(&signal) {
            let group = (((sum + 0.5 * signal) / all * count as f64) as usize).min(count - 1);
            sum += signal;
            shares[group] += signal;
            groups.energies_kev[group] += energy_kev * signal;
            groups.of_bin.push(group);
            groups.of_signal.push(signal / all);
        }
        // A group without bins has no signal at any energy.
        for (energy_kev, share) in groups.energies_kev.iter_mut().zip(shares) {
            *energy_kev = if share > 0.0 { *energy_kev / share } else { self.energies_kev[0] };
        }
        groups
    }

    /// Signal by group in the direction of a point of the open plane, as a share of all of it without heel and bow-tie.
    #[must_use]
    pub fn shares(&self, groups: &Groups, panel: &Panel, on_plane_mm: DVec2) -> Vec<f64> {
        let (ray, mut shares) = (on_plane_mm.extend(panel.distance_mm), vec![0.0; groups.energies_kev.len()]);
        for (bin, (group, signal)) in groups.of_bin.iter().zip(&groups.of_signal).enumerate() {
            shares[*group] += signal * if self.left.is_everything() { 1.0 } else { self.left.share(bin, ray) };
        }
        shares
    }

    /// Starts a photon.
    #[inline]
    pub fn start(&self, panel: &Panel, stream: &mut Stream) -> Start {
        let on_plane_mm = loop {
            let share = DVec2::new(stream.uniform(), stream.uniform());
            let point = self.low_mm + (self.high_mm - self.low_mm) * share;
            // Even over the solid angle: fewer per area where the plane is farther and oblique.
            if self.is_open(point, panel) && stream.uniform() < obliquity(point, panel.distance_mm) {
                break point;
            }
        };
        let bin = self.energies.draw(stream);
        let mut position = panel.source;
        if self.sigma_mm != DVec2::ZERO {
            let offset = self.sigma_mm * stream.normals();
            position += panel.axes[0] * offset.x + panel.axes[1] * offset.y;
        }
        let way = panel.in_lps(on_plane_mm) - position;
        let path_mm = way.length();
        let weight = self.left.share(bin, on_plane_mm.extend(panel.distance_mm));
        Start { position, direction: way / path_mm, path_mm, on_plane_mm, energy_kev: self.energies_kev[bin], weight }
    }

    /// What one history adds on average to each pixel with nothing in the beam, were all of the panel open.
    #[must_use]
    pub fn unattenuated(&self, panel: &Panel) -> Vec<f64> {
        self.flood(panel, true)
    }

    /// The same without heel and bow-tie: nowhere 0, and as smooth as the distance.
    #[must_use]
    pub fn unshaped(&self, panel: &Panel) -> Vec<f64> {
        self.flood(panel, false)
    }

    fn flood(&self, panel: &Panel, shaped: bool) -> Vec<f64> {
        let responses: Vec<f64> = self.energies_kev.iter().map(|energy_kev| panel.response(*energy_kev)).collect();
        let plain: f64 = responses.iter().zip(&self.fractions).map(|(response, fraction)| response * fraction).sum();
        let signal = |point: DVec2| {
            let ray = point.extend(panel.distance_mm);
            let mean = if !shaped || self.left.is_everything() {
                plain
            } else {
                let bins = responses.iter().zip(&self.fractions).enumerate();
                bins.map(|(bin, (response, fraction))| response * fraction * self.left.share(bin, ray)).sum()
            };
            obliquity(point, panel.distance_mm) * mean
        };
        let [columns, rows] = panel.grid_px;
        let points = PIXEL_POINTS * PIXEL_POINTS;
        let pixel = |index: usize| {
            let corner = DVec2::new((index % columns) as f64, (index / columns) as f64);
            let point = |n: usize| {
                let inner = DVec2::new((n % PIXEL_POINTS) as f64, (n / PIXEL_POINTS) as f64) + 0.5;
                panel.at_share((corner + inner / PIXEL_POINTS as f64) / DVec2::new(columns as f64, rows as f64))
            };
            (0..points).map(|n| signal(point(n))).sum::<f64>() / points as f64
        };
        let scale = panel.pixel_area_mm2() / self.open_mm2;
        (0..panel.pixels()).map(|index| scale * pixel(index)).collect()
    }
}

/// (SDD/d)³ at a point of the plane.
#[inline]
fn obliquity(on_plane_mm: DVec2, sdd_mm: f64) -> f64 {
    let squared = sdd_mm * sdd_mm / (sdd_mm * sdd_mm + on_plane_mm.length_squared());
    squared * squared.sqrt()
}

fn bounds_of(field: &Field) -> (DVec2, DVec2) {
    match field {
        Field::Rectangle { size_mm, centre_mm, rotation_deg } => {
            let (sine, cosine) = rotation_deg.to_radians().sin_cos();
            let (sine, cosine) = (sine.abs(), cosine.abs());
            let half = 0.5 * DVec2::new(size_mm.x * cosine + size_mm.y * sine, size_mm.x * sine + size_mm.y * cosine);
            (*centre_mm - half, *centre_mm + half)
        }
        Field::Circle { diameter_mm, centre_mm } => (*centre_mm - 0.5 * diameter_mm, *centre_mm + 0.5 * diameter_mm),
        Field::Polygon { corners_mm } => {
            let start = (DVec2::INFINITY, DVec2::NEG_INFINITY);
            corners_mm.iter().fold(start, |(low, high), corner| (low.min(*corner), high.max(*corner)))
        }
    }
}
