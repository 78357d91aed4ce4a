//! What is asked of a registration.

use glam::{DVec2, DVec3};

use super::hand_marks::ByHand;
use super::prior::Prior;
use super::record::{Pose, Status};
use super::refusal::{Points, Refusal};
use super::residual::BeadResidual;
use super::solve::{Free, IntrinsicsPrior};
use super::verdict::check_geometry;
use crate::acquire::Frame;
use crate::beads::{Bead, BeadLayout, Correspondence, Expectation, Landmark};
use crate::geometry::{Distortion, Intrinsics};
use crate::mask::{Disc, Masks};

/// Everything that is known besides the picture.
#[derive(Clone, Copy, Debug)]
pub struct Registration<'a> {
    /// Columns and rows of the frame.
    pub size_px: [u32; 2],
    /// The beads in the specimen.
    pub layout: &'a BeadLayout,
    /// K of the frame; `None`: solved, which takes six beads that are not coplanar.
    pub intrinsics: Option<Intrinsics>,
    /// Whether `intrinsics` is what the frame's header says, with the middle of the picture: nobody has measured it.
    pub is_k_of_header: bool,
    /// How sure `intrinsics` is, which is its mean: K is solved with this prior. `None`: it is known.
    pub intrinsics_prior: Option<IntrinsicsPrior>,
    /// Side of a pixel: bounds depths (no bead lies behind the detector) and makes pixels square when K is solved.
    pub pitch_mm: Option<f64>,
    /// From the source to the isocentre: where a pose tells its error in mm. `None`: at the mean depth of the beads.
    pub source_to_isocentre_mm: Option<f64>,
    /// What an image intensifier did to the frame. Places found in it, or marked by a person, are undistorted before anything is solved:
    /// K, P and all places of the pose are those of the undistorted picture.
    pub distortion: Option<&'a Distortion>,
    /// Whether the detector is known to be flat: no intensifier has bent the frame.
    pub is_flat: bool,
    /// The round field of a frame that an image intensifier may have taken, px: nobody says what it did, nor that there is none.
    pub round_field: Option<Disc>,
    /// Where the pose is expected.
    pub prior: Option<&'a Prior>,
    /// Whether the prior is also a measurement.
    pub fuse: bool,
    /// Whether a match that contradicts the prior's covariance is taken all the same.
    pub ignore_prior: bool,
    /// Whether beads of several bodies are one rigid specimen; a frame in which one has moved is then refused.
    pub one_body: bool,
    /// Which shadow is which bead, where a person has said so.
    pub correspondences: &'a [Correspondence],
    /// What a person has changed of what was found.
    pub by_hand: ByHand<'a>,
    /// Where uncertainty is wanted.
    pub landmarks: &'a [Landmark],
    /// Radius of beads whose description gives none.
    pub bead_radius_mm: Option<f64>,
}

impl<'a> Registration<'a> {
    /// For frames of `size_px`; nothing else is known.
    #[must_use]
    pub fn new(size_px: [u32; 2], layout: &'a BeadLayout) -> Self {
        Self {
            size_px,
            layout,
            intrinsics: None,
            is_k_of_header: false,
            intrinsics_prior: None,
            pitch_mm: None,
            source_to_isocentre_mm: None,
            distortion: None,
            is_flat: false,
            round_field: None,
            prior: None,
            fuse: false,
            ignore_prior: false,
            one_body: false,
            correspondences: &[],
            by_hand: ByHand::default(),
            landmarks: &[],
            bead_radius_mm: None,
        }
    }

    /// The round field of `frame`, unless somebody says what took it. A round collimator before a flat panel looks like an intensifier's.
    #[must_use]
    pub fn round_field_of(&self, frame: &Frame, masks: &Masks) -> Option<Disc> {
        let is_told = self.is_flat || self.distortion.is_some() || frame.tags.names_flat_panel();
        masks.disc.filter(|_| !is_told)
    }

    /// Fewest beads that give a pose.
    pub(super) fn fewest(&self) -> usize {
        if self.intrinsics.is_some() { 4 } else { 6 }
    }

    /// How many beads the prior puts into the frame, and how many there are.
    pub(super) fn prior_puts_into_frame(&self) -> Option<[usize; 2]> {
        let (prior, intrinsics) = self.prior.zip(self.intrinsics)?;
        let [width, height] = self.size_px.map(f64::from);
        let inside = |lps_mm: DVec3| {
            let in_camera = prior.camera_from_lps.transform_point(lps_mm);
            let at = intrinsics.project(in_camera);
            in_camera.z > 0.0 && (0.0..width).contains(&at.x) && (0.0..height).contains(&at.y)
        };
        let beads = &self.layout.beads;
        Some([beads.iter().filter(|bead| inside(bead.lps_mm)).count(), beads.len()])
    }

    /// What of K is solved.
    pub(super) fn free(&self) -> Free {
        match (self.intrinsics, self.intrinsics_prior) {
            // Detectors have square pixels; a second focal length would mostly fit noise.
            (None, _) => Free::Square,
            (Some(mean), Some(prior)) => Free::Known(IntrinsicsPrior { mean, ..prior }),
            (Some(_), None) => Free::Pose,
        }
    }

    /// What no picture can make good.
    pub(super) fn fault(&self) -> Option<Refusal> {
        if let Some(reason) = &self.layout.refused {
            return Some(Refusal::Layout { detail: reason.clone() });
        }
        let points: Vec<DVec3> = self.layout.beads.iter().map(|bead| bead.lps_mm).collect();
        if let Err(degenerate) = check_geometry(&points, self.intrinsics.is_some(), Points::Layout) {
            return Some(degenerate);
        }
        if let Some(prior) = self.prior {
            if let Some(fault) = prior.fault() {
                return Some(Refusal::Prior { detail: format!("its covariance is unusable: {fault}") });
            }
            let depth_mm = prior.camera_from_lps.transform_point(self.layout.centroid_lps_mm()).z;
            if !(depth_mm > 0.0) {
                return Some(Refusal::BehindSource { depth_mm });
            }
        }
        if self.fuse && self.prior.is_none() {
            return Some(Refusal::Prior { detail: "fusing needs a prior".to_owned() });
        }
        let unknown = |given: &&Correspondence| !self.layout.beads.iter().any(|bead| bead.name == given.bead);
        if let Some(unknown) = self.correspondences.iter().find(unknown) {
            return Some(Refusal::Correspondences { detail: format!("the layout has no bead called {:?}", unknown.bead) });
        }
        None
    }

    /// Whether no pixel of the frame lies there.
    pub(super) fn is_outside(&self, at: DVec2) -> bool {
        let [width, height] = self.size_px.map(f64::from);
        !(at.x >= 0.0 && at.y >= 0.0 && at.x <= width - 1.0 && at.y <= height - 1.0)
    }

    /// A bead that has no part in a pose.
    pub(super) fn row(&self, bead: &Bead, reason: &str) -> BeadResidual {
        BeadResidual {
            name: bead.name.clone(),
            body: bead.body.clone(),
            lps_mm: bead.lps_mm,
            covariance_mm2: bead.stated_mm2(),
            image_px: None,
            predicted_px: None,
            residual_px: None,
            sigma_px: None,
            covariance_px2: None,
            left_out_px: None,
            beside_px: None,
            off_sigmas: None,
            used: false,
            reason: Some(reason.to_owned()),
            check: false,
        }
    }

    /// The answer that there is no pose.
    #[must_use]
    pub fn refuse(&self, refusal: &Refusal) -> Pose {
        let beads = self.layout.beads.iter().map(|bead| self.row(bead, "no pose"));
        let checks = self.layout.checks.iter().map(|bead| BeadResidual { check: true, ..self.row(bead, "no pose") });
        Pose {
            status: Status::Refused,
            reason: Some(refusal.to_string()),
            refusal: Some(refusal.clone()),
            size_px: Some(self.size_px),
            pitch_mm: self.pitch_mm,
            intrinsics: self.intrinsics,
            intrinsics_source: self.intrinsics.map(|_| "given".to_owned()),
            beads: beads.chain(checks).collect(),
            notes: self.layout.notes.clone(),
            version: Some(env!("CARGO_PKG_VERSION").to_owned()),
            ..Pose::default()
        }
    }

    /// Depths at which beads may lie, mm from the source.
    pub(super) fn depth_range_mm(&self, fx: f64) -> (f64, f64) {
        match self.pitch_mm {
            Some(pitch) => (0.2 * fx * pitch, 1.02 * fx * pitch),
            None => (150.0, 2500.0),
        }
    }

    /// What leaves fewer shadows to be tried, of that which is not given already; `or_prior`: a prior does too.
    pub(super) fn fewer_shadows(&self, or_prior: bool) -> &'static str {
        let is_sized = (0..self.layout.beads.len()).all(|bead| self.layout.radius_mm(bead, self.bead_radius_mm).is_some());
        match (is_sized, or_prior && self.prior.is_none()) {
            (true, false) => "narrow the collimator",
            (true, true) => "narrow the collimator, or give --prior",
            (false, false) => "narrow the collimator, or give --bead-radius (bead_radius_mm in a session)",
            (false, true) => "narrow the collimator, or give --bead-radius (bead_radius_mm in a session) and --prior",
        }
    }

    /// Size of the beads' shadows.
    pub(super) fn expectation(&self) -> Expectation {
        Expectation { radius_px: self.radius_px(), ..Expectation::default() }
    }

    fn radius_px(&self) -> Option<(f64, f64)> {
        let fx = self.intrinsics?.fx;
        let mut radii = Vec::new();
        for index in 0..self.layout.beads.len() {
            radii.push(self.layout.radius_mm(index, self.bead_radius_mm)?);
        }
        let (near, far) = match self.prior {
            Some(prior) => {
                let depth = |p: DVec3| prior.camera_from_lps.transform_point(p).z;
                let depths: Vec<f64> = self.layout.beads.iter().map(|bead| depth(bead.lps_mm)).collect();
                let fold = |start: f64, f: fn(f64, f64) -> f64| depths.iter().copied().fold(start, f);
                ((0.6 * fold(f64::INFINITY, f64::min)).max(100.0), 1.5 * fold(0.0, f64::max))
            }
            None => self.depth_range_mm(fx),
        };
        let fold = |start: f64, f: fn(f64, f64) -> f64| radii.iter().copied().fold(start, f);
        Some((fx * fold(f64::INFINITY, f64::min) / far, fx * fold(0.0, f64::max) / near.max(1.0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_given_already_is_not_advised() {
        let layout = BeadLayout { beads: vec![Bead::new("a", DVec3::ZERO)], ..BeadLayout::none() };
        let unsized_beads = Registration::new([64, 48], &layout);
        assert!(unsized_beads.fewer_shadows(true).ends_with("--bead-radius (bead_radius_mm in a session) and --prior"));
        let sized = Registration { bead_radius_mm: Some(0.75), ..unsized_beads };
        assert_eq!(sized.fewer_shadows(true), "narrow the collimator, or give --prior");
        assert_eq!(sized.fewer_shadows(false), "narrow the collimator");
    }
}
