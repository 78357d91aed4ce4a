//! From shots to a layout, or to the reason why there is none.

use glam::{DVec2, DVec3};

use super::adjust::{Blocks, solved};
use super::gauge::{Spread, sigma_mm, spread};
use super::grow::{FEWEST_SHOTS, matches};
use super::mirrored::{MirrorImage, mirror_image};
use super::prune::{Pruned, pruned, unsolved, whole};
use super::refusal::PhantomRefusal;
use super::report::{LeftOutBead, LeftOutShot, MeasuredBead, Phantom, ShotUsed};
use super::scale::{Distance, Measured, Scale, ScaleSource};
use super::shot::{CameraErrors, PhantomShot, ShotShadow};
use super::structure::Structure;
use crate::beads::{Bead, BeadLayout};
use crate::calibrate::layout::score;
use crate::estimate::{Covariance, Estimate, VectorBlock};
use crate::geometry::Intrinsics;

/// Fewest beads of a layout, and fewest shadows of a shot.
const FEWEST_BEADS: usize = 5;
const FEWEST_SHADOWS: usize = 4;
/// Beams must differ by so much.
const LEAST_ANGLE_DEG: f64 = 8.0;
/// Of the shots, as many may be left out.
const MOST_LEFT_OUT: f64 = 0.34;
/// Accidental matches accepted.
const MOST_CHANCE: f64 = 1e-6;
/// A rival match has at least so large a share of the shadows.
const RIVAL: f64 = 0.85;
/// Shadows, and cameras, may be off by so many times what they state.
const MOST_TIMES: f64 = 3.0;
const MOST_CAMERA_TIMES: f64 = 4.0;
/// What is written at all: beads apart from the scale, mm, and the scale.
const MOST_SHAPE_MM: f64 = 1.0;
const MOST_SCALE: f64 = 0.05;
/// The mirror image is excluded by so much more in squares, and is the same cloud when no farther off than this.
const LEAST_EXCESS: f64 = 50.0;
const SAME_CLOUD_MM: f64 = 0.2;
/// Evidence of the size contradicts the cameras beyond so many standard deviations.
const MOST_CONTRADICTION: f64 = 4.0;
/// Beads this close count as coinciding when the layout is scored, mm.
const COINCIDING_MM: f64 = 1.0;

/// What is asked.
#[derive(Clone, Copy, Debug)]
pub struct Asked<'a> {
    /// Shots of one phantom that lay still.
    pub shots: &'a [PhantomShot],
    /// What may be wrong in all of them alike.
    pub errors: CameraErrors,
    /// Where the rough cameras come from, in words.
    pub cameras_from: &'a str,
    /// Whose axes the layout has, in words.
    pub axes: &'a str,
    /// Radius of the beads: with the shadows' radii it tells the size.
    pub bead_radius_mm: Option<f64>,
    /// Distances measured otherwise.
    pub distances: &'a [Distance],
}

/// Measures a phantom.
///
/// # Errors
/// The refusal, when the shots do not tell the layout without doubt.
pub fn measure(asked: &Asked) -> Result<Phantom, PhantomRefusal> {
    check(asked.shots)?;
    let done = attempt(asked);
    // Pictures or joints that turn the wrong way round leave little or nothing to match.
    let nothing = |refusal: &PhantomRefusal| {
        use PhantomRefusal::{Chance, Contradictory, NoMatch, Residual, TooFewBeads};
        matches!(refusal, Chance { .. } | Contradictory { .. } | NoMatch { .. } | Residual { .. } | TooFewBeads { .. })
    };
    if done.as_ref().is_err_and(nothing) {
        let mirrored: Vec<PhantomShot> = asked.shots.iter().map(mirrored_picture).collect();
        if let Ok(found) = attempt(&Asked { shots: &mirrored, distances: &[], bead_radius_mm: None, ..*asked }) {
            return Err(PhantomRefusal::MirroredPictures { beads: found.beads.len(), shots: found.shots.len() });
        }
    }
    done
}

fn mirrored_picture(shot: &PhantomShot) -> PhantomShot {
    let last = f64::from(shot.size_px[0]) - 1.0;
    let k = shot.intrinsics;
    let turned = |shadow: &ShotShadow| {
        let (at, [uu, uv, vv]) = (shadow.image_px, shadow.noise_px2);
        ShotShadow { image_px: DVec2::new(last - at.x, at.y), noise_px2: [uu, -uv, vv], ..*shadow }
    };
    let shadows = shot.shadows.iter().map(turned).collect();
    PhantomShot { intrinsics: Intrinsics { cx: last - k.cx, skew: -k.skew, ..k }, shadows, ..shot.clone() }
}

fn check(shots: &[PhantomShot]) -> Result<(), PhantomRefusal> {
    if shots.len() < FEWEST_SHOTS {
        return Err(PhantomRefusal::TooFewShots { found: shots.len(), required: FEWEST_SHOTS });
    }
    if let Some(shot) = shots.iter().find(|shot| shot.shadows.len() < FEWEST_SHADOWS) {
        let (found, required) = (shot.shadows.len(), FEWEST_SHADOWS);
        return Err(PhantomRefusal::TooFewShadows { shot: shot.name.clone(), found, required });
    }
    let beams: Vec<DVec3> = shots.iter().map(|shot| shot.camera_from_world.inverse().transform_vector(DVec3::Z)).collect();
    apart(&beams).map(|_| ())
}

/// The largest angle between two beams, opposite ones counting as alike.
fn apart(beams: &[DVec3]) -> Result<f64, PhantomRefusal> {
    let angle = |a: &DVec3, b: &DVec3| a.cross(*b).length().atan2(a.dot(*b).abs()).to_degrees();
    let angle_deg = beams.iter().flat_map(|a| beams.iter().map(move |b| angle(a, b))).fold(0.0, f64::max);
    let required_deg = LEAST_ANGLE_DEG;
    if angle_deg >= required_deg { Ok(angle_deg) } else { Err(PhantomRefusal::TooAlike { angle_deg, required_deg }) }
}

fn attempt(asked: &Asked) -> Result<Phantom, PhantomRefusal> {
    let shots = asked.shots;
    let mut found = matches(shots, &asked.errors).into_iter();
    let best = found.next().filter(|best| best.points.len() >= FEWEST_BEADS);
    let best = best.ok_or(PhantomRefusal::NoMatch { required: FEWEST_BEADS })?;
    let unmatched: Vec<usize> = (0..shots.len()).filter(|n| best.cameras[*n].is_none()).collect();
    let left = pruned(shots, best, asked.errors)?;
    let named = unmatched.iter().chain(left.shots.iter().map(|(n, _)| n)).map(|n| shots[*n].name.clone()).collect::<Vec<_>>();
    if named.len() as f64 > MOST_LEFT_OUT * shots.len() as f64 {
        return Err(PhantomRefusal::Contradictory { named, shots: shots.len() });
    }
    if left.structure.points.len() < FEWEST_BEADS {
        return Err(PhantomRefusal::TooFewBeads { found: left.structure.points.len(), required: FEWEST_BEADS });
    }
    let matched = left.structure.observations();
    for rival in found {
        let Ok(Pruned { structure: rival, .. }) = pruned(shots, rival, asked.errors) else { continue };
        let other = rival.points.len() >= FEWEST_BEADS && rival.alike(&left.structure) < 0.5;
        if other && rival.observations() as f64 >= RIVAL * matched as f64 {
            return Err(PhantomRefusal::Ambiguous { matched, rival: rival.observations() });
        }
    }
    Found::new(asked, left)?.written(&unmatched)
}

/// A match that is one, its beads in the order of their names.
struct Found<'a> {
    asked: &'a Asked<'a>,
    left: Pruned,
    names: Vec<String>,
    log10_chance: f64,
    beams_deg: f64,
    mirrored_over_found: Option<f64>,
}

impl<'a> Found<'a> {
    fn new(asked: &'a Asked, mut left: Pruned) -> Result<Self, PhantomRefusal> {
        let rms_px = left.rms_px;
        let structure = &mut left.structure;
        let mut order: Vec<usize> = (0..structure.points.len()).collect();
        order.sort_by(|a, b| structure.points[*a].z.total_cmp(&structure.points[*b].z));
        structure.points = order.iter().map(|n| structure.points[*n]).collect();
        structure.tracks = order.iter().map(|n| structure.tracks[*n].clone()).collect();
        let beams: Vec<DVec3> = structure.shots().map(|(_, camera)| camera.inverse().transform_vector(DVec3::Z)).collect();
        let beams_deg = apart(&beams)?;
        let names = (1..=order.len()).map(|n| format!("bead-{n:02}")).collect();
        let log10_chance = log10_chance(asked.shots, structure, rms_px);
        if !(log10_chance < MOST_CHANCE.log10()) {
            let (beads, shots) = (structure.points.len(), beams.len());
            let expected = 10f64.powf(log10_chance.min(99.0));
            return Err(PhantomRefusal::Chance { beads, shots, rms_px, expected, limit: MOST_CHANCE });
        }
        let image = mirror_image(asked.shots, structure);
        if let Some(MirrorImage { chi2, found_chi2, apart_mm }) = image
            && apart_mm > SAME_CLOUD_MM
            && !(chi2 > 2.0 * found_chi2 && chi2 > found_chi2 + LEAST_EXCESS)
        {
            return Err(PhantomRefusal::Mirrored { found: found_chi2, mirrored: chi2 });
        }
        let mirrored_over_found = image.filter(|image| image.apart_mm > SAME_CLOUD_MM).map(|image| image.chi2 / image.found_chi2);
        Ok(Self { asked, left, names, log10_chance, beams_deg, mirrored_over_found })
    }

    /// What measured evidence of the size there is.
    fn measured(&self) -> Result<Measured, PhantomRefusal> {
        let radii = |mm: f64| Measured::by_radii(self.asked.shots, &self.left.structure, mm);
        let mut measured = self.asked.bead_radius_mm.map(radii).unwrap_or_default();
        let number = |name: &String| {
            let no_such = || PhantomRefusal::NoSuchBead { name: name.clone(), known: self.names.clone() };
            self.names.iter().position(|known| known == name).ok_or_else(no_such)
        };
        for Distance { beads: [a, b], mm, sigma_mm } in self.asked.distances {
            measured.distances.push(([number(a)?, number(b)?], *mm, *sigma_mm));
        }
        Ok(measured)
    }

    fn written(self, unmatched: &[usize]) -> Result<Phantom, PhantomRefusal> {
        let (asked, shots) = (self.asked, self.asked.shots);
        let cameras_alone = whole(shots, &self.left.structure, asked.errors, Measured::default());
        let (problem, blocks) = cameras_alone.problem();
        let (estimate, covariance) = solved(&problem).map_err(unsolved)?;
        let fit = Fit::new(&self.left.structure, &blocks, &estimate, &covariance);
        let of_cameras = ScaleSource { source: asked.cameras_from.to_owned(), sigma: fit.spread.scale_sigma, larger_by: None };
        let structure = blocks.taken(&self.left.structure, &estimate);
        let measured = self.measured()?;
        let mut sources = measured.against(&structure, &self.names);
        for source in &sources {
            let larger_by = source.larger_by.unwrap_or(0.0);
            let times = larger_by.abs() / source.sigma.hypot(of_cameras.sigma);
            if !(times <= MOST_CONTRADICTION) {
                let (source_said, limit) = (source.source.clone(), MOST_CONTRADICTION);
                return Err(PhantomRefusal::ScaleContradicted { source_said, larger_by, times, limit });
            }
        }
        sources.push(of_cameras);
        sources.sort_by(|a, b| a.sigma.total_cmp(&b.sigma));
        if measured.is_empty() {
            return self.report(&fit, structure, sources, unmatched);
        }
        let with_all = whole(shots, &structure, asked.errors, measured);
        let (problem, blocks) = with_all.problem();
        let (estimate, covariance) = solved(&problem).map_err(unsolved)?;
        let fit = Fit::new(&structure, &blocks, &estimate, &covariance);
        let structure = blocks.taken(&structure, &estimate);
        self.report(&fit, structure, sources, unmatched)
    }

    fn report(
        &self,
        fit: &Fit,
        structure: Structure,
        sources: Vec<ScaleSource>,
        unmatched: &[usize],
    ) -> Result<Phantom, PhantomRefusal> {
        let (times, limit) = (fit.chi2_per_dof.sqrt(), MOST_TIMES);
        if !(times <= limit) {
            return Err(PhantomRefusal::Residual { times, limit });
        }
        let (times, limit) = (fit.cameras_chi2_per_dof.sqrt(), MOST_CAMERA_TIMES);
        if !(times <= limit) {
            return Err(PhantomRefusal::Cameras { times, limit });
        }
        let shape_sigma_mm = fit.shape_sigma_mm();
        if !(shape_sigma_mm <= MOST_SHAPE_MM) {
            return Err(PhantomRefusal::Shape { sigma_mm: shape_sigma_mm, limit_mm: MOST_SHAPE_MM });
        }
        let sigma = fit.spread.scale_sigma;
        if !(sigma <= MOST_SCALE) {
            let sources = sources.into_iter().map(|source| source.source).collect();
            return Err(PhantomRefusal::Scale { sigma, limit: MOST_SCALE, sources });
        }
        let centre = structure.points.iter().sum::<DVec3>() / structure.points.len() as f64;
        let bead = |n: usize| MeasuredBead {
            name: self.names[n].clone(),
            mm: (structure.points[n] - centre).to_array(),
            sigma_mm: sigma_mm(&fit.spread.total[n]),
            shape_sigma_mm: sigma_mm(&fit.spread.shape[n]),
            covariance_mm2: std::array::from_fn(|i| std::array::from_fn(|j| fit.spread.total[n][(i, j)])),
            shots: structure.shadows_of(n).count(),
            rms_px: fit.rms_px(|bead, _| bead == n),
            left_out_px: fit.left_out_px(|bead| bead == n),
        };
        let beads: Vec<MeasuredBead> = (0..structure.points.len()).map(bead).collect();
        let shot = |(n, _): (usize, &crate::geometry::Rigid)| ShotUsed {
            shot: self.asked.shots[n].name.clone(),
            beads: structure.shadows_in(n).count(),
            strays: self.asked.shots[n].shadows.len() - structure.shadows_in(n).count(),
            rms_px: fit.rms_px(|_, shot| shot == n),
            camera_off_sigma: fit.camera_off(n),
        };
        Ok(Phantom {
            frame: format!("origin in the mean of the beads, axes of {}", self.asked.axes),
            scale: Scale { sigma, sources },
            shape_sigma_mm,
            rms_px: fit.rms_px(|_, _| true),
            left_out_px: fit.left_out_px(|_| true),
            chi2_per_dof: fit.chi2_per_dof,
            cameras_chi2_per_dof: fit.cameras_chi2_per_dof,
            mirrored_over_found: self.mirrored_over_found,
            log10_chance: self.log10_chance,
            beams_deg: self.beams_deg,
            shots: structure.shots().map(shot).collect(),
            left_out_shots: self.left_out_shots(unmatched),
            left_out_beads: self.left_out_beads(centre),
            warnings: warnings(&beads),
            beads,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        })
    }

    fn left_out_shots(&self, unmatched: &[usize]) -> Vec<LeftOutShot> {
        let name = |n: usize| self.asked.shots[n].name.clone();
        let no_match = unmatched.iter().map(|n| LeftOutShot {
            shot: name(*n),
            reason: "its shadows are not those of the other shots where its camera may be: another phantom, moved, or the joints of another moment?".to_owned(),
        });
        let elsewhere = self.left.shots.iter().map(|(n, times)| LeftOutShot {
            shot: name(*n),
            reason: format!("its camera is {times:.0} standard deviations from where it was stated: were its joints read at another moment, or was the phantom moved?"),
        });
        no_match.chain(elsewhere).collect()
    }

    fn left_out_beads(&self, centre: DVec3) -> Vec<LeftOutBead> {
        let bead = |(at, shots, reason): &(DVec3, usize, &str)| LeftOutBead {
            mm: (*at - centre).to_array(),
            shots: *shots,
            reason: (*reason).to_owned(),
        };
        self.left.beads.iter().map(bead).collect()
    }
}

/// What a solution says of itself.
struct Fit {
    spread: Spread,
    chi2_per_dof: f64,
    cameras_chi2_per_dof: f64,
    /// χ² of each shot's rough camera.
    cameras: Vec<Option<f64>>,
    /// Of each shadow: bead, shot, squared residual, and squared residual when predicted by all others, px².
    shadows: Vec<(usize, usize, f64, f64)>,
}

impl Fit {
    fn new(structure: &Structure, blocks: &Blocks, estimate: &Estimate, covariance: &Covariance) -> Self {
        let images = blocks.images.iter();
        let shadow = |(bead, shot, n): &(usize, usize, usize)| {
            let own: f64 = estimate.offset(*n).iter().map(|px| px * px).sum();
            let left_out = estimate.left_out_linear(covariance, *n).map_or(f64::NAN, |left| left.offset.norm_squared());
            (*bead, *shot, own, left_out)
        };
        let chi2: f64 = images.clone().map(|(.., n)| estimate.chi2(*n)).sum();
        let cameras: Vec<Option<f64>> = blocks.priors.iter().map(|prior| prior.map(|n| estimate.chi2(n))).collect();
        // Shadows fix beads and cameras up to a motion and the scale; the cameras' places then have that much to spare.
        let shots = structure.shots().count() as f64;
        let of_cameras = 6.0 * shots - 7.0;
        let of_shadows = (2.0 * blocks.images.len() as f64 - 3.0 * structure.points.len() as f64 - of_cameras).max(1.0);
        let cameras_chi2_per_dof = cameras.iter().flatten().sum::<f64>() / of_cameras;
        let chi2_per_dof = chi2 / of_shadows;
        let ids: Vec<_> = blocks.points.iter().map(VectorBlock::id).collect();
        let mut spread = spread(&structure.points, &covariance.of(&ids));
        // Each is scaled by what it rests on: the shape by the shadows, the size by the cameras too.
        let by_shadows = chi2_per_dof.max(1.0);
        let by_cameras = cameras_chi2_per_dof.max(by_shadows);
        for (total, shape) in spread.total.iter_mut().zip(&mut spread.shape) {
            let size = *total - *shape;
            *shape *= by_shadows;
            *total = *shape + size * by_cameras;
        }
        spread.scale_sigma *= by_cameras.sqrt();
        Self { spread, chi2_per_dof, cameras_chi2_per_dof, cameras, shadows: images.map(shadow).collect() }
    }

    fn rms_px(&self, of: impl Fn(usize, usize) -> bool) -> f64 {
        let own = || self.shadows.iter().filter(|(bead, shot, ..)| of(*bead, *shot)).map(|(.., own, _)| *own);
        (own().sum::<f64>() / own().count().max(1) as f64).sqrt()
    }

    fn left_out_px(&self, of: impl Fn(usize) -> bool) -> f64 {
        let own = || self.shadows.iter().filter(|(bead, ..)| of(*bead)).map(|(.., left_out)| *left_out);
        (own().sum::<f64>() / own().count().max(1) as f64).sqrt()
    }

    fn camera_off(&self, shot: usize) -> f64 {
        self.cameras[shot].map_or(f64::NAN, |chi2| (chi2 / 6.0).sqrt())
    }

    fn shape_sigma_mm(&self) -> f64 {
        let squares: f64 = self.spread.shape.iter().map(|own| sigma_mm(own).powi(2)).sum();
        (squares / self.spread.shape.len().max(1) as f64).sqrt()
    }
}

/// log₁₀ of how often shadows strewn at random would fit so well: in every further shot any of its shadows may be taken for a bead's, and
/// of all coordinates, what beads and cameras cannot absorb must agree by accident.
fn log10_chance(shots: &[PhantomShot], structure: &Structure, rms_px: f64) -> f64 {
    let used: Vec<usize> = structure.shots().map(|(n, _)| n).collect();
    let shadows = used.iter().map(|n| shots[*n].shadows.len() as f64).sum::<f64>() / used.len().max(1) as f64;
    let (beads, count) = (structure.points.len() as f64, structure.observations() as f64);
    let over = 2.0 * count - 3.0 * beads - 6.0 * used.len() as f64 + 7.0;
    let side = used.iter().map(|n| f64::from(shots[*n].size_px[0].max(shots[*n].size_px[1]))).fold(f64::INFINITY, f64::min);
    let agrees = (4.0 * rms_px / side).clamp(1e-12, 1.0);
    let choices = count * shadows.max(2.0).log10();
    choices + over * agrees.log10()
}

fn warnings(beads: &[MeasuredBead]) -> Vec<String> {
    let bead =
        |bead: &MeasuredBead| Bead { sigma_mm: Some(bead.sigma_mm), ..Bead::new(bead.name.clone(), DVec3::from_array(bead.mm)) };
    let layout = BeadLayout { beads: beads.iter().map(bead).collect(), ..BeadLayout::none() };
    score(&layout, COINCIDING_MM, None).warnings
}
