//! Where a ray is inside a closed triangle mesh: crossings with their sign, none lost or doubled at common edges.

use glam::DVec3;

use super::intervals::Intervals;
use super::shapes::Ray;
use crate::scene::model::Mesh;

/// Triangles sorted into boxes of boxes, so that a ray looks at few of them.
#[derive(Clone, Debug)]
pub struct Tree<'a> {
    mesh: &'a Mesh,
    order: Vec<u32>,
    nodes: Vec<Node>,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    low: DVec3,
    high: DVec3,
    /// Triangles `order[first..first + count]` of a leaf; `count` 0 for an inner node, whose children are the next one and `first`.
    first: usize,
    count: usize,
}

const LEAF: usize = 4;

impl<'a> Tree<'a> {
    /// Sorts the triangles by halving along the longest axis.
    #[must_use]
    pub fn new(mesh: &'a Mesh) -> Self {
        let mut tree = Self { mesh, order: (0..mesh.triangles.len() as u32).collect(), nodes: Vec::new() };
        if !mesh.triangles.is_empty() {
            tree.grow(0, mesh.triangles.len());
        }
        tree
    }

    fn corners(&self, triangle: u32) -> [DVec3; 3] {
        self.mesh.triangles[triangle as usize].map(|vertex| self.mesh.vertices_lps_mm[vertex as usize])
    }

    fn grow(&mut self, from: usize, to: usize) {
        let points = || self.order[from..to].iter().flat_map(|triangle| self.corners(*triangle));
        let low = points().fold(DVec3::INFINITY, DVec3::min);
        let high = points().fold(DVec3::NEG_INFINITY, DVec3::max);
        let index = self.nodes.len();
        self.nodes.push(Node { low, high, first: from, count: to - from });
        if to - from <= LEAF {
            return;
        }
        let axis = (high - low).max_position();
        let middle = from + (to - from) / 2;
        let mut part = self.order[from..to].to_vec();
        let centre = |triangle: u32| self.corners(triangle).iter().map(|corner| corner[axis]).sum::<f64>();
        part.sort_by(|a, b| centre(*a).total_cmp(&centre(*b)));
        self.order[from..to].copy_from_slice(&part);
        self.grow(from, middle);
        self.nodes[index] = Node { low, high, first: self.nodes.len(), count: 0 };
        self.grow(middle, to);
    }

    /// Depths at which the winding number is not 0.
    #[must_use]
    pub fn inside(&self, ray: &Ray) -> Intervals {
        let mut crossings = Vec::new();
        let frame = Frame::new(ray.direction);
        let mut open = if self.nodes.is_empty() { Vec::new() } else { vec![0] };
        while let Some(index) = open.pop() {
            let node = self.nodes[index];
            if !passes(&node, ray) {
                continue;
            }
            if node.count == 0 {
                open.push(index + 1);
                open.push(node.first);
                continue;
            }
            for triangle in &self.order[node.first..node.first + node.count] {
                crossings.extend(frame.crossing(self.corners(*triangle), ray.origin));
            }
        }
        crossings.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut winding, mut entered, mut found) = (0, 0.0, Vec::new());
        for (depth, step) in crossings {
            if winding == 0 {
                entered = depth;
            }
            winding += step;
            if winding == 0 {
                found.push([entered, depth]);
            }
        }
        Intervals::of(found).intersection(&Intervals::between(0.0, ray.end_mm))
    }
}

/// Whether the line (not only the half line) passes the box; generous by rounding.
fn passes(node: &Node, ray: &Ray) -> bool {
    let margin = 1e-9 * (1.0 + node.low.abs().max(node.high.abs()).max_element() + ray.origin.abs().max_element());
    let (mut from, mut to) = (f64::NEG_INFINITY, f64::INFINITY);
    for axis in 0..3 {
        let (low, high) = (node.low[axis] - margin, node.high[axis] + margin);
        let (o, d) = (ray.origin[axis], ray.direction[axis]);
        if d == 0.0 {
            if o < low || o > high {
                return false;
            }
            continue;
        }
        let (a, b) = ((low - o) / d, (high - o) / d);
        from = from.max(a.min(b));
        to = to.min(a.max(b));
    }
    from <= to
}

/// The ray's frame: axes permuted so that the ray runs along the last one, and sheared so that it runs exactly along it (Woop, Benthin and
/// Wald 2013). A vertex's sheared position depends on the vertex alone, so triangles with a common edge judge it by the same numbers.
struct Frame {
    axes: [usize; 3],
    shear: [f64; 2],
    scale: f64,
}

impl Frame {
    fn new(direction: DVec3) -> Self {
        let z = direction.abs().max_position();
        let (x, y) = ((z + 1) % 3, (z + 2) % 3);
        Self { axes: [x, y, z], shear: [direction[x] / direction[z], direction[y] / direction[z]], scale: direction[z] }
    }

    /// Depth, and +1 where the ray enters or −1 where it leaves.
    fn crossing(&self, corners: [DVec3; 3], origin: DVec3) -> Option<(f64, i32)> {
        let [x, y, z] = self.axes;
        let sheared = corners.map(|corner| {
            let p = corner - origin;
            [p[x] - self.shear[0] * p[z], p[y] - self.shear[1] * p[z], p[z]]
        });
        let sides = [side(sheared[1], sheared[2]), side(sheared[2], sheared[0]), side(sheared[0], sheared[1])];
        let positive = sides[0].1;
        if sides.iter().any(|(_, sign)| *sign != positive) {
            return None;
        }
        let sum: f64 = sides.iter().map(|(area, _)| area).sum();
        let along = if sum == 0.0 {
            // Seen edge-on within rounding.
            (sheared[0][2] + sheared[1][2] + sheared[2][2]) / 3.0
        } else {
            sides.iter().zip(&sheared).map(|((area, _), p)| area / sum * p[2]).sum()
        };
        // Counter-clockwise from outside: seen along the ray (permutation of axes keeps handedness) an entry runs clockwise.
        let entering = positive != (self.scale > 0.0);
        Some((along / self.scale, if entering { 1 } else { -1 }))
    }
}

/// On which side of the edge p → q the ray passes, and twice the area with it. Exactly on the edge, the ray counts as moved by an
/// infinitesimal step in y and an infinitely smaller one in x: the same for both triangles of the edge, which walk it in opposite directions.
fn side(p: [f64; 3], q: [f64; 3]) -> (f64, bool) {
    let area = p[0] * q[1] - p[1] * q[0];
    let sign = if area != 0.0 {
        area > 0.0
    } else {
        // d(area) for the ray moving by (ε², ε): vertices move by −(ε², ε).
        let by_y = q[0] - p[0];
        let by_x = p[1] - q[1];
        if by_y != 0.0 { by_y > 0.0 } else { by_x > 0.0 }
    };
    (area, sign)
}
