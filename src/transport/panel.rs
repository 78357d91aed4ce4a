//! The detector as the transport sees it: a plane at z = SDD with a coarse raster over the image, and what a photon adds to it.

use glam::{DVec2, DVec3};

use super::error::TransportError;
use crate::geometry::View;
use crate::scene::model::{Response, Scene};
use crate::scene::optics::{Axis, Strips};
use crate::scene::physics::ENERGY_RANGE_KEV;

/// Rows of the response per keV.
pub(super) const ROWS_PER_KEV: f64 = 16.0;

/// The detector plane, its raster, and its response.
#[derive(Clone, Debug)]
pub struct Panel {
    pub(super) view: View,
    /// Columns and rows of the raster.
    pub grid_px: [usize; 2],
    /// Source to detector.
    pub distance_mm: f64,
    /// Focal spot, lps mm.
    pub source: DVec3,
    /// Unit vectors of the camera in lps.
    pub axes: [DVec3; 3],
    /// Area of the image on the plane.
    pub area_mm2: f64,
    pub(super) responses: Vec<f64>,
    pub(super) strips: Option<Strips>,
}

impl Panel {
    /// The panel of `scene` seen in `view`, in `grid_px` columns and rows.
    ///
    /// # Errors
    /// When there is no distance to it, or no raster.
    pub fn new(scene: &Scene, view: &View, grid_px: [usize; 2]) -> Result<Self, TransportError> {
        let distance_mm = view.intrinsics.source_to_detector_mm(scene.detector.pitch_mm);
        if !(distance_mm > 0.0 && distance_mm.is_finite()) {
            return Err(TransportError::DetectorDistance { fx: view.intrinsics.fx, pitch_mm: scene.detector.pitch_mm });
        }
        let [columns, rows] = grid_px;
        if !grid_px.iter().all(|n| (1..=1024).contains(n)) {
            return Err(TransportError::Grid { columns, rows });
        }
        let lps_from_camera = view.camera_from_lps.inverse();
        let [width, height] = view.size_px.map(f64::from);
        let area_mm2 = width * height * distance_mm * distance_mm / (view.intrinsics.fx * view.intrinsics.fy);
        let count = ((ENERGY_RANGE_KEV.1 - ENERGY_RANGE_KEV.0) * ROWS_PER_KEV) as usize + 2;
        let response = |row: usize| {
            let energy_kev = (ENERGY_RANGE_KEV.0 + row as f64 / ROWS_PER_KEV).min(ENERGY_RANGE_KEV.1);
            let absorbed = match &scene.detector.panel.scintillator {
                Some(scintillator) => scintillator.absorption(energy_kev)?,
                None => 1.0,
            };
            Ok(match scene.detector.response {
                Response::Energy => energy_kev * absorbed,
                Response::Counting => absorbed,
            })
        };
        let responses = (0..count).map(response).collect::<Result<Vec<f64>, TransportError>>()?;
        let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| lps_from_camera.transform_vector(axis));
        let strips = scene.detector.panel.grid.and_then(|grid| grid.strips);
        let source = lps_from_camera.translation_mm;
        Ok(Self { view: *view, grid_px, distance_mm, source, axes, area_mm2, responses, strips })
    }

    /// Signal of one detected photon: keV or 1, times the share that the scintillator absorbs.
    #[inline]
    #[must_use]
    pub fn response(&self, energy_kev: f64) -> f64 {
        let position = ((energy_kev - ENERGY_RANGE_KEV.0) * ROWS_PER_KEV).max(0.0);
        let row = (position as usize).min(self.responses.len() - 2);
        self.responses[row] + (self.responses[row + 1] - self.responses[row]) * (position - row as f64)
    }

    /// Share of what the primary would pass that the antiscatter grid lets pass of photons in this direction at a point of the plane.
    #[inline]
    #[must_use]
    pub fn passed(&self, point: DVec3, direction: DVec3) -> f64 {
        let in_camera = || DVec3::from_array(self.axes.map(|axis| direction.dot(axis)));
        self.strips.map_or(1.0, |strips| strips.share(self.on_plane(point), in_camera(), self.distance_mm))
    }

    /// Ratio of an antiscatter grid whose strips follow each other along columns' direction, and along rows'; 0 for none.
    #[must_use]
    pub fn grid_ratios(&self) -> [f64; 2] {
        [Axis::Column, Axis::Row]
            .map(|axis| self.strips.filter(|strips| strips.across == axis).map_or(0.0, |strips| strips.ratio))
    }

    /// Depth of a point below the plane, mm: negative behind the detector.
    #[inline]
    #[must_use]
    pub fn depth_below(&self, point: DVec3) -> f64 {
        self.distance_mm - (point - self.source).dot(self.axes[2])
    }

    /// A point of the plane, mm from the principal point along columns' and rows' direction.
    #[inline]
    #[must_use]
    pub fn on_plane(&self, point: DVec3) -> DVec2 {
        let from_source = point - self.source;
        DVec2::new(from_source.dot(self.axes[0]), from_source.dot(self.axes[1]))
    }

    /// The point in lps of one on the plane.
    #[inline]
    #[must_use]
    pub fn in_lps(&self, on_plane_mm: DVec2) -> DVec3 {
        self.source + self.axes[0] * on_plane_mm.x + self.axes[1] * on_plane_mm.y + self.axes[2] * self.distance_mm
    }

    /// A point of the plane by shares (0 to 1) of the image's width and height.
    #[inline]
    #[must_use]
    pub fn at_share(&self, share: DVec2) -> DVec2 {
        let size = DVec2::new(f64::from(self.view.size_px[0]), f64::from(self.view.size_px[1]));
        self.view.intrinsics.unproject(share * size - 0.5).truncate() * self.distance_mm
    }

    /// A point of the image by shares in (0, 1) of its width and height, in lps, and its pixel.
    #[inline]
    #[must_use]
    pub fn aim(&self, share: DVec2) -> (DVec3, usize) {
        let [columns, rows] = self.grid_px;
        let (column, row) = ((share.x * columns as f64) as usize, (share.y * rows as f64) as usize);
        (self.in_lps(self.at_share(share)), column.min(columns - 1) + columns * row.min(rows - 1))
    }

    /// Pixel of the raster (row-major) that holds a point of the plane; `None` beside the image.
    #[inline]
    #[must_use]
    pub fn pixel(&self, on_plane_mm: DVec2) -> Option<usize> {
        let image = self.view.intrinsics.project(on_plane_mm.extend(self.distance_mm)) + 0.5;
        let [columns, rows] = self.grid_px;
        let column = image.x / f64::from(self.view.size_px[0]) * columns as f64;
        let row = image.y / f64::from(self.view.size_px[1]) * rows as f64;
        let inside = column >= 0.0 && column < columns as f64 && row >= 0.0 && row < rows as f64;
        inside.then(|| column as usize + columns * (row as usize))
    }

    /// Number of pixels.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.grid_px[0] * self.grid_px[1]
    }

    /// Area of one pixel of the image on the plane.
    #[must_use]
    pub fn image_pixel_area_mm2(&self) -> f64 {
        self.area_mm2 / self.view.size_px.map(f64::from).iter().product::<f64>()
    }

    /// Area of one pixel of the raster on the plane.
    #[must_use]
    pub fn pixel_area_mm2(&self) -> f64 {
        self.area_mm2 / self.pixels() as f64
    }
}
