//! What was made of a mesh, once for all views: its tree, where it lies, and the edges at which its shadow can have edges.

use std::collections::HashMap;
use std::sync::{Arc, OnceLock};

use glam::DVec3;

use super::mesh_tree::MeshTree;
use crate::scene::model::Mesh;

/// Faces that meet at an edge more sharply than this leave a line in the shadow from wherever it is seen; cosine of the angle of normals.
const SHARP: f64 = 0.94;

/// An edge between two faces.
#[derive(Clone, Copy, Debug)]
pub struct MeshEdge {
    /// Its ends, lps mm.
    pub ends: [DVec3; 2],
    /// Normals of the faces, of any length; (0, 0, 0) where there is none.
    normals: [DVec3; 2],
    sharp: bool,
}

impl MeshEdge {
    /// Whether the shadow may have an edge here, seen from `source` in lps: one face is turned towards it and the other is not, or they meet
    /// sharply.
    #[must_use]
    pub fn shows_from(&self, source: DVec3) -> bool {
        let to_source = source - self.ends[0];
        let [a, b] = self.normals.map(|normal| normal.dot(to_source));
        // NaN and faces seen edge-on count as edges.
        self.sharp || !(a * b > 0.0)
    }
}

/// What was made of a mesh.
#[derive(Debug)]
pub struct MadeMesh {
    /// In lps.
    pub tree: MeshTree,
    /// Middle of the box around it, lps mm.
    pub centre_lps_mm: DVec3,
    /// From there to the farthest corner of that box.
    pub radius_mm: f64,
    edges: OnceLock<Vec<MeshEdge>>,
}

impl MadeMesh {
    /// Builds the tree.
    #[must_use]
    pub fn new(mesh: &Mesh) -> Self {
        let vertices = &mesh.vertices_lps_mm;
        let (lo, hi) = vertices.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), v| (lo.min(*v), hi.max(*v)));
        Self {
            tree: MeshTree::new(vertices, &mesh.triangles),
            centre_lps_mm: 0.5 * (lo + hi),
            radius_mm: 0.5 * (hi - lo).length(),
            edges: OnceLock::new(),
        }
    }

    /// All edges, found when they are first asked for.
    #[must_use]
    pub fn edges(&self) -> &[MeshEdge] {
        self.edges.get_or_init(|| edges(self.tree.triangles()))
    }
}

/// Pairs the faces by the places of their corners, which files without indices repeat.
fn edges(triangles: &[[DVec3; 3]]) -> Vec<MeshEdge> {
    let key = |v: DVec3| v.to_array().map(|x| (x + 0.0).to_bits());
    let mut found: HashMap<[[u64; 3]; 2], usize> = HashMap::new();
    let mut edges: Vec<MeshEdge> = Vec::new();
    for [a, b, c] in triangles {
        let normal = (*b - *a).cross(*c - *a);
        for (p, q) in [(a, b), (b, c), (c, a)] {
            let keys = [key(*p), key(*q)];
            let keys = if keys[0] <= keys[1] { keys } else { [keys[1], keys[0]] };
            match found.get(&keys) {
                Some(index) if edges[*index].normals[1] == DVec3::ZERO => edges[*index].normals[1] = normal,
                // Where more than two faces meet, anything may happen.
                Some(index) => edges[*index].sharp = true,
                None => {
                    found.insert(keys, edges.len());
                    edges.push(MeshEdge { ends: [*p, *q], normals: [normal, DVec3::ZERO], sharp: false });
                }
            }
        }
    }
    for edge in &mut edges {
        let [a, b] = edge.normals;
        edge.sharp |= !(a.dot(b) >= SHARP * a.length() * b.length()) || b == DVec3::ZERO;
    }
    edges
}

/// Made meshes of the scene that was rendered last.
#[derive(Debug, Default)]
pub struct MeshCache {
    held: Vec<(Arc<Mesh>, Arc<MadeMesh>)>,
}

impl MeshCache {
    /// Forgets all meshes but those for which `holds` is true.
    pub fn keep(&mut self, holds: impl Fn(&Arc<Mesh>) -> bool) {
        self.held.retain(|(mesh, _)| holds(mesh));
    }

    /// What was made of `mesh`; makes it the first time.
    pub fn make(&mut self, mesh: &Arc<Mesh>) -> Arc<MadeMesh> {
        if let Some((_, made)) = self.held.iter().find(|(held, _)| Arc::ptr_eq(held, mesh)) {
            return made.clone();
        }
        let made = Arc::new(MadeMesh::new(mesh));
        self.held.push((mesh.clone(), made.clone()));
        made
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cube_has_twelve_edges_that_show_and_six_diagonals_that_do_not() {
        let corner = |i: usize| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64) * 2.0 - 1.0;
        let quads = [[0u32, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles: Vec<[u32; 3]> = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
        let mesh = Mesh { vertices_lps_mm: (0..8).map(corner).collect(), triangles, material: 0, density_g_per_cm3: 1.0 };
        let made = MadeMesh::new(&mesh);
        let shown = made.edges().iter().filter(|edge| edge.shows_from(DVec3::new(0.3, 0.2, -20.0))).count();
        assert_eq!((made.edges().len(), shown), (18, 12));
        let open = MadeMesh::new(&Mesh { triangles: mesh.triangles[..2].to_vec(), ..mesh });
        assert!(open.edges().iter().filter(|edge| edge.shows_from(DVec3::new(0.0, 0.0, -20.0))).count() >= 4, "a rim shows");
    }

    #[test]
    fn a_mesh_is_made_once_and_forgotten_when_it_is_gone() {
        let mesh = Arc::new(Mesh {
            vertices_lps_mm: vec![DVec3::ZERO, DVec3::X, DVec3::Y],
            triangles: vec![[0, 1, 2]],
            material: 0,
            density_g_per_cm3: 1.0,
        });
        let mut cache = MeshCache::default();
        let first = cache.make(&mesh);
        assert!(Arc::ptr_eq(&first, &cache.make(&mesh)), "made once");
        cache.keep(|_| false);
        assert!(!Arc::ptr_eq(&first, &cache.make(&mesh)), "made anew");
    }
}
