//! Where rays run inside a closed mesh: a bounding-volume tree, then pairs of crossings.

use glam::DVec3;

use crate::geometry::Rigid;

const LEAF: usize = 4;

/// What boxes are enlarged by, mm: more than f64 rounds.
const BOX_MARGIN_MM: f64 = 1e-9;

/// More than the depth of any tree: halving at the median leaves 2⁶⁴ triangles no deeper.
const DEEPEST: usize = 66;

/// A tree over the triangles of a mesh, in the frame of its vertices.
#[derive(Clone, Debug)]
pub struct MeshTree {
    nodes: Vec<Node>,
    triangles: Vec<[DVec3; 3]>,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    lo: DVec3,
    hi: DVec3,
    /// First triangle of a leaf, or index of the second child (the first follows its parent).
    first: usize,
    /// Triangles of a leaf; 0 for an inner node.
    count: usize,
}

impl MeshTree {
    /// Builds the tree by halving at the median.
    #[must_use]
    pub fn new(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let mut tree = Self { nodes: Vec::new(), triangles: triangles.iter().map(|t| t.map(|i| vertices[i as usize])).collect() };
        if !tree.triangles.is_empty() {
            tree.build(0, triangles.len());
        }
        tree
    }

    fn build(&mut self, from: usize, to: usize) {
        let corners = self.triangles[from..to].iter().flatten();
        let (lo, hi) = corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), v| (lo.min(*v), hi.max(*v)));
        let index = self.nodes.len();
        self.nodes.push(Node { lo, hi, first: from, count: to - from });
        if to - from <= LEAF {
            return;
        }
        let axis = (hi - lo).max_position();
        let middle = usize::midpoint(from, to);
        let centre = |t: &[DVec3; 3]| t[0][axis] + t[1][axis] + t[2][axis];
        self.triangles[from..to].select_nth_unstable_by(middle - from, |a, b| centre(a).total_cmp(&centre(b)));
        self.build(from, middle);
        self.nodes[index].first = self.nodes.len();
        self.nodes[index].count = 0;
        self.build(middle, to);
    }

    /// Lower and upper corner of each node, its first triangle or second child, its triangles (0: an inner node).
    pub fn nodes(&self) -> impl Iterator<Item = ([DVec3; 2], usize, usize)> {
        self.nodes.iter().map(|node| ([node.lo, node.hi], node.first, node.count))
    }

    /// The triangles, leaf by leaf.
    #[must_use]
    pub fn triangles(&self) -> &[[DVec3; 3]] {
        &self.triangles
    }

    /// The same triangles in another frame, where boxes are drawn anew around them.
    #[must_use]
    pub fn placed(&self, other_from_own: &Rigid) -> Self {
        let place = |t: &[DVec3; 3]| t.map(|corner| other_from_own.transform_point(corner));
        let mut tree = Self { nodes: self.nodes.clone(), triangles: self.triangles.iter().map(place).collect() };
        // Children follow their parents.
        for index in (0..tree.nodes.len()).rev() {
            let node = tree.nodes[index];
            let (lo, hi) = if node.count == 0 {
                let (left, right) = (tree.nodes[index + 1], tree.nodes[node.first]);
                (left.lo.min(right.lo), left.hi.max(right.hi))
            } else {
                let corners = tree.triangles[node.first..node.first + node.count].iter().flatten();
                corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), v| (lo.min(*v), hi.max(*v)))
            };
            (tree.nodes[index].lo, tree.nodes[index].hi) = (lo, hi);
        }
        tree
    }

    /// Boxes and triangles that a ray is tried against.
    #[must_use]
    pub fn tests(&self, origin: DVec3, direction: DVec3) -> usize {
        let mut triangles = 0;
        self.visit(origin, direction, |leaf| triangles += leaf.len()) + triangles
    }

    /// Gives the triangles of leaves whose boxes a ray meets to `leaf`; returns how many boxes were tried.
    #[inline(always)]
    fn visit(&self, origin: DVec3, direction: DVec3, mut leaf: impl FnMut(&[[DVec3; 3]])) -> usize {
        // A ray along the faces of a box: far in or far out, never 0 · ∞.
        let inverse = DVec3::from_array(direction.to_array().map(|q| 1.0 / if q.abs() < 1e-300 { 1e-300 } else { q }));
        let mut stack = [0usize; DEEPEST];
        let mut waiting = usize::from(!self.nodes.is_empty());
        let mut boxes = 0;
        while waiting > 0 {
            waiting -= 1;
            boxes += 1;
            let index = stack[waiting];
            let node = &self.nodes[index];
            let (a, b) = ((node.lo - BOX_MARGIN_MM - origin) * inverse, (node.hi + BOX_MARGIN_MM - origin) * inverse);
            if !(a.min(b).max_element() <= a.max(b).min_element()) {
                continue;
            }
            if node.count == 0 {
                stack[waiting] = node.first;
                stack[waiting + 1] = index + 1;
                waiting += 2;
                continue;
            }
            leaf(&self.triangles[node.first..node.first + node.count]);
        }
        boxes
    }

    /// Adds to `spans` where the ray `origin` + t · `direction`, t > −∞, is inside, by pairing entries and exits.
    // Edges are tested by the sign of a product that both neighbours compute from the same two vertices, so that no ray slips
    // between triangles (watertight, Plücker form); the winding number, not parity, survives faces that touch.
    pub fn inside(&self, origin: DVec3, direction: DVec3, spans: &mut Vec<(f64, f64)>) {
        let mut crossings: Vec<(f64, i32)> = Vec::new();
        self.visit(origin, direction, |leaf| {
            crossings.extend(leaf.iter().filter_map(|t| cross(&t.map(|corner| corner - origin), direction)));
        });
        crossings.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut winding = 0;
        let mut start = 0.0;
        for (t, sign) in crossings {
            let before = winding;
            winding += sign;
            if before == 0 {
                start = t;
            } else if winding == 0 && t > start {
                spans.push((start, t));
            }
        }
    }
}

/// Depth at which a ray from (0, 0, 0) crosses, and +1 where it enters (against the outward normal), −1 where it leaves.
fn cross([a, b, c]: &[DVec3; 3], direction: DVec3) -> Option<(f64, i32)> {
    // Each edge's product is formed with its vertices in one fixed order, so that neighbours agree to the last bit.
    let edge = |p: DVec3, q: DVec3| {
        let swap = (p.x, p.y, p.z) > (q.x, q.y, q.z);
        let value = if swap { -direction.dot(q.cross(p)) } else { direction.dot(p.cross(q)) };
        if value == 0.0 { touched(p, q, direction) } else { value }
    };
    let (ab, bc, ca) = (edge(*a, *b), edge(*b, *c), edge(*c, *a));
    let leaves = ab > 0.0 && bc > 0.0 && ca > 0.0;
    let enters = ab < 0.0 && bc < 0.0 && ca < 0.0;
    if !(leaves || enters) {
        return None;
    }
    let normal = (*b - *a).cross(*c - *a);
    let t = normal.dot(*a) / normal.dot(direction);
    // Seen edge-on within rounding: without this crossing the ray would never leave what it entered.
    let t = if t.is_finite() { t } else { direction.dot(*a + *b + *c) / (3.0 * direction.length_squared()) };
    Some((t, if enters { 1 } else { -1 }))
}

/// The side on which a ray passes that meets the edge p → q exactly, as all rays do whose source lies on it.
// The ray counts as moved by δ = (ε, ε², ε³). The product then changes by δ · ((q − p) × d): linear in q − p, so that all edges of a corner are
// judged by the same step, and one entry and one exit remain of the faces that meet there; and odd in it, so that both faces of an edge agree.
fn touched(p: DVec3, q: DVec3, direction: DVec3) -> f64 {
    let change = (q - p).cross(direction).to_array();
    change.into_iter().find(|part| *part != 0.0).map_or(f64::MIN_POSITIVE, |part| f64::MIN_POSITIVE.copysign(part))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(centre: DVec3, half: f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let corner = |i: usize| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64) * 2.0 - 1.0;
        let vertices = (0..8).map(|i| centre + corner(i) * half).collect();
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
        (vertices, triangles)
    }

    #[test]
    fn rays_through_faces_edges_and_corners_of_a_cube_agree_with_the_box() {
        let (vertices, triangles) = cube(DVec3::new(0.0, 0.0, 100.0), 10.0);
        let tree = MeshTree::new(&vertices, &triangles);
        let mut cases = 0;
        for u in -12..=12 {
            for v in -12..=12 {
                let direction = DVec3::new(f64::from(u) * 0.01, f64::from(v) * 0.01, 1.0);
                let mut spans = Vec::new();
                tree.inside(DVec3::ZERO, direction, &mut spans);
                let found: f64 = spans.iter().map(|(a, b)| b - a).sum();
                let expected = crate::render::cpu::shapes::cuboid(
                    DVec3::new(0.0, 0.0, -100.0),
                    direction,
                    DVec3::splat(-10.0),
                    DVec3::splat(10.0),
                )
                .map_or(0.0, |(a, b)| b - a);
                assert!((found - expected).abs() < 1e-9, "({u}, {v}): {found} and {expected}");
                cases += 1;
            }
        }
        assert_eq!(cases, 625);
    }

    #[test]
    fn a_tree_in_another_frame_finds_the_same() {
        let (vertices, triangles) = cube(DVec3::new(3.0, -4.0, 20.0), 10.0);
        let tree = MeshTree::new(&vertices, &triangles);
        let turn = Rigid {
            rotation: glam::DQuat::from_scaled_axis(DVec3::new(0.3, -1.1, 0.7)),
            translation_mm: DVec3::new(5.0, 60.0, -7.0),
        };
        let placed = tree.placed(&turn);
        let (mut met, mut cases) = (0, 0);
        for u in -9..=9 {
            for v in -9..=9 {
                let direction = DVec3::new(0.11 * f64::from(u), 0.1 * f64::from(v), 1.0);
                let (mut here, mut there) = (Vec::new(), Vec::new());
                tree.inside(DVec3::new(0.0, 0.0, -30.0), direction, &mut here);
                let origin = turn.transform_point(DVec3::new(0.0, 0.0, -30.0));
                placed.inside(origin, turn.rotation * direction, &mut there);
                let length = |spans: &[(f64, f64)]| spans.iter().map(|(a, b)| b - a).sum::<f64>();
                assert!((length(&here) - length(&there)).abs() < 1e-9, "({u}, {v}): {here:?} and {there:?}");
                met += usize::from(!here.is_empty());
                cases += 1;
            }
        }
        assert!(cases == 361 && met > 10 && met < 300, "{met} of {cases} rays met the cube");
    }

    /// Sources on the mesh itself. Where each edge of the corner at the source fell to a side by the order of its ends alone, the faces there gave a
    /// ray two entries, or none, and the whole mesh was lost to it.
    #[test]
    fn rays_from_corners_edges_and_faces_agree_with_the_planes_of_a_cube_and_of_a_tetrahedron() {
        let (cube_corners, cube_faces) = cube(DVec3::ZERO, 20.0);
        let corners = vec![DVec3::ZERO, 40.0 * DVec3::X, 40.0 * DVec3::Y, 40.0 * DVec3::Z];
        let faces: Vec<[u32; 3]> = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        let (mut lost, mut met, mut cases) = (Vec::new(), 0, 0);
        for (corners, faces) in [(cube_corners, cube_faces), (corners, faces)] {
            let tree = MeshTree::new(&corners, &faces);
            let mut sources = corners.clone();
            for triangle in &faces {
                let [a, b, c] = triangle.map(|index| corners[index as usize]);
                sources.extend([a.midpoint(b), b.lerp(c, 0.25), (a + b + c) / 3.0]);
            }
            for (source, (u, v), side) in sources.iter().flat_map(|source| {
                let steps = (-6..=6).flat_map(|u| (-6..=6).map(move |v| (u, v)));
                steps.flat_map(move |step| [(source, step, 1.0), (source, step, -1.0)])
            }) {
                // In no plane of a face.
                let direction = DVec3::new(0.1673 * f64::from(u) + 0.0137, 0.1459 * f64::from(v) + 0.0091, side);
                let mut spans = Vec::new();
                tree.inside(*source, direction, &mut spans);
                let ahead: f64 = spans.iter().map(|(from, to)| to.max(0.0) - from.max(0.0)).sum();
                let expected = between_planes(&corners, &faces, *source, direction);
                if !((ahead - expected).abs() < 1e-9) {
                    lost.push((*source, direction, ahead, expected));
                }
                met += usize::from(expected > 1.0);
                cases += 1;
            }
        }
        assert!(cases == 338 * (8 + 36 + 4 + 12) && met > 3000, "{met} of {cases} rays are inside for long");
        assert!(lost.is_empty(), "{} of {cases} rays, such as {:?}", lost.len(), lost[0]);
    }

    /// Length ahead of `source` within the planes of a convex mesh's faces.
    fn between_planes(corners: &[DVec3], faces: &[[u32; 3]], source: DVec3, direction: DVec3) -> f64 {
        let (mut from, mut to) = (0.0f64, f64::INFINITY);
        for face in faces {
            let [a, b, c] = face.map(|index| corners[index as usize]);
            let normal = (b - a).cross(c - a).normalize();
            let (room, rise) = (normal.dot(a - source), normal.dot(direction));
            // A source in the plane, but for rounding.
            let room = if room.abs() < 1e-12 { 0.0 } else { room };
            if rise > 0.0 {
                to = to.min(room / rise);
            } else {
                from = from.max(room / rise);
            }
        }
        (to - from).max(0.0)
    }
}
