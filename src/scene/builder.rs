//! What every kind of object of a scene file needs while it becomes matter: names of places, materials, checked numbers.

use std::path::PathBuf;

use glam::DVec3;

use super::SceneError;
use super::files::Files;
use super::model::Scene;
use super::physics::Material;
use super::volumes::VolumeSource;
use crate::geometry::Rigid;
use crate::reporter::Reporter;

/// What can be done about a material without a nominal density where a scene has a key for it.
pub(super) const GIVE_DENSITY: &str = "give density_g_per_cm3";

/// A scene while its objects are added.
pub(super) struct Builder<'a> {
    pub scene: &'a mut Scene,
    pub files: &'a mut Files,
    pub reporter: &'a Reporter,
    /// Of the object at hand: `objects[3].sphere`.
    pub key: String,
}

impl Builder<'_> {
    pub fn place(&self, key: &str) -> String {
        self.files.place(&format!("{}.{key}", self.key))
    }

    pub fn value(&self, key: &str, found: String, expected: &str) -> SceneError {
        SceneError::Value { place: self.place(key), found, expected: expected.to_owned() }
    }

    pub fn find(&mut self, key: &str, name: &str) -> Result<PathBuf, SceneError> {
        let key = format!("{}.{key}", self.key);
        self.files.find(&key, name)
    }

    pub fn find_volume(&mut self, key: &str, name: &str) -> Result<VolumeSource, SceneError> {
        let key = format!("{}.{key}", self.key);
        self.files.find_volume(&key, name)
    }

    pub fn material(&self, key: &str, name: &str) -> Result<Material, SceneError> {
        Material::parse(name).map_err(|source| SceneError::Physics { place: self.place(key), source })
    }

    /// Scene index and density of a named material.
    pub fn solid_material(&mut self, key: &str, name: &str, density: Option<f64>) -> Result<(usize, f64), SceneError> {
        let material = self.material(key, name)?;
        let density = match density {
            Some(density) if density > 0.0 && density <= 50.0 => density,
            Some(density) => return Err(self.value("density_g_per_cm3", density.to_string(), "above 0, at most 50 g/cm3")),
            None => material
                .nominal_density_or(GIVE_DENSITY)
                .map_err(|source| SceneError::Physics { place: self.place(key), source })?,
        };
        // Before anything else there is nothing to cut.
        if material.name == "air" && !self.scene.objects.is_empty() {
            let words = format_args!(
                "{} is air, which displaces nothing; to cut a hole give it \"material\": \"N2\", \"density_g_per_cm3\": 0.0012",
                self.place(key)
            );
            self.reporter.warn("air displaces nothing", words);
        }
        Ok((self.scene.material_index(material), density))
    }

    pub fn point(&self, key: &str, point: [f64; 3]) -> Result<DVec3, SceneError> {
        let point = DVec3::from_array(point);
        // A kilometre away is a mistake of units, and f32 could not place it.
        if point.abs().max_element() <= 1e6 {
            return Ok(point);
        }
        Err(self.value(key, format!("{point}"), "finite coordinates within 1e6 mm"))
    }

    /// A pose whose translation is that of something in the room.
    pub fn pose(&self, key: &str, pose: &Rigid) -> Result<Rigid, SceneError> {
        self.point(&format!("{key} (translation)"), pose.translation_mm.to_array())?;
        Ok(*pose)
    }

    pub fn sizes(&self, key: &str, sizes: &[f64]) -> Result<(), SceneError> {
        if sizes.iter().all(|size| *size > 0.0 && *size <= 1e6) {
            return Ok(());
        }
        Err(self.value(key, format!("{sizes:?}"), "above 0, at most 1e6 mm"))
    }
}
