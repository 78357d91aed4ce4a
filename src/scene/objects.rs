//! Object entries to matter.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DAffine3, DQuat, DVec3};

use super::SceneError;
use super::file::{CtEntry, Materials, ObjectEntry, RobotEntry, VoxelsEntry};
use super::load::{in_range, locate, parse_json};
use super::matter::{Class, DensityCurve, classify};
use super::model::{InputFile, Matter, Object, Robot, Shape, Solid, Volume};
use super::nifti;
use super::physics::Material;
use super::robot;
use crate::geometry::{Rigid, RobotModel};
use crate::image::{sha256_bytes, sha256_file};
use crate::reporter::Reporter;

/// The rigid body of objects that name none.
pub const DEFAULT_BODY: &str = "specimen";

/// Collects materials and objects while the scene file is read.
pub(super) struct Resolver<'a> {
    scene: &'a Path,
    reporter: &'a Reporter,
    materials: Vec<Material>,
    objects: Vec<Object>,
    inputs: Vec<InputFile>,
    robot: Option<Robot>,
}

impl<'a> Resolver<'a> {
    pub(super) fn new(scene: &'a Path, reporter: &'a Reporter, inputs: Vec<InputFile>) -> Self {
        Self { scene, reporter, materials: Vec::new(), objects: Vec::new(), inputs, robot: None }
    }

    pub(super) fn finish(self) -> (Vec<Material>, Vec<Object>, Vec<InputFile>, Option<Robot>) {
        (self.materials, self.objects, self.inputs, self.robot)
    }

    /// Finds a named file and books it as an input.
    pub(super) fn locate(&mut self, place: &str, named: &Path) -> Result<PathBuf, SceneError> {
        let path = locate(self.scene, place, named)?;
        if let Ok(sha256) = sha256_file(&path) {
            self.inputs.push(InputFile { path: path.display().to_string(), sha256 });
        }
        Ok(path)
    }

    /// Reads a named text file and books it as an input.
    pub(super) fn text(&mut self, place: &str, named: &Path) -> Result<(PathBuf, String), SceneError> {
        let path = locate(self.scene, place, named)?;
        let text = std::fs::read_to_string(&path).map_err(|source| SceneError::Io { path: path.clone(), source })?;
        self.inputs.push(InputFile { path: path.display().to_string(), sha256: sha256_bytes(text.as_bytes()) });
        Ok((path, text))
    }

    /// Scene index of a material, added at its first appearance.
    fn material(&mut self, place: &str, name: &str) -> Result<usize, SceneError> {
        let place = format!("{place}.material");
        let material = Material::parse(name).map_err(|source| SceneError::Physics { place, source })?;
        if let Some(index) = self.materials.iter().position(|known| known.composition == material.composition) {
            return Ok(index);
        }
        self.materials.push(material);
        Ok(self.materials.len() - 1)
    }

    fn density(&self, place: &str, material: usize, given: Option<f64>) -> Result<f64, SceneError> {
        let place = format!("{place}.density_g_per_cm3");
        match given {
            Some(value) => in_range(&place, value, 1e-9..=100.0),
            None => {
                let nominal = self.materials[material].nominal_density_g_per_cm3();
                nominal.map_err(|source| SceneError::Physics { place, source })
            }
        }
    }

    pub(super) fn object(&mut self, index: usize, entry: &ObjectEntry) -> Result<(), SceneError> {
        let at = |kind: &str| format!("objects[{index}].{kind}");
        match entry {
            ObjectEntry::Ct(ct) => self.ct(&at("ct"), ct),
            ObjectEntry::Voxels(voxels) => self.voxels(&at("voxels"), voxels),
            ObjectEntry::Robot(robot) => self.robot(&at("robot"), robot),
            ObjectEntry::Mesh(_) => Err(SceneError::NotAvailable { place: at("mesh") }),
            ObjectEntry::Sphere(s) => {
                let place = at("sphere");
                let radius = in_range(&format!("{place}.radius_mm"), s.radius_mm, 1e-6..=1e6)?;
                let shape = Shape::Ellipsoid { semi_axes_mm: DVec3::splat(radius) };
                let pose = Rigid::translation(point(&place, "centre_lps_mm", s.centre_lps_mm)?);
                self.solid(&place, shape, pose, (&s.material, s.density_g_per_cm3, &s.body))
            }
            ObjectEntry::Ellipsoid(e) => {
                let place = at("ellipsoid");
                let semi_axes_mm = sizes(&place, "semi_axes_mm", e.semi_axes_mm)?;
                let centre = point(&place, "centre_lps_mm", e.centre_lps_mm)?;
                let pose = Rigid { rotation: rotation(&place, e.rotation_lps_from_local)?, translation_mm: centre };
                self.solid(&place, Shape::Ellipsoid { semi_axes_mm }, pose, (&e.material, e.density_g_per_cm3, &e.body))
            }
            ObjectEntry::Box(b) => {
                let place = at("box");
                let half_size_mm = sizes(&place, "size_mm", b.size_mm)? * 0.5;
                let centre = point(&place, "centre_lps_mm", b.centre_lps_mm)?;
                let pose = Rigid { rotation: rotation(&place, b.rotation_lps_from_local)?, translation_mm: centre };
                self.solid(&place, Shape::Cuboid { half_size_mm }, pose, (&b.material, b.density_g_per_cm3, &b.body))
            }
            ObjectEntry::Cylinder(c) => {
                let place = at("cylinder");
                let (from, to) = (point(&place, "from_lps_mm", c.from_lps_mm)?, point(&place, "to_lps_mm", c.to_lps_mm)?);
                let length_mm =
                    in_range(&format!("{place}: distance of from_lps_mm and to_lps_mm"), from.distance(to), 1e-6..=1e6)?;
                let radius_mm = in_range(&format!("{place}.radius_mm"), c.radius_mm, 1e-6..=1e6)?;
                let inner_radius_mm = in_range(&format!("{place}.inner_radius_mm"), c.inner_radius_mm, 0.0..=radius_mm)?;
                let axis = (to - from) / length_mm;
                let pose = Rigid { rotation: DQuat::from_rotation_arc(DVec3::Z, axis), translation_mm: from };
                let shape = Shape::Cylinder { length_mm, radius_mm, inner_radius_mm };
                self.solid(&place, shape, pose, (&c.material, c.density_g_per_cm3, &c.body))
            }
        }
    }

    fn push(&mut self, name: &str, body: &Option<String>, matter: Matter) {
        let body = body.clone().unwrap_or_else(|| DEFAULT_BODY.to_owned());
        self.objects.push(Object { name: name.to_owned(), body, matter });
    }

    fn solid(
        &mut self,
        place: &str,
        shape: Shape,
        lps_from_local: Rigid,
        (material, density, body): (&str, Option<f64>, &Option<String>),
    ) -> Result<(), SceneError> {
        let material = self.material(place, material)?;
        let density_g_per_cm3 = self.density(place, material, density)?;
        self.push(place, body, Matter::Solids(vec![Solid { shape, lps_from_local, material, density_g_per_cm3 }]));
        Ok(())
    }

    fn robot(&mut self, place: &str, entry: &RobotEntry) -> Result<(), SceneError> {
        let (path, text) = self.text(&format!("{place}.model"), &entry.model)?;
        let model: RobotModel = parse_json(&path, &text)?;
        let wrong = |source| SceneError::Robot { place: place.to_owned(), source };
        model.check().map_err(wrong)?;
        let mut parts = Vec::new();
        for tube in [&model.body, &model.shaft, &model.drill] {
            let material = self.material(place, &tube.material)?;
            parts.push((material, self.density(place, material, None)?));
        }
        if self.robot.is_some() {
            let expected = "one robot in a scene".to_owned();
            return Err(SceneError::Value { place: place.to_owned(), found: "a second robot".to_owned(), expected });
        }
        let mut robot = Robot {
            object: self.objects.len(),
            model: Arc::new(model),
            materials: std::array::from_fn(|part| parts[part].0),
            densities_g_per_cm3: std::array::from_fn(|part| parts[part].1),
            lps_from_base: entry.lps_from_base,
            control_angles_deg: entry.control_angles_deg,
            clamped: 0,
        };
        let (solids, clamped) = robot::solids(&robot).map_err(wrong)?;
        robot.clamped = clamped;
        if clamped > 0 {
            let limit = robot.model.max_bend_deg;
            self.reporter.warn("robot bend", format!("{place}: {clamped} notches clamped to ±{limit} deg"));
        }
        self.push(place, &entry.body, Matter::Solids(solids));
        self.robot = Some(robot);
        Ok(())
    }

    fn ct(&mut self, place: &str, entry: &CtEntry) -> Result<(), SceneError> {
        let path = self.locate(&format!("{place}.path"), &entry.path)?;
        let hu = nifti::read(&path, self.reporter)?;
        let keep_air = match entry.air.as_deref() {
            None | Some("drop") => false,
            Some("keep") => true,
            Some(other) => {
                let found = format!("\"{other}\"");
                return Err(SceneError::Value { place: format!("{place}.air"), found, expected: "\"keep\"".to_owned() });
            }
        };
        let curve = DensityCurve::shipped();
        let mut classes: Vec<Class> = Vec::new();
        let mut class_of = |resolver: &mut Self, name: &str, nominal: bool| -> Result<u8, SceneError> {
            let material = resolver.material(place, name)?;
            let nominal_g_per_cm3 = nominal.then(|| resolver.density(place, material, None)).transpose()?;
            let class = Class { material, nominal_g_per_cm3 };
            let index = classes.iter().position(|known| *known == class).unwrap_or_else(|| {
                classes.push(class);
                classes.len() - 1
            });
            u8::try_from(index + 1).map_err(|_| SceneError::Value {
                place: format!("{place}.materials"),
                found: format!("{} kinds of matter", index + 1),
                expected: "at most 255".to_owned(),
            })
        };
        let air = if keep_air { class_of(self, "air", false)? } else { 0 };
        let classified = match &entry.materials {
            Materials::Threshold => {
                let soft = class_of(self, "soft_tissue", false)?;
                let bone = class_of(self, "bone_cortical", false)?;
                classify(&hu, &classes, |value, _| match value {
                    value if value < curve.air_below_hu => air,
                    value if value <= curve.bone_above_hu => soft,
                    _ => bone,
                })
            }
            Materials::Labels(map) => {
                let label_path = self.locate(&format!("{place}.materials.labels"), &map.labels)?;
                let labels = nifti::read(&label_path, self.reporter)?;
                let apart = (labels.lps_from_voxel.translation - hu.lps_from_voxel.translation).length();
                let turned = (labels.lps_from_voxel.matrix3 - hu.lps_from_voxel.matrix3).to_cols_array();
                if labels.size != hu.size || !(apart < 0.01 && turned.iter().all(|x| x.abs() < 1e-3)) {
                    let detail = format!(
                        "is not on the grid of {} ({:?} against {:?} voxels, {apart:.3} mm apart); resample it",
                        path.display(),
                        labels.size,
                        hu.size
                    );
                    return Err(SceneError::Volume { path: label_path, detail });
                }
                let default = class_of(self, &map.default, false)?;
                let mut by_label = std::collections::BTreeMap::new();
                for (label, entry) in &map.map {
                    by_label.insert(*label, class_of(self, &entry.material, entry.nominal_density)?);
                }
                // Labels pick the composition; a voxel that no label claims and that is air by its HU stays air.
                classify(&hu, &classes, |value, index| match by_label.get(&(labels.values[index].round() as u32)) {
                    Some(class) => *class,
                    None if value < curve.air_below_hu => air,
                    None => default,
                })
            }
        };
        let volume = Volume {
            size: hu.size,
            lps_from_voxel: hu.lps_from_voxel,
            density_g_per_cm3: classified.density_g_per_cm3,
            class: classified.class,
            class_materials: classes.iter().map(|class| class.material).collect(),
            truncated_at_faces: true,
            unknown: classified.unknown,
        };
        self.push(place, &entry.body, Matter::Volume(Arc::new(volume)));
        Ok(())
    }

    fn voxels(&mut self, place: &str, entry: &VoxelsEntry) -> Result<(), SceneError> {
        let path = self.locate(&format!("{place}.path"), &entry.path)?;
        let grid = nifti::read(&path, self.reporter)?;
        let material = self.material(place, &entry.material)?;
        let density = self.density(place, material, entry.density_g_per_cm3)?;
        if let Some(bad) = grid.values.iter().find(|value| !(**value >= 0.0 && **value <= 1.0)) {
            let detail = format!("holds the volume fraction {bad}, expected 0 to 1");
            return Err(SceneError::Volume { path, detail });
        }
        let moved = entry.lps_from_voxels_frame.unwrap_or(Rigid::IDENTITY);
        let moved = DAffine3::from_rotation_translation(moved.rotation, moved.translation_mm);
        let volume = Volume {
            size: grid.size,
            lps_from_voxel: moved * grid.lps_from_voxel,
            class: grid.values.iter().map(|value| u8::from(*value > 0.0)).collect(),
            density_g_per_cm3: grid.values.iter().map(|value| (f64::from(*value) * density) as f32).collect(),
            class_materials: vec![material],
            truncated_at_faces: false,
            unknown: Vec::new(),
        };
        self.push(place, &entry.body, Matter::Volume(Arc::new(volume)));
        Ok(())
    }
}

fn point(place: &str, key: &str, values: [f64; 3]) -> Result<DVec3, SceneError> {
    for value in values {
        in_range(&format!("{place}.{key}"), value, -1e7..=1e7)?;
    }
    Ok(DVec3::from_array(values))
}

fn sizes(place: &str, key: &str, values: [f64; 3]) -> Result<DVec3, SceneError> {
    for value in values {
        in_range(&format!("{place}.{key}"), value, 1e-6..=1e6)?;
    }
    Ok(DVec3::from_array(values))
}

fn rotation(place: &str, rows: Option<[[f64; 3]; 3]>) -> Result<DQuat, SceneError> {
    let Some([a, b, c]) = rows else { return Ok(DQuat::IDENTITY) };
    let padded = [[a[0], a[1], a[2], 0.0], [b[0], b[1], b[2], 0.0], [c[0], c[1], c[2], 0.0], [0.0, 0.0, 0.0, 1.0]];
    let rigid = Rigid::from_rows(&padded).map_err(|error| SceneError::Value {
        place: format!("{place}.rotation_lps_from_local"),
        found: error.to_string(),
        expected: "a rotation".to_owned(),
    })?;
    Ok(rigid.rotation)
}
