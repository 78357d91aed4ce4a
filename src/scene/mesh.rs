//! STL surfaces: welded, checked for holes, turned the right way out.

use std::collections::HashMap;
use std::io::Read;
use std::path::Path;

use glam::DVec3;

use super::SceneError;
use super::crossings::crossing_faces;
use super::foreign_files::read_triangles;
use super::model::Mesh;
use crate::geometry::{RAS_FROM_LPS, Rigid};
use crate::reporter::Reporter;

/// A closed surface in the frame of its file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Surface {
    /// Vertices, each position once.
    pub vertices_mm: Vec<DVec3>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

/// Reads an STL file (binary or ASCII, mm) and makes sure that it encloses something: equal vertices are welded, degenerate triangles
/// dropped, faces turned so that they agree and point outward; what was repaired is reported, and so are faces that cross each other and
/// a size that speaks for another unit.
///
/// # Errors
/// When the file is damaged, or the surface has holes.
pub(super) fn read_surface(path: &Path, reporter: &Reporter) -> Result<Surface, SceneError> {
    let wrong = |detail: String| SceneError::Mesh { path: path.to_owned(), detail };
    let corners = read_triangles(path)?;
    if !corners.iter().flatten().flatten().all(|x| x.is_finite()) {
        return Err(wrong("a vertex is not finite".to_owned()));
    }
    let (surface, dropped) = weld(&corners);
    if dropped > 0 {
        reporter.note(format_args!("{}: {dropped} triangles without area are left out", path.display()));
    }
    if surface.triangles.is_empty() {
        return Err(wrong("no triangle with an area".to_owned()));
    }
    let surface = close(surface, path, reporter)?;
    let first = surface.vertices_mm[0];
    let fold = |pick: fn(DVec3, DVec3) -> DVec3| surface.vertices_mm.iter().fold(first, |found, p| pick(found, *p));
    if let Some(words) = mesh_unit_doubt((fold(DVec3::max) - fold(DVec3::min)).max_element()) {
        reporter.warn("mesh units", format_args!("{}: {words}", path.display()));
    }
    if let Some((pairs, at)) = crossing_faces(&surface.vertices_mm, &surface.triangles) {
        reporter.warn(
            "mesh",
            format_args!(
                "{}: the surface crosses itself: {pairs} pairs of faces, one at ({:.2}, {:.2}, {:.2}) mm; what it winds around is taken \
                 as one solid, repair it if that is not meant",
                path.display(),
                at.x,
                at.y,
                at.z
            ),
        );
    }
    Ok(surface)
}

/// The triangles of a closed surface, corners in mm, in the frame of its file: repaired, and doubted, as those of a scene are.
///
/// # Errors
/// When the file is damaged, or the surface has holes.
pub fn read_closed_triangles(path: &Path, reporter: &Reporter) -> Result<Vec<[DVec3; 3]>, SceneError> {
    let Surface { vertices_mm, triangles } = read_surface(path, reporter)?;
    Ok(triangles.iter().map(|corners| corners.map(|corner| vertices_mm[corner as usize])).collect())
}

/// What speaks against millimetres in a mesh whose longest side has this length; nothing of the body or of a tool is so small or so large.
#[must_use]
pub fn mesh_unit_doubt(longest_mm: f64) -> Option<String> {
    let (unit, factor) = match longest_mm {
        side if side < 1.0 => ("metres", "1000"),
        side if side > 5_000.0 => ("micrometres", "0.001"),
        _ => return None,
    };
    Some(format!(
        "its longest side is {longest_mm:.3e} mm, the coordinates look like {unit}; STL is read in mm: scale it by {factor} where it was \
         made, if that is so (lps_from_mesh only turns and shifts)"
    ))
}

/// Most that a header takes: 80 bytes of a binary STL, a line of a text.
const HEADER_BYTES: u64 = 256;

/// `lps_from_mesh` by the file's own word: 3D Slicer and others write `SPACE=RAS` or `SPACE=LPS` into the header. Without one, LPS.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn stated_frame(path: &Path, reporter: &Reporter) -> Result<Rigid, SceneError> {
    let mut head = Vec::new();
    let read = crate::regular::open(path).and_then(|file| file.take(HEADER_BYTES).read_to_end(&mut head));
    read.map_err(|source| SceneError::Io { path: path.to_owned(), source })?;
    let line = head.split(|byte| *byte == b'\n').next().unwrap_or_default();
    let is_ras = line.to_ascii_uppercase().windows(9).any(|word| word == b"SPACE=RAS");
    if !is_ras {
        return Ok(Rigid::IDENTITY);
    }
    let words = "its header says SPACE=RAS: x and y were negated to LPS; give lps_from_mesh where that is not meant";
    reporter.warn("mesh frame", format_args!("{}: {words}", path.display()));
    Ok(RAS_FROM_LPS)
}

/// Places a surface in the scene.
pub(super) fn placed(surface: Surface, lps_from_mesh: &Rigid, material: usize, density_g_per_cm3: f64) -> Mesh {
    Mesh {
        vertices_lps_mm: surface.vertices_mm.iter().map(|p| lps_from_mesh.transform_point(*p)).collect(),
        triangles: surface.triangles,
        material,
        density_g_per_cm3,
    }
}

fn weld(corners: &[[[f32; 3]; 3]]) -> (Surface, usize) {
    let mut vertices_mm = Vec::new();
    let mut known: HashMap<[u32; 3], u32> = HashMap::new();
    let mut triangles = Vec::with_capacity(corners.len());
    for triangle in corners {
        let indices = triangle.map(|position| {
            // Adding zero makes −0 and 0 the same vertex.
            *known.entry(position.map(|x| (x + 0.0).to_bits())).or_insert_with(|| {
                vertices_mm.push(DVec3::from_array(position.map(f64::from)));
                vertices_mm.len() as u32 - 1
            })
        });
        let [a, b, c] = indices;
        if a != b && b != c && c != a {
            triangles.push(indices);
        }
    }
    let dropped = corners.len() - triangles.len();
    (Surface { vertices_mm, triangles }, dropped)
}

/// Edges of each triangle in its own direction.
fn edges([a, b, c]: [u32; 3]) -> [(u32, u32); 3] {
    [(a, b), (b, c), (c, a)]
}

fn close(mut surface: Surface, path: &Path, reporter: &Reporter) -> Result<Surface, SceneError> {
    let wrong = |detail: String| SceneError::Mesh { path: path.to_owned(), detail };
    let mut users: HashMap<(u32, u32), Vec<u32>> = HashMap::new();
    for (index, triangle) in surface.triangles.iter().enumerate() {
        for (a, b) in edges(*triangle) {
            users.entry((a.min(b), a.max(b))).or_default().push(index as u32);
        }
    }
    let odd = users.iter().filter(|(_, users)| users.len() % 2 == 1).map(|(edge, _)| *edge);
    if let Some((a, b)) = odd.clone().min() {
        let middle = (surface.vertices_mm[a as usize] + surface.vertices_mm[b as usize]) * 0.5;
        let count = odd.count();
        return Err(wrong(format!(
            "the surface has holes: {count} open edges, one at ({:.2}, {:.2}, {:.2}) mm; close it and try again",
            middle.x, middle.y, middle.z
        )));
    }
    let turned = agree(&mut surface, &users).map_err(|count| {
        wrong(format!("{count} edges are shared by faces that cannot be turned to agree (one-sided or crossing); repair it"))
    })?;
    if turned > 0 {
        reporter
            .warn("mesh", format_args!("{}: {turned} inverted faces were turned to agree with their neighbours", path.display()));
    }
    let volume: f64 = surface
        .triangles
        .iter()
        .map(|triangle| {
            let [a, b, c] = triangle.map(|index| surface.vertices_mm[index as usize]);
            a.dot(b.cross(c)) / 6.0
        })
        .sum();
    if !(volume != 0.0) {
        return Err(wrong("the surface encloses no volume".to_owned()));
    }
    if volume < 0.0 {
        surface.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
        reporter.warn("mesh", format_args!("{}: all faces pointed inward and were turned", path.display()));
    }
    Ok(surface)
}

/// Whether each edge is walked as often in one direction as in the other.
fn unbalanced(surface: &Surface) -> usize {
    let mut balance: HashMap<(u32, u32), i32> = HashMap::new();
    for triangle in &surface.triangles {
        for (a, b) in edges(*triangle) {
            *balance.entry((a.min(b), a.max(b))).or_default() += if a < b { 1 } else { -1 };
        }
    }
    balance.values().filter(|sum| **sum != 0).count()
}

/// Turns faces, shell by shell, so that neighbours walk their common edge in opposite directions; the majority of a shell stays.
/// Returns how many were turned, or how many edges cannot be made to agree.
fn agree(surface: &mut Surface, users: &HashMap<(u32, u32), Vec<u32>>) -> Result<usize, usize> {
    if unbalanced(surface) == 0 {
        return Ok(0);
    }
    let count = surface.triangles.len();
    let mut seen = vec![false; count];
    let mut turn = vec![false; count];
    let mut turned = 0;
    for seed in 0..count {
        if seen[seed] {
            continue;
        }
        seen[seed] = true;
        let mut shell = vec![seed];
        let mut next = 0;
        while next < shell.len() {
            let face = shell[next];
            next += 1;
            for (a, b) in edges(surface.triangles[face]) {
                let Some([x, y]) = users.get(&(a.min(b), a.max(b))).map(Vec::as_slice) else { continue };
                let other = if *x as usize == face { *y } else { *x } as usize;
                if !seen[other] {
                    seen[other] = true;
                    let same_direction = edges(surface.triangles[other]).contains(&(a, b));
                    turn[other] = turn[face] ^ same_direction;
                    shell.push(other);
                }
            }
        }
        let to_turn = shell.iter().filter(|face| turn[**face]).count();
        let flip_majority = to_turn * 2 > shell.len();
        for face in shell {
            if turn[face] ^ flip_majority {
                surface.triangles[face].swap(1, 2);
                turned += 1;
            }
        }
    }
    match unbalanced(surface) {
        0 => Ok(turned),
        count => Err(count),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tetrahedron with edges of this length along the axes, as ASCII.
    fn tetrahedron(side: f64) -> String {
        let corners = [[0.0, 0.0, 0.0], [side, 0.0, 0.0], [0.0, side, 0.0], [0.0, 0.0, side]];
        let faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        let vertex = |at: usize| format!("vertex {:e} {:e} {:e}\n", corners[at][0], corners[at][1], corners[at][2]);
        let facet = |face: &[usize; 3]| {
            let corners: String = face.iter().map(|at| vertex(*at)).collect();
            format!("facet normal 0 0 0\nouter loop\n{corners}endloop\nendfacet\n")
        };
        format!("solid t\n{}endsolid t\n", faces.iter().map(facet).collect::<String>())
    }

    /// A femur in metres was half a millimetre long, and the image empty of it without a word.
    #[test]
    fn a_mesh_in_another_unit_is_told() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("femur.stl");
        let warned = |side: f64| {
            std::fs::write(&path, tetrahedron(side)).expect("writes");
            let reporter = Reporter::silent();
            read_surface(&path, &reporter).expect("closed");
            reporter.warnings().remove("mesh units").map(|counted| counted.latest)
        };
        for (side, words) in [(0.45, "look like metres"), (450_000.0, "look like micrometres")] {
            let said = warned(side).unwrap_or_default();
            assert!(said.contains(words) && said.contains("femur.stl") && said.contains("scale it by"), "{side}: {said}");
        }
        for side in [1.0, 450.0, 5_000.0] {
            assert_eq!(warned(side), None, "control: {side}");
        }
    }
}
