//! What is at a point: the scene's objects as the yardstick has them (DESIGN §5), asked point by point.
//!
//! Matter at a point is that of the last object that has any there; kept air comes after all other matter; parts of one CT add up.

use glam::{DAffine3, DVec3};

use super::stream::Stream;
use crate::render::cpu::shapes::intersect;
use crate::render::mesh_tree::MeshTree;
use crate::scene::model::{Matter as ObjectMatter, Mesh, Scene, Shape, Solid, Volume, Voxels};

/// One thing that has matter of its own; a robot has many.
pub struct Thing<'a> {
    /// What it displaces others with: its own number, or its object's where densities add up.
    pub own: usize,
    /// Where it is.
    pub body: Body<'a>,
}

/// The kinds of things.
pub enum Body<'a> {
    /// A shape.
    Solid(SolidBody<'a>),
    /// A closed mesh.
    Mesh(MeshBody<'a>),
    /// A voxel grid.
    Volume(Grid<'a>),
}

/// A shape of one material.
pub struct SolidBody<'a> {
    /// As in the scene.
    pub solid: &'a Solid,
    /// Into its frame.
    pub local_from_lps: DAffine3,
    /// Whether it is air, which displaces nothing.
    pub is_air: bool,
}

/// A mesh of one material.
pub struct MeshBody<'a> {
    /// As in the scene.
    pub mesh: &'a Mesh,
    /// Finds crossings.
    pub tree: MeshTree,
    /// Boxes of the tree, its first triangle or second child, its triangles (0: an inner node).
    pub nodes: Vec<([DVec3; 2], usize, usize)>,
    /// Whether it is air.
    pub is_air: bool,
}

/// A volume with what a point asks of it.
pub struct Grid<'a> {
    /// As in the scene.
    pub volume: &'a Volume,
    /// Into continuous voxel indices.
    pub voxel_from_lps: DAffine3,
    /// Scene material, and whether it is air, by class − 1.
    pub classes: Vec<(u32, bool)>,
    voxels: Voxels,
}

/// Densities by scene material at one point, as drawn.
#[derive(Clone, Debug, Default)]
pub struct Mix {
    /// Scene material and g/cm³; a material may stand there more than once.
    pub parts: Vec<(u32, f64)>,
    spans: Vec<(f64, f64)>,
}

/// The things of a scene, the last first.
pub fn things_of(scene: &Scene) -> Vec<Thing<'_>> {
    let mut things: Vec<Thing> = Vec::new();
    for object in &scene.objects {
        let first = things.len();
        match &object.matter {
            ObjectMatter::Solids(solids) => {
                let kept = solids.iter().filter(|solid| solid.density_g_per_cm3 > 0.0);
                things.extend(kept.zip(first..).map(|(solid, own)| {
                    let local_from_lps = affine(&solid.lps_from_local.inverse());
                    let is_air = scene.is_air(solid.material);
                    Thing { own, body: Body::Solid(SolidBody { solid, local_from_lps, is_air }) }
                }));
            }
            ObjectMatter::Mesh(mesh) if mesh.density_g_per_cm3 > 0.0 => {
                let tree = MeshTree::new(&mesh.vertices_lps_mm, &mesh.triangles);
                let nodes = tree.nodes().collect();
                let body = MeshBody { mesh, tree, nodes, is_air: scene.is_air(mesh.material) };
                things.push(Thing { own: first, body: Body::Mesh(body) });
            }
            ObjectMatter::Mesh(_) => {}
            ObjectMatter::Volume(_) | ObjectMatter::Parts(_) => {
                let parts = object.matter.volumes().iter();
                things.extend(parts.map(|part| Thing { own: first, body: Body::Volume(Grid::new(part, scene)) }));
            }
        }
    }
    things.reverse();
    things
}

fn affine(rigid: &crate::geometry::Rigid) -> DAffine3 {
    DAffine3::from_rotation_translation(rigid.rotation, rigid.translation_mm)
}

/// Draws what `chosen` of `things`, the last of the scene first, have at `point` into `mix`; its expectation is what they have there.
pub fn draw_at(things: &[Thing], chosen: &[u32], keeps_air: bool, point: DVec3, stream: &mut Stream, mix: &mut Mix) {
    mix.parts.clear();
    let alone = chosen.len() == 1;
    for air in [false, true] {
        if air && !keeps_air {
            return;
        }
        let mut present = usize::MAX;
        for thing in chosen.iter().filter_map(|index| things.get(*index as usize)) {
            if thing.own != present && !mix.parts.is_empty() {
                return;
            }
            present = thing.own;
            thing.body.draw_at(point, air, alone, stream, mix);
        }
        if !mix.parts.is_empty() {
            return;
        }
    }
}

impl Body<'_> {
    /// Adds what it has at `point`: its air if `air`, else its other matter.
    fn draw_at(&self, point: DVec3, air: bool, alone: bool, stream: &mut Stream, mix: &mut Mix) {
        match self {
            Self::Solid(body) if body.is_air == air => {
                if contains(&body.solid.shape, body.local_from_lps.transform_point3(point)) {
                    mix.parts.push((body.solid.material as u32, body.solid.density_g_per_cm3));
                }
            }
            Self::Mesh(body) if body.is_air == air => {
                if body.contains(point, &mut mix.spans) {
                    mix.parts.push((body.mesh.material as u32, body.mesh.density_g_per_cm3));
                }
            }
            Self::Volume(grid) => grid.draw_at(point, air, alone, stream, mix),
            Self::Solid(_) | Self::Mesh(_) => {}
        }
    }

    /// From where to where a ray runs inside a shape or mesh, mm ahead: the first stretch that ends beyond `after_mm`. `None` where there is
    /// none, and for volumes.
    #[must_use]
    pub fn next_stretch(&self, position: DVec3, direction: DVec3, after_mm: f64) -> Option<(f64, f64)> {
        let ends_beyond = |(_, to): &&(f64, f64)| *to > after_mm;
        match self {
            Self::Solid(body) => {
                let (p, q) = (body.local_from_lps.transform_point3(position), body.local_from_lps.transform_vector3(direction));
                intersect(&body.solid.shape, p, q).as_slice().iter().find(ends_beyond).copied()
            }
            Self::Mesh(body) => {
                let mut spans = Vec::new();
                body.tree.inside(position, direction, &mut spans);
                spans.iter().find(ends_beyond).copied()
            }
            Self::Volume(_) => None,
        }
    }
}

/// Whether a point of its own frame is in a shape.
#[must_use]
pub fn contains(shape: &Shape, p: DVec3) -> bool {
    match *shape {
        Shape::Ellipsoid { semi_axes_mm } => (p / semi_axes_mm).length_squared() <= 1.0,
        Shape::Cuboid { half_size_mm } => p.abs().cmple(half_size_mm).all(),
        Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } => {
            let squared = p.x * p.x + p.y * p.y;
            let hollow = inner_radius_mm > 0.0 && squared < inner_radius_mm * inner_radius_mm;
            p.z >= 0.0 && p.z <= length_mm && squared <= radius_mm * radius_mm && !hollow
        }
    }
}

impl MeshBody<'_> {
    /// Whether a point is inside: a line through it along no special direction has it between an entry and an exit.
    pub fn contains(&self, point: DVec3, spans: &mut Vec<(f64, f64)>) -> bool {
        const DIRECTION: DVec3 = DVec3::new(0.576_129, 0.613_407, 0.540_113);
        spans.clear();
        self.tree.inside(point, DIRECTION, spans);
        spans.iter().any(|(from, to)| *from <= 0.0 && *to > 0.0)
    }

    /// Whether a triangle may reach into a box.
    #[must_use]
    pub fn touches(&self, low: DVec3, high: DVec3) -> bool {
        let overlaps = |a: DVec3, b: DVec3| a.cmple(high).all() && b.cmpge(low).all();
        let mut open = vec![0];
        while let Some(index) = open.pop() {
            let Some(&(_, first, count)) = self.nodes.get(index).filter(|([from, to], ..)| overlaps(*from, *to)) else {
                continue;
            };
            if count == 0 {
                open.extend([index + 1, first]);
            } else if self.tree.triangles()[first..first + count]
                .iter()
                .any(|[a, b, c]| overlaps(a.min(*b).min(*c), a.max(*b).max(*c)))
            {
                return true;
            }
        }
        false
    }
}

impl<'a> Grid<'a> {
    fn new(volume: &'a Volume, scene: &Scene) -> Self {
        let classes = volume.class_materials.iter().map(|material| (*material as u32, scene.is_air(*material))).collect();
        Self { volume, voxel_from_lps: volume.lps_from_voxel.inverse(), classes, voxels: scene.model.voxels }
    }

    /// Whether the field is constant within voxels.
    #[must_use]
    pub fn is_piecewise_constant(&self) -> bool {
        self.voxels == Voxels::PiecewiseConstant
    }

    /// Scene material, density and whether it is air of the voxel at `index`; `None` where nothing is.
    #[inline]
    pub fn voxel(&self, index: usize) -> Option<(u32, f64, bool)> {
        let class = usize::from(self.volume.class[index]).checked_sub(1)?;
        let (material, air) = self.classes[class];
        let density = f64::from(self.volume.density_g_per_cm3[index]);
        (density > 0.0).then_some((material, density, air))
    }

    /// Adds one of the voxels around a point, drawn by its weight in the trilinear field: its expectation is the field, and one voxel is
    /// read instead of eight. `alone` says that nothing else can be there.
    // A cell whose corners hold anything but air counts as matter with the air in it, one of air alone as air: what lies below is displaced
    // even where an empty corner is drawn.
    fn draw_at(&self, point: DVec3, air: bool, alone: bool, stream: &mut Stream, mix: &mut Mix) {
        let size = self.volume.size;
        let voxel = self.voxel_from_lps.transform_point3(point).to_array();
        let (mut low, mut upper) = ([0; 3], [0.0; 3]);
        for axis in 0..3 {
            let last = size[axis] - 1;
            if !(voxel[axis] >= -0.5 && voxel[axis] <= last as f64 + 0.5) {
                return;
            }
            if self.is_piecewise_constant() {
                low[axis] = ((voxel[axis] + 0.5) as usize).min(last);
                continue;
            }
            let x = voxel[axis].clamp(0.0, last as f64);
            low[axis] = (x as usize).min(last.saturating_sub(1));
            upper[axis] = x - low[axis] as f64;
        }
        let drawn: [usize; 3] = std::array::from_fn(|axis| low[axis] + usize::from(stream.uniform() < upper[axis]));
        let found = self.voxel(self.volume.index(drawn[0], drawn[1], drawn[2]));
        let holds_matter = match found {
            Some((.., false)) => true,
            _ if alone => !air,
            _ => self.holds_matter(low, upper),
        };
        match found {
            Some((material, density, _)) if holds_matter != air => mix.parts.push((material, density)),
            // It displaces what lies below all the same.
            None if holds_matter && !air => mix.parts.push((self.classes[0].0, 0.0)),
            _ => {}
        }
    }

    /// Whether a corner with weight holds anything but air.
    fn holds_matter(&self, low: [usize; 3], upper: [f64; 3]) -> bool {
        (0..8usize).any(|bits| {
            let is_upper = |axis: usize| bits >> axis & 1 == 1;
            let has_weight = (0..3).all(|axis| if is_upper(axis) { upper[axis] > 0.0 } else { upper[axis] < 1.0 });
            let [i, j, k] = std::array::from_fn(|axis| low[axis] + usize::from(is_upper(axis)));
            has_weight && matches!(self.voxel(self.volume.index(i, j, k)), Some((.., false)))
        })
    }
}

/// Bounds of a thing in `lps`, mm.
#[must_use]
pub fn bounds_of(body: &Body) -> (DVec3, DVec3) {
    match body {
        Body::Solid(body) => {
            let (low, high) = local_bounds(&body.solid.shape);
            around(&affine(&body.solid.lps_from_local), low, high)
        }
        Body::Mesh(body) => {
            let vertices = body.mesh.vertices_lps_mm.iter();
            vertices.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)))
        }
        Body::Volume(grid) => {
            let last = DVec3::from_array(grid.volume.size.map(|n| n as f64 - 0.5));
            around(&grid.volume.lps_from_voxel, DVec3::splat(-0.5), last)
        }
    }
}

/// Bounds of a shape in its own frame.
#[must_use]
pub fn local_bounds(shape: &Shape) -> (DVec3, DVec3) {
    match *shape {
        Shape::Ellipsoid { semi_axes_mm } => (-semi_axes_mm, semi_axes_mm),
        Shape::Cuboid { half_size_mm } => (-half_size_mm, half_size_mm),
        Shape::Cylinder { length_mm, radius_mm, .. } => {
            (DVec3::new(-radius_mm, -radius_mm, 0.0), DVec3::new(radius_mm, radius_mm, length_mm))
        }
    }
}

/// Bounds of a box after `map`.
#[must_use]
pub fn around(map: &DAffine3, low: DVec3, high: DVec3) -> (DVec3, DVec3) {
    let (centre, half) = (map.transform_point3(0.5 * (low + high)), 0.5 * (high - low));
    let matrix = map.matrix3;
    let reach = matrix.x_axis.abs() * half.x + matrix.y_axis.abs() * half.y + matrix.z_axis.abs() * half.z;
    (centre - reach, centre + reach)
}
