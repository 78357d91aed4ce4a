//! Objects of a scene file become matter.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::SceneError;
use super::files::Files;
use super::foreign_files::{VolumeFile, read_volume};
use super::inpaint::{Ball, inpaint_labels, inpaint_metal, metal_balls};
use super::matter::{self, Class, Classes};
use super::mesh;
use super::model::{LabelledBody, Matter, Object, Robot, Scene, Shape, Solid};
use super::object_file::{
    AirFile, BoxFile, CtFile, CylinderFile, DensityFile, EllipsoidFile, LabelsFile, MaterialsFile, MeshFile,
};
use super::object_file::{ObjectFile, RobotFile, SphereFile, VoxelsFile};
use super::physics::Material;
use crate::geometry::{Rigid, RobotCalibration, RobotModel};
use crate::reporter::Reporter;

/// Class of unlisted labels, and class per label; `None` is air.
type LabelClasses = (Class, Vec<(u32, Option<Class>)>);

/// Default of `body`.
const BODY: &str = "specimen";

/// Appends the objects to the scene, in order.
pub(super) fn build(objects: &[ObjectFile], scene: &mut Scene, files: &mut Files, reporter: &Reporter) -> Result<(), SceneError> {
    let mut builder = Builder { scene, files, reporter, key: String::new() };
    for (index, object) in objects.iter().enumerate() {
        let kind = kind(object);
        builder.key = format!("objects[{index}].{kind}");
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

struct Builder<'a> {
    scene: &'a mut Scene,
    files: &'a mut Files,
    reporter: &'a Reporter,
    /// `objects[3].sphere`
    key: String,
}

impl Builder<'_> {
    fn place(&self, key: &str) -> String {
        self.files.place(&format!("{}.{key}", self.key))
    }

    fn value(&self, key: &str, found: String, expected: &str) -> SceneError {
        SceneError::Value { place: self.place(key), found, expected: expected.to_owned() }
    }

    fn material(&self, key: &str, name: &str) -> Result<Material, SceneError> {
        Material::parse(name).map_err(|source| SceneError::Physics { place: self.place(key), source })
    }

    /// Scene index and density of a named material.
    fn solid_material(&mut self, key: &str, name: &str, density: Option<f64>) -> Result<(usize, f64), SceneError> {
        let material = self.material(key, name)?;
        let density = match density {
            Some(density) if density > 0.0 && density <= 50.0 => density,
            Some(density) => return Err(self.value("density_g_per_cm3", density.to_string(), "above 0, at most 50 g/cm3")),
            None => {
                material.nominal_density_g_per_cm3().map_err(|source| SceneError::Physics { place: self.place(key), source })?
            }
        };
        Ok((self.scene.material_index(material), density))
    }

    fn point(&self, key: &str, point: [f64; 3]) -> Result<DVec3, SceneError> {
        let point = DVec3::from_array(point);
        // A kilometre away is a mistake of units, and f32 could not place it.
        if point.abs().max_element() <= 1e6 {
            return Ok(point);
        }
        Err(self.value(key, format!("{point}"), "finite coordinates within 1e6 mm"))
    }

    /// A pose whose translation is that of something in the room.
    fn pose(&self, key: &str, pose: &Rigid) -> Result<Rigid, SceneError> {
        self.point(&format!("{key} (translation)"), pose.translation_mm.to_array())?;
        Ok(*pose)
    }

    fn sizes(&self, key: &str, sizes: &[f64]) -> Result<(), SceneError> {
        if sizes.iter().all(|size| *size > 0.0 && *size <= 1e6) {
            return Ok(());
        }
        Err(self.value(key, format!("{sizes:?}"), "above 0, at most 1e6 mm"))
    }

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
        let pose = self.pose("lps_from_mesh", &file.lps_from_mesh)?;
        let surface = mesh::read_surface(&path, self.reporter)?;
        Ok(Matter::Mesh(Arc::new(mesh::placed(surface, &pose, material, density_g_per_cm3))))
    }

    fn voxels(&mut self, file: &VoxelsFile) -> Result<Matter, SceneError> {
        let (material, density_g_per_cm3) = self.solid_material("material", &file.material, file.density_g_per_cm3)?;
        let path = self.find("path", &file.path)?;
        let volume = read_volume(&path, self.reporter)?;
        let mut volume = matter::from_fractions(&path, volume, material, density_g_per_cm3)?;
        let moved = self.pose("lps_from_voxels_frame", &file.lps_from_voxels_frame)?;
        let moved = DAffine3 { matrix3: DMat3::from_quat(moved.rotation), translation: moved.translation_mm };
        volume.lps_from_voxel = moved * volume.lps_from_voxel;
        Ok(Matter::Volume(Arc::new(volume)))
    }

    fn find(&mut self, key: &str, name: &str) -> Result<PathBuf, SceneError> {
        let key = format!("{}.{key}", self.key);
        self.files.find(&key, name)
    }

    /// A CT without the metal of the beads that come after it, `balls`.
    fn ct(&mut self, file: &CtFile, balls: &[Ball]) -> Result<Matter, SceneError> {
        let path = self.find("path", &file.path)?;
        if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("dcm")) {
            return Err(SceneError::Unavailable { place: format!("{}: a CT from DICOM slices", self.place("path")) });
        }
        let mut ct = read_volume(&path, self.reporter)?;
        matter::check_hounsfield(&path, &ct, self.reporter);
        let inpainted = self.without_beads(&mut ct, balls);
        // Materials are numbered apart first: only those that have voxels enter the scene.
        let mut local = Vec::new();
        let air = match file.air {
            AirFile::Keep => Some(self.local_class(&mut local, "air", "air", DensityFile::Hu)?),
            AirFile::Vacuum => None,
        };
        let classes = match &file.materials {
            MaterialsFile::Threshold => Classes::Threshold {
                soft_tissue: self.local_class(&mut local, "materials", "soft_tissue", DensityFile::Hu)?,
                bone: self.local_class(&mut local, "materials", "bone_cortical", DensityFile::Hu)?,
            },
            MaterialsFile::Labels(labels) => {
                let labels_path = self.find("materials.labels", &labels.labels)?;
                let grid = read_volume(&labels_path, self.reporter)?;
                let mut numbers = matter::labels_on_grid((&path, &ct), (&labels_path, grid))?;
                inpaint_labels(&ct.grid(), &mut numbers, &inpainted);
                self.labelled_bodies(file.body.as_deref().unwrap_or(BODY), labels, &numbers)?;
                let (default, map) = self.label_classes(&mut local, labels)?;
                self.warn_of_absent(&labels_path, &map, &numbers);
                Classes::Labels { labels: numbers, default, map }
            }
        };
        let (mut volume, order) = matter::from_ct(&self.files.place(&self.key), ct, &classes, air)?;
        if order.is_empty() {
            self.reporter.warn("empty CT", format_args!("{}: no voxel is matter: everything is air", path.display()));
        }
        let mut index_of: HashMap<usize, usize> = HashMap::new();
        for class in &order {
            let index = self.scene.material_index(local[class.material].clone());
            index_of.insert(class.material, index);
        }
        volume.class_materials = order.iter().map(|class| index_of[&class.material]).collect();
        Ok(Matter::Volume(Arc::new(volume)))
    }

    /// Takes the metal of `balls` out of the CT and says so; the voxels that changed, ascending.
    fn without_beads(&self, ct: &mut VolumeFile, balls: &[Ball]) -> Vec<usize> {
        let grid = ct.grid();
        let inpainted = inpaint_metal(&grid, &mut ct.values, balls);
        if inpainted.balls > 0 {
            self.reporter.note(format_args!(
                "{}: {} of {} beads that the scene draws are metal in the CT too: replaced there by what surrounds them ({} voxels, \
                 halo up to {:.1} mm)",
                self.files.place(&self.key),
                inpainted.balls,
                balls.len(),
                inpainted.voxels.len(),
                inpainted.halo_mm
            ));
        }
        inpainted.voxels
    }

    /// Finds the voxels of the bodies that `file` makes of labels; `own` is that of all other voxels.
    fn labelled_bodies(&mut self, own: &str, file: &LabelsFile, numbers: &[u32]) -> Result<(), SceneError> {
        let mut taken: HashMap<u32, &str> = HashMap::new();
        for (name, labels) in &file.bodies {
            let key = format!("materials.bodies.{name}");
            if name == own {
                let expected = "another name than that of the CT's other voxels (its \"body\")";
                return Err(self.value(&key, format!("the body '{name}'"), expected));
            }
            if let Some((label, other)) = labels.iter().find_map(|label| taken.insert(*label, name).map(|other| (label, other))) {
                return Err(self.value(&key, format!("label {label}, which {other} has"), "each label once"));
            }
            let voxels: Vec<usize> = (0..numbers.len()).filter(|index| labels.contains(&numbers[*index])).collect();
            if voxels.is_empty() {
                return Err(self.value(
                    &key,
                    format!("labels {labels:?} without any voxel"),
                    "labels that the label volume holds",
                ));
            }
            let body = LabelledBody { name: name.clone(), object: self.key.clone(), voxels, filling: OnceLock::new() };
            self.scene.bodies.labelled.push(Arc::new(body));
        }
        Ok(())
    }

    fn label_classes(&self, local: &mut Vec<Material>, file: &LabelsFile) -> Result<LabelClasses, SceneError> {
        let default = self.local_class(local, "materials.default", &file.default, DensityFile::Hu)?;
        let mut map = Vec::with_capacity(file.map.len());
        for (label, entry) in &file.map {
            let key = format!("materials.map.{label}");
            let number: u32 =
                label.trim().parse().map_err(|_| self.value(&key, format!("the label '{label}'"), "a whole number from 0 up"))?;
            let class = self.local_class(local, &key, &entry.material, entry.density)?;
            map.push((number, (local[class.material].name != "air").then_some(class)));
        }
        map.sort_by_key(|(number, _)| *number);
        if let Some(pair) = map.windows(2).find(|pair| pair[0].0 == pair[1].0) {
            return Err(self.value("materials.map", format!("label {} twice", pair[0].0), "each label once"));
        }
        Ok((default, map))
    }

    /// Labels that are named but that no voxel has: another file's numbers?
    fn warn_of_absent(&self, path: &Path, map: &[(u32, Option<Class>)], numbers: &[u32]) {
        let held: std::collections::HashSet<u32> = numbers.iter().copied().collect();
        let absent: Vec<String> =
            map.iter().filter(|(number, _)| !held.contains(number)).map(|(number, _)| number.to_string()).collect();
        if !absent.is_empty() {
            let (labels, absent) = (path.display(), absent.join(", "));
            let words = format!("{labels}: no voxel has the labels {absent} that materials.map names; are they another file's?");
            self.reporter.warn("labels", words);
        }
    }

    fn local_class(&self, local: &mut Vec<Material>, key: &str, name: &str, density: DensityFile) -> Result<Class, SceneError> {
        let material = self.material(key, name)?;
        let density_g_per_cm3 = match density {
            DensityFile::Hu => None,
            DensityFile::Nominal => Some(
                material.nominal_density_g_per_cm3().map_err(|source| SceneError::Physics { place: self.place(key), source })?,
            ),
        };
        let index = local.iter().position(|known| *known == material).unwrap_or_else(|| {
            local.push(material);
            local.len() - 1
        });
        Ok(Class { material: index, density_g_per_cm3 })
    }
}
