//! What the pose of a frame rests on, kept so that the frame can be posed again with what a person says of its beads.

use std::sync::Arc;

use super::posed::Posed;
use super::posing::{PoseJob, Registered, Used};
use super::shown::Shown;
use super::tie::Disagreement;
use crate::pose::{HandMark, Pose, Registration, register_edited};

/// See the module. It is fixed when the frame is first posed: later frames change nothing in it.
#[derive(Clone, Debug)]
pub(super) struct Basis {
    job: PoseJob,
    shown: Option<Arc<Shown>>,
}

impl Basis {
    /// Of what was registered.
    pub(super) fn of(registered: &Registered) -> Self {
        let (job, shown) = registered.rests_on();
        Self { job: job.clone(), shown: shown.cloned() }
    }

    /// Whether a pose may rest on a bead of this name.
    pub(super) fn knows(&self, bead: &str) -> bool {
        let layout = self.job.known().layout.as_ref();
        layout.is_some_and(|layout| layout.beads.iter().any(|known| known.name == bead))
    }

    /// The pose with what a hand says in `marks`, of a frame that gave `automatic` by itself.
    pub(super) fn edited(&self, marks: &[HandMark], automatic: &Posed) -> Pose {
        self.job.asking(|registration| {
            let register = |request: &Registration| self.job.posed(request, &automatic.masks, self.shown.as_deref());
            register_edited(registration, marks, &automatic.pose, &register)
        })
    }

    /// The frame `before` with another pose.
    pub(super) fn posed_by(&self, pose: Pose, before: Posed) -> Posed {
        let Used { pose_source, view, world_from_lps } = self.job.used(&pose);
        let known = self.job.known();
        let tied = known.world_from_lps.zip(world_from_lps).zip(known.layout.as_ref());
        let telemetry_disagreement =
            tied.and_then(|((tied, seen), layout)| Disagreement::where_they_disagree(&tied, &seen, layout.centroid_lps_mm()));
        Posed { pose, pose_source, view, telemetry_disagreement, ..before }
    }
}
