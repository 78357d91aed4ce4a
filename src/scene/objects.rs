//! Objects of a scene file become matter.

use std::sync::Arc;

use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::SceneError;
use super::builder::Builder;
use super::ct::LabelledCt;
use super::files::Files;
use super::inpaint::metal_balls;
use super::matter;
use super::mesh;
use super::model::{Matter, Object, Robot, Scene, Shape, Solid};
use super::object_file::{BODY, BoxFile, CylinderFile, EllipsoidFile, MeshFile, ObjectFile, RobotFile, SphereFile, VoxelsFile};
use crate::geometry::{Rigid, RobotCalibration, RobotModel};
use crate::reporter::Reporter;

/// Appends the objects to the scene, in order.
pub(super) fn build(objects: &[ObjectFile], scene: &mut Scene, files: &mut Files, reporter: &Reporter) -> Result<(), SceneError> {
    let mut builder = Builder { scene, files, reporter, key: String::new() };
    for (index, object) in objects.iter().enumerate() {
        let kind = kind(object);
        builder.key = format!("objects[{index}].{kind}");
        let tools = || (0..index).find(|n| is_tool(&objects[*n]) || is_metal(&builder.scene.objects[*n].matter));
        if let (ObjectFile::Ct(_), Some(tool)) = (object, tools()) {
            let words = format_args!(
                "{} comes after objects[{tool}].{}, which it displaces wherever it has matter; list the CT first, unless that is meant",
                builder.files.place(&builder.key),
                self::kind(&objects[tool])
            );
            reporter.warn("order of objects", words);
        }
        let (matter, body) = match object {
            ObjectFile::Ct(file) => (builder.ct(file, &metal_balls(&objects[index + 1..]))?, &file.body),
            ObjectFile::Mesh(file) => (builder.mesh(file)?, &file.body),
            ObjectFile::Voxels(file) => (builder.voxels(file)?, &file.body),
            ObjectFile::Sphere(file) => (builder.sphere(file)?, &file.body),
            ObjectFile::Ellipsoid(file) => (builder.ellipsoid(file)?, &file.body),
            ObjectFile::Box(file) => (builder.cuboid(file)?, &file.body),
            ObjectFile::Cylinder(file) => (builder.cylinder(file)?, &file.body),
            ObjectFile::Robot(file) => (builder.robot(file, index)?, &file.body),
        };
        let body = body.clone().unwrap_or_else(|| BODY.to_owned());
        builder.scene.objects.push(Object { name: builder.key.clone(), body, matter });
    }
    Ok(())
}

/// The CTs among the objects whose materials are labels.
pub(super) fn labelled_cts(
    objects: &[ObjectFile],
    scene: &mut Scene,
    files: &mut Files,
    reporter: &Reporter,
) -> Result<Vec<LabelledCt>, SceneError> {
    let mut builder = Builder { scene, files, reporter, key: String::new() };
    let mut found = Vec::new();
    for (index, object) in objects.iter().enumerate() {
        builder.key = format!("objects[{index}].{}", kind(object));
        if let ObjectFile::Ct(file) = object {
            found.extend(builder.labelled_ct(file)?);
        }
    }
    Ok(found)
}

/// What is put into a body, and not around it.
fn is_tool(object: &ObjectFile) -> bool {
    matches!(object, ObjectFile::Mesh(_) | ObjectFile::Voxels(_) | ObjectFile::Robot(_))
}

/// Shapes that are denser than bone.
fn is_metal(matter: &Matter) -> bool {
    matches!(matter, Matter::Solids(solids) if solids.iter().any(|solid| solid.density_g_per_cm3 > 2.5))
}

fn kind(object: &ObjectFile) -> &'static str {
    match object {
        ObjectFile::Ct(_) => "ct",
        ObjectFile::Mesh(_) => "mesh",
        ObjectFile::Voxels(_) => "voxels",
        ObjectFile::Sphere(_) => "sphere",
        ObjectFile::Ellipsoid(_) => "ellipsoid",
        ObjectFile::Box(_) => "box",
        ObjectFile::Cylinder(_) => "cylinder",
        ObjectFile::Robot(_) => "robot",
    }
}

impl Builder<'_> {
    fn rotation(&self, rows: &[[f64; 3]; 3]) -> Result<DQuat, SceneError> {
        let mut padded = [[0.0; 4]; 4];
        for (to, from) in padded.iter_mut().zip(rows) {
            to[..3].copy_from_slice(from);
        }
        padded[3][3] = 1.0;
        let rigid = Rigid::from_rows(&padded);
        rigid
            .map(|rigid| rigid.rotation)
            .map_err(|error| SceneError::Keys { place: self.place("rotation_lps_from_local"), detail: error.to_string() })
    }

    fn one(&self, shape: Shape, lps_from_local: Rigid, (material, density_g_per_cm3): (usize, f64)) -> Matter {
        Matter::Solids(vec![Solid { shape, lps_from_local, material, density_g_per_cm3 }])
    }

    fn sphere(&mut self, file: &SphereFile) -> Result<Matter, SceneError> {
        let made_of = self.solid_material("material", &file.material, file.density_g_per_cm3)?;
        self.sizes("radius_mm", &[file.radius_mm])?;
        let centre = self.point("centre_lps_mm", file.centre_lps_mm)?;
        Ok(self.one(Shape::Ellipsoid { semi_axes_mm: DVec3::splat(file.radius_mm) }, Rigid::translation(centre), made_of))
    }

    fn ellipsoid(&mut self, file: &EllipsoidFile) -> Result<Matter, SceneError> {
        let made_of = self.solid_material("material", &file.material, file.density_g_per_cm3)?;
        self.sizes("semi_axes_mm", &file.semi_axes_mm)?;
        let pose = Rigid {
            rotation: self.rotation(&file.rotation_lps_from_local)?,
            translation_mm: self.point("centre_lps_mm", file.centre_lps_mm)?,
        };
        Ok(self.one(Shape::Ellipsoid { semi_axes_mm: DVec3::from_array(file.semi_axes_mm) }, pose, made_of))
    }

    fn cuboid(&mut self, file: &BoxFile) -> Result<Matter, SceneError> {
        let made_of = self.solid_material("material", &file.material, file.density_g_per_cm3)?;
        self.sizes("size_mm", &file.size_mm)?;
        let pose = Rigid {
            rotation: self.rotation(&file.rotation_lps_from_local)?,
            translation_mm: self.point("centre_lps_mm", file.centre_lps_mm)?,
        };
        Ok(self.one(Shape::Cuboid { half_size_mm: DVec3::from_array(file.size_mm) * 0.5 }, pose, made_of))
    }

    fn cylinder(&mut self, file: &CylinderFile) -> Result<Matter, SceneError> {
        let made_of = self.solid_material("material", &file.material, file.density_g_per_cm3)?;
        let from = self.point("from_lps_mm", file.from_lps_mm)?;
        let along = self.point("to_lps_mm", file.to_lps_mm)? - from;
        let length_mm = along.length();
        self.sizes("to_lps_mm (distance from from_lps_mm)", &[length_mm])?;
        self.sizes("radius_mm", &[file.radius_mm])?;
        let (radius_mm, inner_radius_mm) = (file.radius_mm, file.inner_radius_mm);
        if !(inner_radius_mm >= 0.0 && inner_radius_mm < radius_mm) {
            return Err(self.value("inner_radius_mm", inner_radius_mm.to_string(), "from 0 to less than radius_mm"));
        }
        let pose = Rigid { rotation: DQuat::from_rotation_arc(DVec3::Z, along / length_mm), translation_mm: from };
        Ok(self.one(Shape::Cylinder { length_mm, radius_mm, inner_radius_mm }, pose, made_of))
    }

    fn robot(&mut self, file: &RobotFile, object: usize) -> Result<Matter, SceneError> {
        if self.scene.robot.is_some() {
            return Err(SceneError::Keys {
                place: self.files.place(&self.key),
                detail: "a scene has at most one robot".to_owned(),
            });
        }
        let model: RobotModel = self.files.read_json(&format!("{}.model", self.key), &file.model)?;
        let place = self.place("model");
        model.check().map_err(|source| SceneError::Robot { place, source })?;
        let mut materials = [0; 3];
        let mut densities_g_per_cm3 = [0.0; 3];
        for (part, size) in [&model.body, &model.shaft, &model.drill].into_iter().enumerate() {
            (materials[part], densities_g_per_cm3[part]) = self.solid_material("model", &size.material, None)?;
        }
        let calibration = self.robot_calibration(file)?;
        let measured = calibration.as_ref().and_then(|calibration| calibration.lps_from_base);
        let mut robot = Robot {
            object,
            model: Arc::new(model),
            materials,
            densities_g_per_cm3,
            lps_from_base: self.pose("lps_from_base", &file.lps_from_base.or(measured).unwrap_or(Rigid::IDENTITY))?,
            marker_from_base: calibration.as_ref().and_then(|found| found.marker_from_base).unwrap_or(Rigid::IDENTITY),
            control_angles_deg: file.control_angles_deg,
            control_angle_offsets_deg: calibration.map_or([0.0; 5], |found| found.control_angle_offsets_deg),
            clamped: 0,
        };
        let place = self.place("control_angles_deg");
        let solids = robot.bend().map_err(|source| SceneError::Robot { place, source })?;
        if robot.clamped > 0 {
            let (limit, place) = (robot.model.max_bend_deg, self.place("control_angles_deg"));
            self.reporter.warn("robot bend", format_args!("{place}: {} notches clamped to {limit} deg", robot.clamped));
        }
        self.scene.robot = Some(robot);
        Ok(Matter::Solids(solids))
    }

    /// What `calibrate robot` measured, if the scene names it.
    fn robot_calibration(&mut self, file: &RobotFile) -> Result<Option<RobotCalibration>, SceneError> {
        let Some(name) = &file.calibration else { return Ok(None) };
        let calibration: RobotCalibration = self.files.read_json(&format!("{}.calibration", self.key), name)?;
        let place = self.place("calibration");
        let keys = |detail: String| SceneError::Keys { place: place.clone(), detail };
        calibration.check().map_err(|error| keys(error.to_string()))?;
        if calibration.lps_from_base.is_some() && file.lps_from_base.is_some() {
            return Err(keys("lps_from_base stands in the scene and in the calibration; leave it out of the scene".to_owned()));
        }
        Ok(Some(calibration))
    }

    fn mesh(&mut self, file: &MeshFile) -> Result<Matter, SceneError> {
        let (material, density_g_per_cm3) = self.solid_material("material", &file.material, file.density_g_per_cm3)?;
        let path = self.find("path", &file.path)?;
        let pose = match &file.lps_from_mesh {
            Some(pose) => self.pose("lps_from_mesh", pose)?,
            None => mesh::stated_frame(&path, self.reporter)?,
        };
        let surface = mesh::read_surface(&path, self.reporter)?;
        Ok(Matter::Mesh(Arc::new(mesh::placed(surface, &pose, material, density_g_per_cm3))))
    }

    fn voxels(&mut self, file: &VoxelsFile) -> Result<Matter, SceneError> {
        let (material, density_g_per_cm3) = self.solid_material("material", &file.material, file.density_g_per_cm3)?;
        let source = self.find_volume("path", &file.path)?;
        let volume = source.read_voxels(self.reporter)?;
        let mut volume = matter::from_fractions(source.path(), volume, material, density_g_per_cm3)?;
        let moved = self.pose("lps_from_voxels_frame", &file.lps_from_voxels_frame)?;
        let moved = DAffine3 { matrix3: DMat3::from_quat(moved.rotation), translation: moved.translation_mm };
        volume.lps_from_voxel = moved * volume.lps_from_voxel;
        Ok(Matter::Volume(Arc::new(volume)))
    }
}
