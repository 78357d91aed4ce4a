//! The robot's solids, and scenes with another robot shape, view or beads.

use glam::DVec3;

use super::model::{Matter, Object, Robot, Scene, Shape, Solid};
use crate::geometry::{Rigid, RobotModelError, View};

/// Solids of a robot in drawing order: body tubes, core, drill (DESIGN §4); with the number of notches that were clamped.
///
/// # Errors
/// When a control angle is not finite.
pub(super) fn solids(robot: &Robot) -> Result<(Vec<Solid>, usize), RobotModelError> {
    let model = &robot.model;
    let shape = model.shape(&robot.control_angles_deg)?;
    let tube = |outer_mm: f64, inner_mm: f64, length_mm: f64, base_from_local: Rigid, (material, density): (usize, f64)| Solid {
        shape: Shape::Cylinder { length_mm, radius_mm: 0.5 * outer_mm, inner_radius_mm: 0.5 * inner_mm },
        lps_from_local: robot.lps_from_base * base_from_local,
        material,
        density_g_per_cm3: density,
    };
    let part = |index: usize| (robot.materials[index], robot.densities_g_per_cm3[index]);
    let mut out = Vec::with_capacity(2 * shape.base_from_pieces.len() + 1);
    for (part, size) in [(part(0), &model.body), (part(1), &model.shaft)] {
        for (base_from_piece, length_mm) in &shape.base_from_pieces {
            out.push(tube(size.outer_diameter_mm, size.inner_diameter_mm, *length_mm, *base_from_piece, part));
        }
    }
    let drill = &model.drill;
    let drill_mm = drill.length_mm.unwrap_or(0.0);
    out.push(tube(drill.outer_diameter_mm, drill.inner_diameter_mm, drill_mm, shape.base_from_body_end, part(2)));
    Ok((out, shape.clamped))
}

impl Scene {
    /// The same scene seen from `view`; volumes are shared.
    #[must_use]
    pub fn with_view(&self, view: View) -> Self {
        Self { view: Some(view), ..self.clone() }
    }

    /// The same scene with its robot in another shape, and another place if one is given; volumes are shared.
    ///
    /// # Errors
    /// When an angle is not finite.
    pub fn with_robot(&self, control_angles_deg: [f64; 5], lps_from_base: Option<Rigid>) -> Result<Self, RobotModelError> {
        let mut scene = self.clone();
        if let Some(robot) = &mut scene.robot {
            robot.control_angles_deg = control_angles_deg;
            robot.lps_from_base = lps_from_base.unwrap_or(robot.lps_from_base);
            let (solids, clamped) = solids(robot)?;
            robot.clamped = clamped;
            scene.objects[robot.object].matter = Matter::Solids(solids);
        }
        Ok(scene)
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

    /// Middle and half diagonal (mm) of the box around all objects in `lps`; `None` for an empty scene.
    #[must_use]
    pub fn bounds(&self) -> Option<(DVec3, f64)> {
        let corners: Vec<DVec3> = self.objects.iter().flat_map(Object::corners_in_lps).collect();
        let low = corners.iter().copied().reduce(DVec3::min)?;
        let high = corners.iter().copied().reduce(DVec3::max)?;
        Some((0.5 * (low + high), 0.5 * (high - low).length()))
    }
}

impl Object {
    /// Corners of boxes around the object's parts.
    #[must_use]
    pub fn corners_in_lps(&self) -> Vec<DVec3> {
        let corner = |index: usize| DVec3::from_array(std::array::from_fn(|axis| f64::from(u8::from(index >> axis & 1 == 1))));
        match &self.matter {
            Matter::Volume(volume) => {
                let size = DVec3::from_array(volume.size.map(|n| n as f64));
                (0..8).map(|index| volume.lps_from_voxel.transform_point3(corner(index) * size - 0.5)).collect()
            }
            Matter::Solids(solids) => {
                let around = |solid: &Solid| {
                    let (centre, radius_mm) = solid.shape.bounding_sphere();
                    let centre = solid.lps_from_local.transform_point(centre);
                    (0..8).map(move |index| centre + (corner(index) * 2.0 - 1.0) * radius_mm)
                };
                solids.iter().flat_map(around).collect()
            }
            Matter::Mesh(mesh) => mesh.vertices_lps_mm.clone(),
        }
    }
}
