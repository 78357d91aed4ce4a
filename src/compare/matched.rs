//! From a scene at a pose to what its comparison needs besides the two images: marks of the beads, the tool's mask, coarse renders for
//! the null. A session and the command `compare` come through here alike.

use std::sync::Arc;

use glam::DVec2;

use crate::geometry::{Distortion, Intensifier, View};
use crate::image::Image;
use crate::pose::{BeadResidual, Pose};
use crate::render::{Options, Plan, Quantity, Renderer, Scatter};
use crate::scene::model::{Matter, Noise, Object, ScatterModel};
use crate::scene::{Scene, SceneError};

/// Blur that a bead's shadow is widened by, px.
const BEAD_BLUR_PX: f64 = 1.5;
/// Radius of a bead that nothing is known of, mm.
const BEAD_RADIUS_MM: f64 = 1.0;

/// The intensifier through which `scene` is seen at the size of `view`.
fn seen_through(scene: &Scene, view: &View) -> Option<Intensifier> {
    scene.detector.panel.intensifier.as_ref().and_then(|intensifier| intensifier.for_size(view.size_px).ok())
}

/// The scene as an image by `pose` shows it: from `view`, the pose's own, one of larger pixels, or telemetry's where the pose is refused; on a
/// panel at the pose's distance, every body where the pose has it, through the part of the intensifier that the pose's frame shows.
///
/// # Errors
/// When a body has moved that the scene does not know, or the intensifier was measured in another picture than the panel's.
pub fn posed_scene(scene: &Scene, pose: &Pose, view: View) -> Result<Scene, SceneError> {
    let mut scene = scene.with_bodies(&pose.places())?.with_view(view);
    // Pixels that the console binned or enlarged are not the panel's.
    let console = pose.console.as_ref().zip(pose.size_px);
    let step = console.map_or(1.0, |(console, size_px)| console.window(console.stored_size(size_px)).step);
    let pitch_mm = pose.pitch_mm.unwrap_or(scene.detector.pitch_mm * step);
    // Larger pixels lie on the same panel.
    scene.detector.pitch_mm = pose.intrinsics.map_or(pitch_mm, |k| pitch_mm * (k.fx / view.intrinsics.fx));
    let through = scene.detector.panel.intensifier.take().map(|whole| pose.frame_seen_through(&whole)).transpose();
    scene.detector.panel.intensifier = through
        .map_err(|source| SceneError::Intensifier { place: "detector.intensifier".to_owned(), source: Box::new(source) })?;
    Ok(scene)
}

/// Centre and radius of the shadow of each bead that `pose` lists, in the frame of `view`, px, where the intensifier of `scene` shows it;
/// beads behind the source or outside the intensifier's disc have none. A bead is as large as `stated_mm` says of its name, else as the
/// shadow that was matched to it.
#[must_use]
pub fn bead_marks(pose: &Pose, view: &View, scene: Option<&Scene>, stated_mm: impl Fn(&str) -> Option<f64>) -> Vec<(DVec2, f64)> {
    let projection = view.projection();
    let full_fx = pose.intrinsics.map_or(view.intrinsics.fx, |k| k.fx);
    let through = scene.and_then(|scene| seen_through(scene, view));
    let shown = |pixel| Distortion::shown(through.as_ref().map(|through| &through.distortion), pixel);
    let mark = |bead: &BeadResidual| {
        let (pixel, depth_mm) = projection.project(pose.place_of(&bead.body, bead.lps_mm));
        let shadow = pose.shadows.iter().find(|shadow| shadow.bead.as_ref() == Some(&bead.name));
        let seen_mm = shadow.map(|shadow| shadow.radius_px * depth_mm / full_fx);
        let radius_px = stated_mm(&bead.name).or(seen_mm).unwrap_or(BEAD_RADIUS_MM) * view.intrinsics.fx / depth_mm;
        (depth_mm > 0.0).then(|| Some((shown(pixel)?, radius_px + BEAD_BLUR_PX))).flatten()
    };
    pose.beads.iter().filter_map(mark).collect()
}

/// Pixels of the scene's view that the robot's pieces may cover: the discs of their bounding spheres. `None` without a robot, or a view.
#[must_use]
pub fn tool_mask(scene: &Scene) -> Option<Image<bool>> {
    let (robot, view) = scene.robot.as_ref().zip(scene.view.as_ref())?;
    let Matter::Solids(solids) = &scene.objects[robot.object].matter else { return None };
    let [width, height] = view.size_px.map(|n| n as usize);
    let mut mask = Image::filled(width, height, false);
    let projection = view.projection();
    for solid in solids {
        let (centre, radius_mm) = solid.shape.bounding_sphere();
        let (pixel, depth_mm) = projection.project(solid.lps_from_local.transform_point(centre));
        if !(depth_mm > radius_mm) {
            continue;
        }
        let radius = radius_mm * view.intrinsics.fx / depth_mm;
        let rows = (pixel.y - radius).max(0.0) as usize..((pixel.y + radius).max(-1.0) + 1.0).min(height as f64) as usize;
        for row in rows {
            let half = (radius * radius - (row as f64 - pixel.y).powi(2)).max(0.0).sqrt();
            let columns = (pixel.x - half).max(0.0) as usize..((pixel.x + half).max(-1.0) + 1.0).min(width as f64) as usize;
            for column in columns {
                *mask.at_mut(column, row) = true;
            }
        }
    }
    let Some(through) = seen_through(scene, view) else { return Some(mask) };
    let straight = |index: usize| {
        let there = through.distortion.undistorted(DVec2::new((index % width) as f64, (index / width) as f64)).round();
        there.min_element() >= 0.0
            && there.x < width as f64
            && there.y < height as f64
            && *mask.at(there.x as usize, there.y as usize)
    };
    Some(Image { width, height, pixels: (0..width * height).map(straight).collect() })
}

/// Says the scatter of a scene that is seen in a view; `None` where nobody knows.
pub type SayScatter<'a> = dyn Fn(&Scene, &View) -> Option<Scatter> + 'a;

/// The scatter in renders for a null.
#[derive(Clone, Default)]
pub struct NullScatter<'a> {
    /// That of the DRR, which poses near to its own have too; without it there is none in any.
    pub near: Option<Arc<Scatter>>,
    /// Says that of a pose far away, such as one for a layout turned about; where nobody does, there is none.
    pub far: Option<&'a SayScatter<'a>>,
}

/// How far a pose may be from the DRR's with its scatter: scatter is smooth over centimetres.
const NEAR_MM: f64 = 20.0;
const NEAR_DEG: f64 = 5.0;
const NEAR_SHARE: f64 = 0.02;

impl NullScatter<'_> {
    /// Of `scene`, whose own view is `view`; the DRR is seen in `drr`.
    fn of(&self, scene: &Scene, view: &View, drr: Option<&View>) -> Option<Arc<Scatter>> {
        let near = self.near.as_ref()?;
        if drr.is_some_and(|drr| is_near(drr, view)) {
            return Some(Arc::clone(near));
        }
        self.far.and_then(|say| say(scene, view)).map(Arc::new)
    }
}

/// Whether two views, perhaps of other pixels, show the same from about the same place.
fn is_near(a: &View, b: &View) -> bool {
    let turn_deg = a.camera_from_lps.rotation.angle_between(b.camera_from_lps.rotation).to_degrees();
    let centre = |view: &View| view.camera_from_lps.inverse().translation_mm;
    let shares = |view: &View| {
        let (k, [width, height]) = (view.intrinsics, view.size_px.map(f64::from));
        [(k.cx + 0.5) / width, (k.cy + 0.5) / height, k.fx / width, k.fy / height]
    };
    let apart = shares(a).iter().zip(shares(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    turn_deg <= NEAR_DEG && centre(a).distance(centre(b)) <= NEAR_MM && apart <= NEAR_SHARE
}

/// Renders of one scene from poses about its own, for a null.
pub struct NullRenders<'a> {
    renderer: &'a mut Renderer,
    scene: &'a Scene,
    scatter: NullScatter<'a>,
    plan: Option<Plan>,
    /// The scene's, as the stated pose sees them, for all.
    objects: Option<Vec<Object>>,
}

impl<'a> NullRenders<'a> {
    /// `scene` has the view of the DRR, on its panel; `plan` is what rendered it: nothing is planned anew by what this machine is fast
    /// at, so that two replays agree. Without one, one is made for all.
    pub fn new(renderer: &'a mut Renderer, scene: &'a Scene, plan: Option<Plan>, scatter: NullScatter<'a>) -> Self {
        Self { renderer, scene, scatter, plan: plan.map(|plan| plan.whole()), objects: None }
    }

    /// The line integral from `view`, on the same panel; NaN where it is not known. There is no noise in it: it would only blur the null.
    ///
    /// # Errors
    /// As the renderer's, in words.
    pub fn render(&mut self, view: &View) -> Result<Image<f32>, String> {
        let mut coarse = self.scene.with_binned_view(*view);
        coarse.model.noise = Noise::Off;
        let scatter = self.scatter.of(&coarse, view, self.scene.view.as_ref());
        coarse.objects.clone_from(self.objects.get_or_insert_with(|| self.renderer.thinned(self.scene, view)));
        if scatter.is_none() {
            coarse.model.scatter = ScatterModel::Off;
        }
        let options = Options { quantity: Quantity::LineIntegral, scatter, beside: true, ..Options::default() };
        let plan = match &self.plan {
            Some(plan) => plan.clone(),
            None => self.renderer.plan(&coarse, &options).map_err(|error| error.to_string())?.whole(),
        };
        self.plan = Some(plan.clone());
        let options = Options { plan: Some(Plan { size_px: view.size_px, ..plan }), ..options };
        let rendered = self.renderer.render(&coarse, &options).map_err(|error| error.to_string())?;
        let mut page = rendered.pages.into_iter().next().ok_or_else(|| "no page".to_owned())?;
        let invalid = rendered.valid.pixels.iter().map(|valid| *valid == 0);
        page.pixels.iter_mut().zip(invalid).filter(|(_, invalid)| *invalid).for_each(|(pixel, _)| *pixel = f32::NAN);
        Ok(page)
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::beads::{Bead, BeadLayout};
    use crate::geometry::{ConsoleGeometry, Intrinsics, Rigid};
    use crate::pose::{Refusal, Registration, Shadow};
    use crate::render::Origin;
    use crate::scene::physics::Spectrum;

    /// 5000 px of 0.2 mm are 1 m from the source.
    fn full_view() -> View {
        let camera_from_lps = Rigid::translation(DVec3::Z * 600.0);
        View {
            size_px: [100, 80],
            intrinsics: Intrinsics { fx: 5000.0, fy: 5000.0, skew: 0.0, cx: 49.5, cy: 39.5 },
            camera_from_lps,
        }
    }

    /// A session scaled the scene's pitch by the console's binning, a command by K, and each knew less than the other.
    #[test]
    fn the_panel_stays_where_it_is_whatever_a_pixel_is() {
        let mut scene = Scene::plain(Spectrum::mono(60.0).expect("inside"));
        scene.detector.pitch_mm = 0.2;
        let full = full_view();
        let binned = View { size_px: [50, 40], intrinsics: full.intrinsics.binned(2.0), ..full };
        let of = |view: &View| Pose { intrinsics: Some(view.intrinsics), size_px: Some(view.size_px), ..Pose::default() };
        let console = ConsoleGeometry { binning: 2, ..ConsoleGeometry::default() };
        let cases = [
            ("whole", of(&full), full),
            ("refused", Pose { intrinsics: None, ..of(&full) }, full),
            ("a coarser image of it", of(&full), binned),
            ("binned by the console", Pose { console: Some(console), ..of(&binned) }, binned),
            ("binned, and the pose says so", Pose { pitch_mm: Some(0.4), ..of(&binned) }, binned),
        ];
        let distance_mm = |pose: &Pose, view: View| {
            let posed = posed_scene(&scene, pose, view).expect("nothing has moved");
            view.intrinsics.source_to_detector_mm(posed.detector.pitch_mm)
        };
        for (name, pose, view) in &cases {
            assert!((distance_mm(pose, *view) - 1000.0).abs() < 1e-9, "{name}: {}", distance_mm(pose, *view));
        }
        assert!((distance_mm(&of(&binned), binned) - 500.0).abs() < 1e-9, "the control: nobody says that its pixels are large");
    }

    /// A session took the stated radius or 1 mm, a command the shadow's or 1 mm.
    #[test]
    fn a_bead_is_as_large_as_it_is_stated_to_be_else_as_it_is_seen() {
        let (lps_mm, full) = (DVec3::ZERO, full_view());
        let bead = |name: &str| Bead::new(name, lps_mm);
        let layout = BeadLayout { beads: ["stated", "seen", "neither"].map(bead).to_vec(), ..BeadLayout::none() };
        let rows = Registration::new(full.size_px, &layout).refuse(&Refusal::Fault { detail: "not looked for".to_owned() });
        let shadow = |name: &str| Shadow {
            image_px: [49.5, 39.5],
            sigma_px: 0.1,
            covariance_px2: None,
            radius_px: 12.0,
            snr: 30.0,
            bead: Some(name.to_owned()),
            ..Shadow::default()
        };
        let shadows = ["stated", "seen"].map(shadow).to_vec();
        let pose = Pose { shadows, intrinsics: Some(full.intrinsics), ..rows };
        // In an image of half as many pixels a side.
        let view = View { size_px: [50, 40], intrinsics: full.intrinsics.binned(2.0), ..full };
        let marks = bead_marks(&pose, &view, None, |name| (name == "stated").then_some(0.9));
        let radii_px: Vec<f64> = marks.iter().map(|(_, radius_px)| radius_px - BEAD_BLUR_PX).collect();
        for (found, expected) in radii_px.iter().zip([0.9 * 2500.0 / 600.0, 6.0, 2500.0 / 600.0]) {
            assert!((found - expected).abs() < 1e-9, "{radii_px:?}");
        }
        assert_eq!(marks.len(), 3);
    }

    /// Near poses have the DRR's scatter, at whatever size; others what somebody says of them, or none.
    #[test]
    fn scatter_goes_with_poses_that_are_near() {
        let view = |size: u32, deg: f64, mm: f64, cx: f64| View {
            size_px: [size, size],
            intrinsics: Intrinsics {
                fx: 2.0 * f64::from(size),
                fy: 2.0 * f64::from(size),
                skew: 0.0,
                cx: cx * f64::from(size),
                cy: 0.0,
            },
            camera_from_lps: Rigid {
                rotation: DQuat::from_rotation_y(deg.to_radians()),
                translation_mm: DVec3::new(mm, 0.0, 700.0),
            },
        };
        let image = |value: f64| Image { width: 1, height: 1, pixels: vec![value] };
        let scatter = |value: f64| Scatter {
            signal: image(value),
            error: image(0.0),
            unattenuated: image(1.0),
            from: Origin::Photons { histories: 1, seed: 1, device: "cpu".to_owned() },
            relative_error: 0.0,
        };
        let (scene, drr) = (Scene::plain(Spectrum::mono(60.0).expect("inside")), view(640, 0.0, 0.0, 0.5));
        let say = |_: &Scene, _: &View| Some(scatter(2.0));
        let told = NullScatter { near: Some(Arc::new(scatter(1.0))), far: Some(&say) };
        let untold = NullScatter { far: None, ..told.clone() };
        let value = |of: &NullScatter, view: &View| of.of(&scene, view, Some(&drr)).map(|found| found.signal.pixels[0]);
        for near in [view(640, 0.0, 0.0, 0.5), view(80, 0.0, 10.0, 0.505), view(640, 0.5, 0.0, 0.5)] {
            assert_eq!((value(&told, &near), value(&untold, &near)), (Some(1.0), Some(1.0)));
        }
        for far in [view(640, 180.0, 0.0, 0.5), view(640, 0.0, 30.0, 0.5), view(640, 0.0, 0.0, 0.6)] {
            assert_eq!((value(&told, &far), value(&untold, &far)), (Some(2.0), None));
        }
        assert_eq!(value(&NullScatter { near: None, ..told }, &drr), None, "without scatter in the DRR");
    }
}
