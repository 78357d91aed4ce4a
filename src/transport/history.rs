//! One photon from the focal spot to its end, and what it adds to the detector on the way.

use glam::{DVec2, DVec3};

use super::attenuation::Attenuation;
use super::compton::{Compton, energy_ratio};
use super::dose_grid::DoseGrid;
use super::flight::{End, Medium, Ray, Space};
use super::panel::Panel;
use super::rayleigh::Rayleigh;
use super::source::Source;
use super::stream::Stream;
use super::tally::{Batch, DETECTED, ESCAPED, Page, STARTED};
use crate::scene::physics::ENERGY_RANGE_KEV;

/// How photons come onto the detector.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Estimator {
    /// Every start and every scattering adds what it would send to the detector on average.
    // At a scattering two directions are asked, one to a point drawn evenly on the image and the one that the photon really takes; the
    // balance heuristic (Veach 1995) weighs both, so that neither a near detector nor a forward peak makes single contributions large.
    #[default]
    Expected,
    /// A photon counts where it arrives.
    Analogue,
}

/// Physics of one scene material.
pub struct Material {
    /// μ/ρ and what happens.
    pub attenuation: Attenuation,
    /// Angles.
    pub compton: Compton,
    /// Angles.
    pub rayleigh: Rayleigh,
}

/// Everything that a history needs and does not change.
pub struct World<'a> {
    /// Where photons start.
    pub source: Source,
    /// Where they are scored.
    pub panel: Panel,
    /// What they fly through; `None` for an empty scene.
    pub space: Option<Space<'a>>,
    /// By scene material.
    pub materials: Vec<Material>,
    /// How they are scored.
    pub estimator: Estimator,
    /// Where energy that stays is booked by place, if anywhere.
    pub dose: Option<DoseGrid>,
}

/// A kind of scattering.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Compton,
    Rayleigh,
}

/// A way onto the image.
struct Hit {
    direction: DVec3,
    path_mm: f64,
    pixel: usize,
}

struct Photon {
    ray: Ray,
    energy_kev: f64,
    weight: f64,
    page: Page,
}

impl World<'_> {
    /// Sets attenuation to that at an energy.
    fn tune(&self, medium: &mut Medium, energy_kev: f64) {
        medium.per_mm.clear();
        medium.per_mm.extend(self.materials.iter().map(|material| material.attenuation.per_mm_at_unit_density(energy_kev)));
    }

    /// Follows one photon.
    pub fn run(&self, stream: &mut Stream, medium: &mut Medium, aside: &mut Medium, batch: &mut Batch) {
        let start = self.source.start(&self.panel, stream);
        batch.book(STARTED, start.weight * start.energy_kev);
        let signal = start.weight * self.panel.response(start.energy_kev);
        let aim = self.panel.pixel(start.on_plane_mm);
        let entered = self.space.as_ref().and_then(|space| {
            let (ray, gone_mm) = space.enter(start.position, start.direction)?;
            (gone_mm < start.path_mm).then_some((space, ray, start.path_mm - gone_mm))
        });
        let Some((space, ray, path_mm)) = entered else {
            if let Some(pixel) = aim {
                batch.detect(Page::Primary, pixel, signal);
            }
            batch.book(DETECTED, start.weight * start.energy_kev);
            return;
        };
        self.tune(medium, start.energy_kev);
        if let (Estimator::Expected, Some(pixel)) = (self.estimator, aim) {
            batch.detect(Page::Primary, pixel, signal * space.transmission(ray, path_mm, medium, stream));
        }
        let mut photon = Photon { ray, energy_kev: start.energy_kev, weight: start.weight, page: Page::Primary };
        let mut path_mm = path_mm;
        loop {
            match space.fly(&mut photon.ray, path_mm, medium, stream) {
                End::Collision(material) => {
                    if !self.collide(space, &mut photon, material, medium, aside, stream, batch) {
                        return;
                    }
                }
                end => {
                    let ends_on_plane = path_mm < f64::INFINITY;
                    debug_assert!(end == End::Left || ends_on_plane);
                    if ends_on_plane && self.estimator == Estimator::Analogue {
                        self.arrive(&photon, batch);
                    }
                    let fate = if ends_on_plane { DETECTED } else { ESCAPED };
                    batch.book(fate, photon.weight * photon.energy_kev);
                    return;
                }
            }
            path_mm = self.path_to_plane_mm(&photon.ray);
        }
    }

    /// Distance to the detector plane along a ray; infinite away from it.
    fn path_to_plane_mm(&self, ray: &Ray) -> f64 {
        let towards = ray.direction.dot(self.panel.axes[2]);
        if towards > 0.0 { (self.panel.depth_below(ray.position) / towards).max(0.0) } else { f64::INFINITY }
    }

    /// Scores a photon where its way meets the plane.
    fn arrive(&self, photon: &Photon, batch: &mut Batch) {
        let point = photon.ray.position + photon.ray.direction * self.path_to_plane_mm(&photon.ray);
        if let Some(pixel) = self.panel.pixel(self.panel.on_plane(point)) {
            let passed = if photon.page == Page::Primary { 1.0 } else { self.panel.passed(point, photon.ray.direction) };
            batch.detect(photon.page, pixel, passed * photon.weight * self.panel.response(photon.energy_kev));
        }
    }

    /// Energy that stays in a scene material at a point.
    #[inline]
    fn absorb(&self, material: u32, energy_kev: f64, point: DVec3, batch: &mut Batch) {
        batch.absorb(material, energy_kev);
        if let Some(dose) = &self.dose {
            batch.deposit(dose.voxel(point), energy_kev);
        }
    }

    /// A collision with a material: false where the photon ends.
    #[expect(
        clippy::too_many_arguments,
        reason = "a photon, what it is in, and what it is written into; a struct of them would be this call"
    )]
    fn collide(
        &self,
        space: &Space,
        photon: &mut Photon,
        struck: u32,
        medium: &mut Medium,
        aside: &mut Medium,
        stream: &mut Stream,
        batch: &mut Batch,
    ) -> bool {
        let material = &self.materials[struck as usize];
        let shares = material.attenuation.shares(photon.energy_kev);
        let chance = stream.uniform();
        if chance < shares.photo {
            self.absorb(struck, photon.weight * photon.energy_kev, photon.ray.position, batch);
            return false;
        }
        let kind = if chance < shares.photo_or_compton { Kind::Compton } else { Kind::Rayleigh };
        photon.page = match (photon.page, kind) {
            (Page::Primary, Kind::Compton) => Page::Compton,
            (Page::Primary, Kind::Rayleigh) => Page::Rayleigh,
            _ => Page::Multiple,
        };
        let before_kev = photon.energy_kev;
        if self.estimator == Estimator::Expected {
            let (aim, pixel) = self.panel.aim(DVec2::new(stream.uniform(), stream.uniform()));
            let way = aim - photon.ray.position;
            let path_mm = way.length();
            let hit = Hit { direction: way / path_mm, path_mm, pixel };
            self.expect(space, photon, material, kind, &hit, (medium, aside), stream, batch);
        }
        let cosine = match kind {
            Kind::Compton => material.compton.cosine(before_kev, stream),
            Kind::Rayleigh => material.rayleigh.cosine(before_kev, stream),
        };
        let direction = turned(photon.ray.direction, cosine, stream.direction());
        if self.estimator == Estimator::Expected {
            let path_mm = self.path_to_plane_mm(&Ray { direction, ..photon.ray });
            let point = photon.ray.position + direction * path_mm;
            if path_mm < f64::INFINITY
                && let Some(pixel) = self.panel.pixel(self.panel.on_plane(point))
            {
                let hit = Hit { direction, path_mm, pixel };
                self.expect(space, photon, material, kind, &hit, (medium, aside), stream, batch);
            }
        }
        photon.ray.direction = direction;
        if kind == Kind::Compton {
            photon.energy_kev = before_kev * energy_ratio(before_kev, cosine);
            self.absorb(struck, photon.weight * (before_kev - photon.energy_kev), photon.ray.position, batch);
            if photon.energy_kev < ENERGY_RANGE_KEV.0 {
                self.absorb(struck, photon.weight * photon.energy_kev, photon.ray.position, batch);
                return false;
            }
            self.tune(medium, photon.energy_kev);
        }
        true
    }

    /// Adds what a photon that is scattered onto `hit` sends to the detector on average.
    // With f the density per solid angle of being scattered there and p = r²/(cos · area) that of the point on the image, a direction of
    // either kind counts f/(f + p): the sum of both expectations is ∫ f over the image, and no count exceeds 1.
    #[expect(clippy::too_many_arguments, reason = "as the collision that it belongs to")]
    #[inline]
    fn expect(
        &self,
        space: &Space,
        photon: &Photon,
        material: &Material,
        kind: Kind,
        hit: &Hit,
        (medium, aside): (&mut Medium, &mut Medium),
        stream: &mut Stream,
        batch: &mut Batch,
    ) {
        let Hit { direction, path_mm, pixel } = *hit;
        // A photon on the plane sends nothing to it.
        let towards = direction.dot(self.panel.axes[2]);
        if !(towards > 0.0) {
            return;
        }
        let passed = self.panel.passed(photon.ray.position + direction * path_mm, direction);
        if passed == 0.0 {
            return;
        }
        let cosine = photon.ray.direction.dot(direction).clamp(-1.0, 1.0);
        let (density, energy_kev, medium) = match kind {
            Kind::Compton => {
                let energy_kev = photon.energy_kev * energy_ratio(photon.energy_kev, cosine);
                if energy_kev < ENERGY_RANGE_KEV.0 {
                    return;
                }
                self.tune(aside, energy_kev);
                (material.compton.density(photon.energy_kev, cosine), energy_kev, aside)
            }
            Kind::Rayleigh => (material.rayleigh.density(photon.energy_kev, cosine), photon.energy_kev, medium),
        };
        let even = path_mm * path_mm / (towards * self.panel.area_mm2);
        let signal = passed * photon.weight * self.panel.response(energy_kev) * density / (density + even);
        let ray = Ray { direction, ..photon.ray };
        batch.detect(photon.page, pixel, signal * space.transmission(ray, path_mm, medium, stream));
    }
}

/// `direction` turned by an angle of this cosine towards `azimuth` around it.
// Two axes across a unit vector without a branch at the poles (Duff et al. 2017).
#[inline]
fn turned(direction: DVec3, cosine: f64, azimuth: DVec2) -> DVec3 {
    let DVec3 { x, y, z } = direction;
    let sign = 1.0_f64.copysign(z);
    let a = -1.0 / (sign + z);
    let b = x * y * a;
    let (first, second) = (DVec3::new(1.0 + sign * x * x * a, sign * b, -sign * x), DVec3::new(b, sign + y * y * a, -y));
    let sine = (1.0 - cosine * cosine).max(0.0).sqrt();
    direction * cosine + first * (sine * azimuth.x) + second * (sine * azimuth.y)
}
