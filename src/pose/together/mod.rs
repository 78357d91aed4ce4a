//! Several views of one bead set, solved together: a camera each, K and bead places in common.
//!
//! Every view is first registered alone; those refused stay out. What they found is solved in one problem, in which every bead may leave
//! its place in the layout by its stated uncertainty. That tells apart what a single view cannot: a bead that is elsewhere in all views
//! alike has migrated since the scan, a shadow that is off in one view is none of the bead's, and a body whose beads are together
//! elsewhere from some view on has been bumped. A specimen of one body that is bumped as a whole shows only against the room, where the
//! views have priors.

mod bumps;
mod record;
mod setup;
mod sought;
mod strays;
mod views;

pub use record::{Against, BeadVerdict, Bump, SolvedBead, Together, TogetherRefusal};

use glam::DVec2;

use super::bodies::names;
use super::doubt::{UNLIKELY_OF_MANY, chi2_sigmas};
use super::judge::MOST_CHI2_PER_DOF;
use super::prior::Prior;
use super::record::{Pose, Status};
use super::solve::{Free, IntrinsicsPrior};
use crate::beads::{BeadLayout, Landmark};
use crate::estimate::EstimateError;
use crate::mask::Disc;
use setup::{Observation, Setup, scale_of, solved};
use views::Common;

/// Fewest views, and fewest beads that two of them share.
const FEWEST_VIEWS: usize = 2;
const FEWEST_SHARED: usize = 3;

/// A view, registered alone.
#[derive(Clone, Debug)]
pub struct ViewAlone {
    /// What messages call it: the frame's path.
    pub name: String,
    /// Its own pose, or its refusal.
    pub pose: Pose,
    /// Where the room says its camera is.
    pub prior: Option<Prior>,
    /// Of a frame that an image intensifier may have taken, in its pixels: what [`super::Registration::round_field_of`] says.
    pub round_field: Option<Disc>,
    /// Whether its K is its header's, as [`super::Registration::is_k_of_header`] has it.
    pub is_k_of_header: bool,
}

/// What is asked.
#[derive(Clone, Copy, Debug)]
pub struct SeveralViews<'a> {
    /// The beads; the covariance of its place says how far each may leave it.
    pub layout: &'a BeadLayout,
    /// How sure the K is that all views share; `None`: each view's own K is known, or was solved, in which case they share one unknown K.
    pub intrinsics_prior: Option<IntrinsicsPrior>,
    /// Where uncertainty is wanted.
    pub landmarks: &'a [Landmark],
    /// In the order in which they were taken.
    pub views: &'a [ViewAlone],
}

/// Solves several views together. A refusal is a result, not an error.
#[must_use]
pub fn register_together(request: &SeveralViews) -> Together {
    request.attempt().unwrap_or_else(|refusal| Together {
        status: Status::Refused,
        reason: Some(refusal.to_string()),
        refusal: Some(refusal),
        views: request.views.iter().map(|view| view.pose.clone()).collect(),
        ..request.empty()
    })
}

fn unsolved(error: EstimateError) -> TogetherRefusal {
    TogetherRefusal::Unsolved { detail: error.to_string() }
}

impl SeveralViews<'_> {
    fn empty(&self) -> Together {
        let frames = self.views.iter().map(|view| view.name.clone()).collect();
        Together { frames, version: Some(env!("CARGO_PKG_VERSION").to_owned()), ..Together::default() }
    }

    fn attempt(&self) -> Result<Together, TogetherRefusal> {
        let accepted: Vec<usize> = (0..self.views.len()).filter(|n| self.views[*n].pose.camera().is_some()).collect();
        if accepted.len() < FEWEST_VIEWS {
            let (given, required) = (self.views.len(), FEWEST_VIEWS);
            return Err(TogetherRefusal::TooFewViews { given, accepted: accepted.len(), required });
        }
        let poses: Vec<&Pose> = accepted.iter().map(|n| &self.views[*n].pose).collect();
        let mut setup = self.setup(&poses)?;
        let mut bumps = Vec::new();
        let missing: Vec<usize> = (0..self.layout.beads.len()).filter(|n| self.may_be_elsewhere(&setup, &poses, *n)).collect();
        let mut unclear = Vec::new();
        if !setup.segments.is_empty() || !missing.is_empty() {
            let mut apart = setup.clone();
            // A body's beads count only where its own place is solved.
            let whole = |own: &Observation| {
                let body = &setup.layout.beads[own.bead].body;
                setup.segment_of(own.view, own.bead).is_some() || setup.segments.iter().all(|segment| segment.body != *body)
            };
            apart.observations.retain(whole);
            strays::sort(&mut apart).map_err(unsolved)?;
            let (problem, blocks) = apart.problem();
            let (estimate, covariance) = solved(&problem).map_err(unsolved)?;
            apart.take(&estimate, &blocks);
            let found = sought::seek(&apart, &poses, &missing);
            // Seen where it should be by fewer views than not: these are not believed against the others.
            let is_found = |bead: usize| found.iter().any(|sought| sought.bead == bead);
            unclear.extend(missing.iter().copied().filter(|n| !is_found(*n) && setup.seen_in(*n).next().is_some()));
            setup.observations.retain(|own| !missing.contains(&own.bead));
            for sought::Sought { bead, place_mm, observations } in found {
                setup.observations.extend(observations);
                setup.places_mm[bead] = place_mm;
                setup.freed[bead] = true;
            }
            (setup.segments, bumps) = bumps::joined(&apart, &blocks, &estimate, &covariance);
            setup.cameras = apart.cameras;
        }
        let mut sorted = strays::sort(&mut setup).map_err(unsolved)?;
        unclear.into_iter().for_each(|bead| sorted.verdicts[bead] = Some(BeadVerdict::Unclear));
        let (problem, blocks) = setup.problem();
        let (estimate, covariance) = solved(&problem).map_err(unsolved)?;
        setup.take(&estimate, &blocks);
        let chi2_per_dof = estimate.chi2_sum() / estimate.degrees_of_freedom().max(1) as f64;
        if !(chi2_per_dof <= MOST_CHI2_PER_DOF) {
            let (views, times, limit) = (poses.len(), chi2_per_dof.sqrt(), MOST_CHI2_PER_DOF.sqrt());
            return Err(TogetherRefusal::Residual { views, times, limit });
        }
        let priors: Vec<Option<Prior>> = accepted.iter().map(|n| self.views[*n].prior).collect();
        bumps.extend(bumps::against_room(&setup, &blocks, &estimate, &covariance, &priors));
        for bump in &mut bumps {
            bump.from_view = accepted[bump.from_view];
        }
        let round_fields: Vec<Option<Disc>> = accepted.iter().map(|n| self.views[*n].round_field).collect();
        let are_k_of_header: Vec<bool> = accepted.iter().map(|n| self.views[*n].is_k_of_header).collect();
        let common = Common {
            setup: &setup,
            blocks: &blocks,
            estimate: &estimate,
            covariance: &covariance,
            scale: scale_of(&estimate),
            sorted: &sorted,
            landmarks: self.landmarks,
            round_fields: &round_fields,
            are_k_of_header: &are_k_of_header,
        };
        let mut views: Vec<Pose> = self.views.iter().map(|view| view.pose.clone()).collect();
        for (n, view) in accepted.iter().enumerate() {
            views[*view] = common.pose(n, poses[n]);
        }
        let beads: Vec<SolvedBead> = (0..self.layout.beads.len()).map(|n| common.solved(n)).collect();
        let shared = setup.free != Free::Pose || setup.intrinsics.windows(2).all(|pair| pair[0] == pair[1]);
        let mut together = Together {
            status: Status::Accepted,
            intrinsics: shared.then(|| setup.intrinsics[0]),
            intrinsics_sigma_px: common.intrinsics_sigma_px(),
            chi2_per_dof: Some(chi2_per_dof),
            degrees_of_freedom: Some(estimate.degrees_of_freedom()),
            views,
            beads,
            bumps,
            ..self.empty()
        };
        together.cautions = self.cautions(&together, &accepted, &sorted.aside);
        let in_doubt = |(n, pose): (usize, &Pose)| {
            let words = pose.doubt.as_ref().filter(|_| pose.is_accepted())?;
            Some(format!("view {} ({}) is in doubt: {words}", n + 1, self.views[n].name))
        };
        let doubts: Vec<String> = together.views.iter().enumerate().filter_map(in_doubt).collect();
        together.doubt = doubts.first().cloned();
        together.cautions.extend(doubts);
        if chi2_sigmas(chi2_per_dof, estimate.degrees_of_freedom()) > UNLIKELY_OF_MANY {
            together.cautions.push(format!(
                "the views agree {:.1} times worse than noise and bead positions allow: did several beads move together, or do their sigma_mm promise too much?",
                chi2_per_dof.sqrt()
            ));
        }
        Ok(together)
    }

    /// Whether a bead is nowhere seen, or in no more views than those that show a shadow that is nobody's beside its place.
    fn may_be_elsewhere(&self, setup: &Setup, poses: &[&Pose], bead: usize) -> bool {
        let name = &self.layout.beads[bead].name;
        let beside =
            |pose: &&&Pose| pose.beads.iter().any(|row| row.name == *name && row.image_px.is_none() && row.beside_px.is_some());
        let seen = setup.seen_in(bead).count();
        seen <= poses.iter().filter(beside).count()
    }

    /// Everything as the views alone have it.
    fn setup(&self, poses: &[&Pose]) -> Result<Setup<'_>, TogetherRefusal> {
        let solved_alone = poses.iter().any(|pose| pose.intrinsics_sigma_px.is_some());
        let free = match self.intrinsics_prior {
            Some(prior) => Free::Known(prior),
            None if solved_alone => Free::Square,
            None => Free::Pose,
        };
        let (intrinsics, cameras): (Vec<_>, Vec<_>) = poses.iter().filter_map(|pose| pose.camera()).unzip();
        let mut observations = Vec::new();
        for (view, pose) in poses.iter().enumerate() {
            for (bead, own) in self.layout.beads.iter().enumerate() {
                let row = pose.beads.iter().find(|row| row.name == own.name);
                let seen = row.and_then(|row| Some((row.image_px?, row.sigma_px?, row.noise_px2()?)));
                if let Some((at, sigma_px, noise_px2)) = seen {
                    observations.push(Observation { view, bead, image_px: DVec2::from_array(at), sigma_px, noise_px2 });
                }
            }
        }
        let beads = &self.layout.beads;
        let mut setup = Setup {
            layout: self.layout,
            cameras,
            intrinsics,
            free,
            observations,
            segments: Vec::new(),
            freed: vec![false; beads.len()],
            places_mm: beads.iter().map(|bead| bead.lps_mm).collect(),
        };
        let shared = (0..beads.len()).filter(|n| setup.seen_in(*n).count() >= 2).count();
        if shared < FEWEST_SHARED {
            return Err(TogetherRefusal::TooFewShared { shared, required: FEWEST_SHARED });
        }
        bumps::each_view(&mut setup, poses);
        if let Free::Known(prior) = free {
            setup.intrinsics.fill(prior.mean);
        } else if free == Free::Square {
            let first = setup.intrinsics[0];
            setup.intrinsics.fill(first);
        }
        Ok(setup)
    }

    fn cautions(&self, together: &Together, accepted: &[usize], aside: &[strays::LeftAside]) -> Vec<String> {
        let mut cautions = Vec::new();
        for (view, own) in self.views.iter().enumerate().filter(|(view, _)| !accepted.contains(view)) {
            let why = own.pose.reason.as_deref().unwrap_or("no reason given");
            cautions.push(format!("view {} ({}) is left out, it is refused alone: {why}", view + 1, own.name));
        }
        for bead in &together.beads {
            match bead.verdict {
                BeadVerdict::Migrated => {
                    let SolvedBead { name, moved_mm, views, .. } = bead;
                    cautions.push(format!("{name} has migrated by {moved_mm:.2} mm since the scan, as {views} views agree"));
                }
                BeadVerdict::Inconsistent => cautions.push(format!("no one place explains the shadows of {}", bead.name)),
                BeadVerdict::Unclear => cautions.push(format!(
                    "{} has moved, or one of its shadows is not its own: these views cannot tell which",
                    bead.name
                )),
                BeadVerdict::InPlace | BeadVerdict::NotSeen => {}
            }
        }
        for left in aside.iter().filter(|left| together.beads[left.bead].verdict == BeadVerdict::InPlace) {
            let (view, name) = (accepted[left.view], &together.beads[left.bead].name);
            cautions.push(format!(
                "in view {} ({}) the shadow taken for {name} is {:.2} px from where the other views put it",
                view + 1,
                self.views[view].name,
                left.off_px
            ));
        }
        let reference = names(self.layout).into_iter().next().unwrap_or_default();
        for Bump { body, against, from_view, angle_deg, shift_mm, .. } in &together.bumps {
            let than = match against {
                Against::Body { name } => name.clone(),
                Against::Room => "the room".to_owned(),
            };
            let all = names(self.layout).len() > 2
                && names(self.layout)
                    .iter()
                    .filter(|name| **name != reference)
                    .all(|name| together.bumps.iter().any(|other| other.from_view == *from_view && other.body == *name));
            let or = if all { format!(", as did all others: it may be {reference} that moved") } else { String::new() };
            cautions.push(format!(
                "{body} moved against {than} before view {} ({}), by {angle_deg:.2}° and {shift_mm:.2} mm{or}",
                from_view + 1,
                self.views[*from_view].name
            ));
        }
        cautions
    }
}
