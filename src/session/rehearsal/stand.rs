//! How arm, panel and specimen stand to each other in a rehearsed exposure.

use glam::DVec3;

use crate::acquire::{Domain, Frame, FrameTags};
use crate::geometry::{AnglesFrom, CarmJoints, Intensifier, View};
use crate::image::Image;
use crate::scene::Scene;
use crate::session::crosscheck::{choose_view, first_joints};
use crate::session::file::Setup;
use crate::session::intensifier::seen_through;

/// See the module.
pub(super) struct Stand {
    /// Of the frame as it lies on the panel.
    pub view: View,
    /// Of the frame's pixels.
    pub pitch_mm: f64,
    /// What the arm's telemetry tells; `None` without an arm.
    pub joints: Option<CarmJoints>,
    /// Where that has the specimen.
    pub world_from_lps: Option<[[f64; 4]; 4]>,
    /// Columns and rows that the console stores; `None` where no console is declared.
    pub stored_px: Option<[u32; 2]>,
    /// What an image intensifier does to the frame.
    pub intensifier: Option<Intensifier>,
    /// It asks the frame's header for the angles.
    pub by_positioner: bool,
}

impl Stand {
    /// For a session whose beads are at these `places`. A console that is declared by a matrix says no size, and is left out of `setup`.
    ///
    /// # Errors
    /// In words, when calibrations contradict each other or give no K.
    pub(super) fn of(setup: &mut Setup, places: &[DVec3], scene: &Scene) -> Result<Self, String> {
        let panel_px = setup.carm.as_ref().map(|carm| [carm.columns_px, carm.rows_px]);
        let console = setup.session.console.as_ref();
        let stored_px = console.zip(panel_px).and_then(|(console, panel_px)| console.stored_px(panel_px));
        let carm = match (&setup.carm, console.zip(stored_px)) {
            (Some(carm), Some((console, stored_px))) => {
                Some(console.calibration_of(carm, stored_px).map_err(|error| error.to_string())?)
            }
            (carm, _) => carm.clone(),
        };
        if stored_px.is_none() {
            setup.session.console = None;
        }
        // The rehearsed frame is of its own size, and its header, or the arm, tells its K.
        setup.intrinsics = None;
        let view = choose_view(carm.as_ref(), setup.session.world_from_lps, places, scene)?;
        let joints = carm.as_ref().map(first_joints);
        let camera = carm.as_ref().zip(joints).map(|(carm, joints)| carm.world_from_camera(&joints));
        let world_from_camera = camera.transpose().map_err(|error| error.to_string())?;
        let by_positioner = setup.intensifier.as_ref().is_some_and(|own| own.angles_from == AnglesFrom::Positioner);
        Ok(Self {
            view,
            pitch_mm: carm.as_ref().map_or(scene.detector.pitch_mm, |carm| carm.pitch_mm),
            joints,
            world_from_lps: world_from_camera.map(|world_from_camera| (world_from_camera * view.camera_from_lps).to_rows()),
            stored_px,
            intensifier: intensifier(setup, stored_px.unwrap_or(view.size_px), panel_px, joints.as_ref())?,
            by_positioner,
        })
    }
}

/// What the session's intensifier does to a frame that is stored with `stored_px`, the arm at zero.
fn intensifier(
    setup: &Setup,
    stored_px: [u32; 2],
    panel_px: Option<[u32; 2]>,
    joints: Option<&CarmJoints>,
) -> Result<Option<Intensifier>, String> {
    let Some(calibration) = setup.intensifier.as_deref() else { return Ok(None) };
    let [columns, rows] = stored_px.map(|side| side as usize);
    let blank = Frame::from_pixels("rehearsed", Image::filled(columns, rows, 1.0f32), Domain::Linear);
    let mut blank = blank.map_err(|error| error.to_string())?;
    blank.tags = FrameTags { primary_deg: Some(0.0), secondary_deg: Some(0.0), ..FrameTags::default() };
    if let Some(console) = &setup.session.console {
        blank = blank.oriented(console, panel_px);
    }
    seen_through(calibration, &blank, joints).map(|through| Some(Intensifier::clone(&through)))
}
