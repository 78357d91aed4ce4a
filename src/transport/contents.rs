//! What a box of space holds: nothing, one material of one density, or a mixture with bounds of what a photon may meet there.

use glam::DVec3;

use super::bounds::{Held, Range, Region, held, inside};
use super::matter::{Body, Thing};

/// Densities of mixtures are bounded in steps of this factor, so that neighbours can be merged.
const LADDER: f64 = 1.05;

/// A shape or mesh so many times as dense as all else in a box is bounded apart: there photons try collisions at its density where they fly
/// through it, and nowhere else.
const DENSER: f64 = 1.5;
/// A mesh only from so many g/cm³ on, as metals are: where a ray runs through one is found at the cost of some collisions.
const METAL: f64 = 2.5;

/// What a box of space holds.
#[derive(Clone, Debug, PartialEq)]
pub enum Content {
    /// Nothing.
    Empty,
    /// One material of one density, g/cm³, everywhere.
    Uniform {
        /// Scene material.
        material: u32,
        /// Its density.
        density: f64,
    },
    /// Whatever the things have at a point.
    Mixed(Mixture),
}

/// Things that may have matter in a box, and bounds of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Mixture {
    /// Indices of things, the scene's last first.
    pub things: Vec<u32>,
    /// Whether air that is kept has to be asked for.
    pub keeps_air: bool,
    /// Attenuation at any point is at most the largest of `to` · μ/ρ, and, if there is matter everywhere, at least the smallest of
    /// `from` · μ/ρ.
    pub ranges: Vec<Range>,
    /// Whether there is matter everywhere, none of it fading.
    pub is_full: bool,
    /// Shapes and meshes among the things that are much denser than the others, and what is there beside them.
    pub dense: Option<Box<Dense>>,
}

/// Things of a mixture that a ray meets or passes: where it runs in none of them there is no more than the rest.
#[derive(Clone, Debug, PartialEq)]
pub struct Dense {
    /// Indices of things: shapes and meshes.
    pub shapes: Vec<u32>,
    /// The mixture without them.
    pub rest: Mixture,
}

type Found = (u32, usize, Held);

/// What a region holds: the things that may have matter there, from the scene's last to the first that leaves nothing to others.
pub fn content(things: &[Thing], bounds: &[(DVec3, DVec3)], region: &Region) -> Content {
    let mut found: Vec<Found> = Vec::new();
    let (mut covering, mut is_full) = (usize::MAX, false);
    for (index, (thing, bound)) in things.iter().zip(bounds).enumerate() {
        // Parts that lie in one object add up, so a part that is full covers only what comes before the object.
        if is_full && thing.own != covering {
            break;
        }
        if bound.0.cmpgt(region.high).any() || bound.1.cmplt(region.low).any() {
            continue;
        }
        let held = held(&thing.body, region);
        if held.ranges.is_empty() {
            continue;
        }
        if held.is_full {
            (is_full, covering) = (true, thing.own);
        }
        found.push((index as u32, thing.own, held));
    }
    match found.as_slice() {
        [] => return Content::Empty,
        [(_, _, held)] if held.is_full || held.holds_air && held.ranges.len() == 1 && is_solid_air(things, &found, region) => {
            if let [range] = held.ranges.as_slice()
                && range.from == range.to
            {
                return Content::Uniform { material: range.material, density: range.to };
            }
        }
        _ => {}
    }
    let mut whole = mixture(&found);
    let densest = |held: &Held| held.ranges.iter().fold(0.0, |most, range| f64::max(most, range.to));
    // What can be bounded apart: it has a surface in the region, on one side of which it is not.
    let is_shape = |(index, _, held): &Found| {
        let is_worth_it = match things[*index as usize].body {
            Body::Solid(_) => true,
            Body::Mesh(_) => densest(held) > METAL,
            Body::Volume(_) => false,
        };
        is_worth_it && !held.is_full && !held.holds_air
    };
    let others = found.iter().filter(|one| !is_shape(one)).fold(0.0, |most, (.., held)| f64::max(most, densest(held)));
    let (apart, rest): (Vec<Found>, Vec<Found>) =
        found.into_iter().partition(|one| is_shape(one) && densest(&one.2) > DENSER * others);
    if !apart.is_empty() {
        let shapes = apart.iter().map(|(index, ..)| *index).collect();
        whole.dense = Some(Box::new(Dense { shapes, rest: mixture(&rest) }));
    }
    Content::Mixed(whole)
}

/// All that was found, together.
fn mixture(found: &[Found]) -> Mixture {
    let mut ranges: Vec<Range> = Vec::new();
    for (_, own, held) in found {
        let together = found.iter().filter(|(_, other, _)| other == own).count() as f64;
        for range in &held.ranges {
            let (from, to) = (step_below(range.from), step_above(range.to * together));
            match ranges.iter_mut().find(|known| known.material == range.material) {
                Some(known) => (known.from, known.to) = (known.from.min(from), known.to.max(to)),
                None => ranges.push(Range { material: range.material, from, to }),
            }
        }
    }
    ranges.sort_unstable_by_key(|range| range.material);
    // Matter that fades displaces what lies under it, down to no density at all.
    let is_full = found.iter().any(|(.., held)| held.is_full) && found.iter().all(|(.., held)| !held.fades);
    Mixture {
        things: found.iter().map(|(index, ..)| *index).collect(),
        keeps_air: found.iter().any(|(.., held)| held.holds_air),
        ranges,
        is_full,
        dense: None,
    }
}

/// Whether the one thing found is a solid of air that fills the region: nothing else is there to displace it.
fn is_solid_air(things: &[Thing], found: &[Found], region: &Region) -> bool {
    let [(index, ..)] = found else { return false };
    match &things[*index as usize].body {
        Body::Solid(body) => inside(body, region) == Some(true),
        Body::Mesh(_) | Body::Volume(_) => false,
    }
}

fn step_above(density: f64) -> f64 {
    LADDER.powf((density.ln() / LADDER.ln()).ceil()).max(density) * (1.0 + 1e-9)
}

fn step_below(density: f64) -> f64 {
    LADDER.powf((density.ln() / LADDER.ln()).floor()).min(density) * (1.0 - 1e-9)
}

impl Content {
    /// Equal for equal contents only.
    #[must_use]
    pub fn key(&self) -> Vec<u64> {
        match self {
            Self::Empty => Vec::new(),
            Self::Uniform { material, density } => vec![u64::from(*material), density.to_bits()],
            Self::Mixed(mixture) => mixture.key(),
        }
    }
}

impl Mixture {
    /// At least three words, the lengths of its lists first.
    fn key(&self) -> Vec<u64> {
        let flags = u64::from(self.keeps_air) + 2 * u64::from(self.is_full);
        let mut key = vec![self.things.len() as u64, self.ranges.len() as u64, flags];
        key.extend(self.things.iter().map(|index| u64::from(*index)));
        key.extend(self.ranges.iter().flat_map(|range| [u64::from(range.material), range.from.to_bits(), range.to.to_bits()]));
        if let Some(dense) = &self.dense {
            key.push(dense.shapes.len() as u64);
            key.extend(dense.shapes.iter().map(|index| u64::from(*index)));
            key.extend(dense.rest.key());
        }
        key
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::model::{Matter, Shape};
    use crate::transport::fixture::{scene, solid};
    use crate::transport::matter::{bounds_of, things_of};

    /// Steel in tissue is bounded apart, plastic is not, and neither is what fills the region.
    #[test]
    fn what_is_much_denser_than_the_rest_is_bounded_apart() {
        let at_origin = |shape: Shape, material: usize, density: f64| {
            Matter::Solids(vec![solid(shape, DVec3::ZERO, DVec3::ZERO, material, density)])
        };
        let bath = || at_origin(Shape::Cuboid { half_size_mm: DVec3::splat(100.0) }, 0, 1.0);
        let ball =
            |radius_mm: f64, density: f64| at_origin(Shape::Ellipsoid { semi_axes_mm: DVec3::splat(radius_mm) }, 1, density);
        let content_of = |matters: Vec<Matter>| {
            let scene = scene(&["water", "steel_316l"], matters);
            let things = things_of(&scene);
            let bounds: Vec<_> = things.iter().map(|thing| bounds_of(&thing.body)).collect();
            content(&things, &bounds, &Region { low: DVec3::splat(-4.0), high: DVec3::splat(4.0) })
        };
        let Content::Mixed(steel) = content_of(vec![bath(), ball(2.0, 8.0)]) else { panic!("a mixture") };
        let dense = steel.dense.as_deref().expect("bounded apart");
        // The last of the scene is the first of the things.
        assert_eq!((steel.things.as_slice(), dense.shapes.as_slice()), (&[0, 1][..], &[0][..]));
        assert_eq!((dense.rest.things.as_slice(), dense.rest.ranges.len(), dense.rest.is_full), (&[1][..], 1, true));
        assert!(dense.rest.ranges[0].to < 1.06 && dense.rest.dense.is_none() && steel.ranges.len() == 2);
        let Content::Mixed(plastic) = content_of(vec![bath(), ball(2.0, 1.18)]) else { panic!("a mixture") };
        assert_eq!(plastic.dense, None);
        let Content::Mixed(alone) = content_of(vec![ball(2.0, 1.18)]) else { panic!("a mixture") };
        assert!(alone.dense.as_deref().is_some_and(|dense| dense.rest.things.is_empty() && !dense.rest.is_full));
        assert_eq!(content_of(vec![bath(), ball(20.0, 8.0)]), Content::Uniform { material: 1, density: 8.0 });
        // Contents that differ in what is beside the steel alone are two.
        let mut other = steel.clone();
        other.dense = None;
        assert_ne!(Content::Mixed(other.clone()).key(), Content::Mixed(steel.clone()).key());
        other.dense = Some(Box::new(Dense { shapes: vec![0], rest: Mixture { is_full: false, ..dense.rest.clone() } }));
        assert_ne!(Content::Mixed(other).key(), Content::Mixed(steel).key());
    }
}
