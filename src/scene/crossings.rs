//! Faces of a surface that cross each other.

use glam::DVec3;

/// Triangles in a leaf of the tree.
const LEAF: usize = 8;
/// Volumes below this share of the cube over the extent are rounding: faces that touch do not cross.
const ROUNDING: f64 = 1e-12;
/// Enough to know that a surface is broken.
const MOST: usize = 1000;

struct Node {
    low: DVec3,
    high: DVec3,
    /// Triangles `order[first..first + count]`; `count` 0 for an inner node, whose children are the next one and `first`.
    first: usize,
    count: usize,
}

struct Tree<'a> {
    vertices: &'a [DVec3],
    triangles: &'a [[u32; 3]],
    order: Vec<u32>,
    nodes: Vec<Node>,
}

/// Pairs of faces of which an edge of one goes through the other (at most 1000), and where the first does, mm. Faces that touch or lie in
/// one plane do not count.
pub(super) fn crossing_faces(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Option<(usize, DVec3)> {
    let mut tree = Tree { vertices, triangles, order: (0..triangles.len() as u32).collect(), nodes: Vec::new() };
    if triangles.is_empty() {
        return None;
    }
    tree.grow(0, triangles.len());
    let limit = ROUNDING * (tree.nodes[0].high - tree.nodes[0].low).max_element().powi(3);
    let (mut pairs, mut place) = (0, None);
    for triangle in 0..triangles.len() as u32 {
        tree.visit_near(triangle, |other| {
            let pierced = pierced_at(&tree, triangle, other, limit).or_else(|| pierced_at(&tree, other, triangle, limit));
            if let Some(point) = pierced {
                pairs += 1;
                place.get_or_insert(point);
            }
        });
        if pairs >= MOST {
            break;
        }
    }
    place.map(|point| (pairs.min(MOST), point))
}

/// Where an edge of `through` that shares no vertex with `face` goes through its inside.
fn pierced_at(tree: &Tree, through: u32, face: u32, limit: f64) -> Option<DVec3> {
    let (edges, corners) = (tree.triangles[through as usize], tree.triangles[face as usize]);
    let [a, b, c] = corners.map(|vertex| tree.vertices[vertex as usize]);
    (0..3).map(|side| (edges[side], edges[(side + 1) % 3])).find_map(|(from, to)| {
        if corners.contains(&from) || corners.contains(&to) {
            return None;
        }
        let (p, q) = (tree.vertices[from as usize], tree.vertices[to as usize]);
        // Six times the signed volumes of tetrahedra: p and q on either side of the plane, the line inside all three edges or on one.
        let volume = |a: DVec3, b: DVec3, c: DVec3, d: DVec3| (a - d).dot((b - d).cross(c - d));
        let (above, below) = (volume(a, b, c, p), volume(a, b, c, q));
        if !(above.abs() > limit && below.abs() > limit && (above > 0.0) != (below > 0.0)) {
            return None;
        }
        let sides = [volume(a, b, p, q), volume(b, c, p, q), volume(c, a, p, q)];
        let inside = sides.iter().all(|side| *side >= -limit) || sides.iter().all(|side| *side <= limit);
        let flat = sides.iter().all(|side| side.abs() <= limit);
        (inside && !flat).then(|| p.lerp(q, above / (above - below)))
    })
}

impl Tree<'_> {
    fn corners(&self, triangle: u32) -> [DVec3; 3] {
        self.triangles[triangle as usize].map(|vertex| self.vertices[vertex as usize])
    }

    fn bounds(&self, triangles: &[u32]) -> (DVec3, DVec3) {
        let points = triangles.iter().flat_map(|triangle| self.corners(*triangle));
        points.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
    }

    fn grow(&mut self, from: usize, to: usize) {
        let (low, high) = self.bounds(&self.order[from..to]);
        let index = self.nodes.len();
        self.nodes.push(Node { low, high, first: from, count: to - from });
        if to - from <= LEAF {
            return;
        }
        let axis = (high - low).max_position();
        let middle = usize::midpoint(from, to);
        let mut part = self.order[from..to].to_vec();
        let centre = |triangle: &u32| self.corners(*triangle).iter().map(|corner| corner[axis]).sum::<f64>();
        part.select_nth_unstable_by(middle - from, |a, b| centre(a).total_cmp(&centre(b)));
        self.order[from..to].copy_from_slice(&part);
        self.grow(from, middle);
        self.nodes[index].first = self.nodes.len();
        self.nodes[index].count = 0;
        self.grow(middle, to);
    }

    /// Calls `visit` for every later triangle whose box meets that of `triangle`.
    fn visit_near(&self, triangle: u32, mut visit: impl FnMut(u32)) {
        let (low, high) = self.bounds(&[triangle]);
        let meets = |other: (DVec3, DVec3)| low.cmple(other.1).all() && other.0.cmple(high).all();
        let mut open = vec![0];
        while let Some(index) = open.pop() {
            let node = &self.nodes[index];
            if !meets((node.low, node.high)) {
                continue;
            }
            if node.count == 0 {
                open.extend([node.first, index + 1]);
                continue;
            }
            let later = self.order[node.first..node.first + node.count].iter().filter(|other| **other > triangle);
            later.filter(|other| meets(self.bounds(&[**other]))).for_each(|other| visit(*other));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(from: f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let corner = |bits: u32| DVec3::new(f64::from(bits & 1), f64::from(bits >> 1 & 1), f64::from(bits >> 2)) * 2.0 + from;
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        ((0..8).map(corner).collect(), triangles)
    }

    fn two_cubes(apart: f64) -> Option<(usize, DVec3)> {
        let (mut vertices, mut triangles) = cube(0.0);
        let (more, others) = cube(apart);
        vertices.extend(more);
        triangles.extend(others.iter().map(|t| t.map(|v| v + 8)));
        crossing_faces(&vertices, &triangles)
    }

    #[test]
    fn overlapping_cubes_cross_and_others_do_not() {
        let (vertices, triangles) = cube(0.0);
        assert_eq!(crossing_faces(&vertices, &triangles), None);
        assert_eq!((two_cubes(3.0), two_cubes(2.0)), (None, None), "apart, and corner to corner");
        // Three edges of each cube go through faces of the other.
        let (pairs, point) = two_cubes(0.7).expect("overlap");
        assert!(pairs >= 6, "{pairs}");
        assert!(point.min_element() >= 0.7 - 1e-12 && point.max_element() <= 2.0 + 1e-12, "{point}");
    }
}
