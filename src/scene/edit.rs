//! Scenes that change: another view, a bent robot, beads; and where a scene's matter is.

use std::sync::Arc;

use glam::DVec3;

use super::SceneError;
use super::model::{Matter, Object, Robot, Scene, Shape, Solid, Volume};
use super::physics::Material;
use crate::geometry::{Rigid, RobotModelError, RobotShape, View};

impl Scene {
    /// The same scene seen from `view` with larger or smaller pixels on the same panel: the pitch grows as the focal length in pixels
    /// shrinks, so the distance to the detector stays.
    #[must_use]
    pub fn with_binned_view(&self, view: View) -> Self {
        let mut scene = self.with_view(view);
        if let Some(before) = self.view {
            scene.detector.pitch_mm *= before.intrinsics.fx / view.intrinsics.fx;
        }
        scene
    }

    /// The same scene seen from elsewhere.
    #[must_use]
    pub fn with_view(&self, view: View) -> Self {
        Self { view: Some(view), ..self.clone() }
    }

    /// The same scene without its robot.
    #[must_use]
    pub fn without_robot(&self) -> Self {
        let mut scene = self.clone();
        if let Some(robot) = scene.robot.take() {
            scene.objects.remove(robot.object);
        }
        scene
    }

    /// The same scene with its robot bent to `control_angles_deg` as reported, and its base where a tracker has it, if one does:
    /// `lps_from_marker` is what is reported as the base, and the scene's calibration says where the base is in it. Only the robot's
    /// solids are rebuilt; [`Robot::clamped`] of the new scene counts notches at the limit.
    ///
    /// # Errors
    /// When there is no robot, or an angle is not finite.
    pub fn with_robot(&self, control_angles_deg: [f64; 5], lps_from_marker: Option<Rigid>) -> Result<Self, SceneError> {
        let robot = self.robot.as_ref().ok_or(SceneError::NoRobot)?;
        let mut robot = robot.clone();
        robot.control_angles_deg = control_angles_deg;
        robot.lps_from_base = lps_from_marker.map_or(robot.lps_from_base, |marker| marker * robot.marker_from_base);
        let place = self.objects[robot.object].name.clone();
        let solids = robot.bend().map_err(|source| SceneError::Robot { place, source })?;
        let mut scene = self.clone();
        scene.objects[robot.object].matter = Matter::Solids(solids);
        scene.robot = Some(robot);
        Ok(scene)
    }

    /// Adds balls at `centres_and_radii` (lps mm, mm) of `material` at its nominal density, as the last object: they displace all else.
    ///
    /// # Errors
    /// When the material is not known or has no nominal density, or a radius is not positive.
    pub fn add_beads(&mut self, centres_and_radii: &[(DVec3, f64)], material: &str) -> Result<(), SceneError> {
        let physics = |source| SceneError::Physics { place: "beads".to_owned(), source };
        let material = Material::parse(material).map_err(physics)?;
        let density_g_per_cm3 = material.nominal_density_g_per_cm3().map_err(physics)?;
        let index = self.material_index(material);
        let mut solids = Vec::with_capacity(centres_and_radii.len());
        for (number, (centre, radius_mm)) in centres_and_radii.iter().enumerate() {
            if !(centre.is_finite() && *radius_mm > 0.0 && radius_mm.is_finite()) {
                return Err(SceneError::Value {
                    place: format!("bead {number}"),
                    found: format!("a ball of radius {radius_mm} mm at {centre}"),
                    expected: "a finite centre and a positive radius".to_owned(),
                });
            }
            solids.push(Solid {
                shape: Shape::Ellipsoid { semi_axes_mm: DVec3::splat(*radius_mm) },
                lps_from_local: Rigid::translation(*centre),
                material: index,
                density_g_per_cm3,
            });
        }
        if !solids.is_empty() {
            self.objects.push(Object { name: "beads".to_owned(), body: "specimen".to_owned(), matter: Matter::Solids(solids) });
        }
        Ok(())
    }

    /// Index of `material` in the scene's list, appended where it is new.
    pub fn material_index(&mut self, material: Material) -> usize {
        if let Some(index) = self.materials.iter().position(|known| *known == material) {
            return index;
        }
        self.materials.push(material);
        self.materials.len() - 1
    }

    /// Corners of the axis-parallel box around all matter, lps mm; `None` for an empty scene.
    #[must_use]
    pub fn bounds_lps_mm(&self) -> Option<(DVec3, DVec3)> {
        self.objects.iter().filter_map(Object::bounds_lps_mm).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }

    /// Middle and half diagonal (mm) of [`Scene::bounds_lps_mm`]; `None` for an empty scene.
    #[must_use]
    pub fn bounds(&self) -> Option<(DVec3, f64)> {
        self.bounds_lps_mm().map(|(low, high)| (0.5 * (low + high), 0.5 * (high - low).length()))
    }
}

impl Object {
    /// Corners of an axis-parallel box around the object (volumes: the whole grid), lps mm; `None` when it has no extent.
    #[must_use]
    pub fn bounds_lps_mm(&self) -> Option<(DVec3, DVec3)> {
        let corners = self.corners_in_lps();
        Some((corners.iter().copied().reduce(DVec3::min)?, corners.iter().copied().reduce(DVec3::max)?))
    }

    /// Corners of boxes around the object's parts (a mesh: its vertices), lps mm.
    #[must_use]
    pub fn corners_in_lps(&self) -> Vec<DVec3> {
        let corner = |bits: u32| DVec3::new(f64::from(bits & 1), f64::from(bits >> 1 & 1), f64::from(bits >> 2));
        match &self.matter {
            Matter::Volume(_) | Matter::Parts(_) => {
                let around = |volume: &Arc<Volume>| {
                    let (end, affine) = (DVec3::from_array(volume.size.map(|n| n as f64)), volume.lps_from_voxel);
                    (0..8).map(move |bits| affine.transform_point3(corner(bits) * end - 0.5))
                };
                self.matter.volumes().iter().flat_map(around).collect()
            }
            Matter::Solids(solids) => {
                let around = |solid: &Solid| {
                    let (centre, radius_mm) = solid.shape.bounding_sphere();
                    let centre = solid.lps_from_local.transform_point(centre);
                    (0..8).map(move |bits| centre + (corner(bits) * 2.0 - 1.0) * radius_mm)
                };
                solids.iter().flat_map(around).collect()
            }
            Matter::Mesh(mesh) => mesh.vertices_lps_mm.clone(),
        }
    }
}

impl Robot {
    /// Solids for the present angles, in the order body, shaft, drill; also counts clamped notches.
    ///
    /// # Errors
    /// When an angle is not finite.
    pub fn bend(&mut self) -> Result<Vec<Solid>, RobotModelError> {
        let shape = self.shape_at(&self.control_angles_deg)?;
        self.clamped = shape.clamped;
        Ok(self.solids(&shape, &self.lps_from_base))
    }

    /// The shape where these control angles are read, its offsets added.
    ///
    /// # Errors
    /// When an angle is not finite.
    pub fn shape_at(&self, control_angles_deg: &[f64; 5]) -> Result<RobotShape, RobotModelError> {
        self.model.shape(&std::array::from_fn(|k| control_angles_deg[k] + self.control_angle_offsets_deg[k]))
    }

    /// Solids of a robot of any `shape` with its base anywhere, in the order body, shaft, drill.
    #[must_use]
    pub fn solids(&self, shape: &RobotShape, lps_from_base: &Rigid) -> Vec<Solid> {
        let model = &self.model;
        let tube = |part: usize, size: &crate::geometry::TubeSize, base_from_local: Rigid, length_mm: f64| Solid {
            shape: Shape::Cylinder {
                length_mm,
                radius_mm: 0.5 * size.outer_diameter_mm,
                inner_radius_mm: 0.5 * size.inner_diameter_mm,
            },
            lps_from_local: *lps_from_base * base_from_local,
            material: self.materials[part],
            density_g_per_cm3: self.densities_g_per_cm3[part],
        };
        let mut solids = Vec::with_capacity(2 * shape.base_from_pieces.len() + 1);
        let pieces = || shape.base_from_pieces.iter().filter(|(_, length_mm)| *length_mm > 0.0);
        solids.extend(pieces().map(|(pose, length_mm)| tube(0, &model.body, *pose, *length_mm)));
        let mut left_mm = model.shaft.length_mm.unwrap_or(f64::INFINITY);
        for (pose, length_mm) in pieces() {
            let length_mm = length_mm.min(left_mm);
            if length_mm > 0.0 {
                solids.push(tube(1, &model.shaft, *pose, length_mm));
            }
            left_mm -= length_mm;
        }
        solids.push(tube(2, &model.drill, shape.base_from_body_end, model.drill.length_mm.unwrap_or(0.0)));
        solids
    }
}
