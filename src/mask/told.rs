//! Where a frame's header puts the edges of its open field: the collimator's, and those of what the console shows of the picture.

use glam::DVec2;

use super::shape::{Disc, FieldShape, HalfPlane};
use crate::acquire::{CollimatorShape, CollimatorTags, Frame};

/// An opening of the frame's header as it lies in the frame, however the console stored that; of a polygon that is not convex nothing is known.
#[must_use]
pub fn opening_in_frame(opening: &CollimatorTags, frame: &Frame) -> FieldShape {
    let frame_from_file = frame.frame_from_file();
    let is_named = |shape: CollimatorShape| opening.shapes.is_empty() || opening.shapes.contains(&shape);
    let mut shape = FieldShape::default();
    let mut add = |corners: Vec<DVec2>| {
        // The first column is 1 in the header.
        let in_frame: Vec<DVec2> =
            corners.into_iter().map(|corner| frame_from_file.transform_point2(corner - DVec2::ONE)).collect();
        shape.half_planes.extend(sides(&in_frame));
    };
    if let Some([left, top, right, bottom]) = opening.edges_px.filter(|_| is_named(CollimatorShape::Rectangular)) {
        // From the left side of the left column to the right side of the right one.
        let (low, high) = (DVec2::new(left - 0.5, top - 0.5), DVec2::new(right + 0.5, bottom + 0.5));
        add(vec![low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)]);
    }
    if is_named(CollimatorShape::Polygonal) {
        add(opening.corners_px.iter().map(|corner| DVec2::from_array(*corner)).collect());
    }
    let iris = opening.centre_px.zip(opening.radius_px).filter(|_| is_named(CollimatorShape::Circular));
    shape.disc = iris.map(|(centre, radius_px)| Disc {
        centre: frame_from_file.transform_point2(DVec2::from_array(centre) - DVec2::ONE),
        radius_px: radius_px * frame_from_file.matrix2.determinant().abs().sqrt(),
    });
    shape
}

/// All edges of the frame's header that cross the frame: to be looked at, and taken where the picture shows them.
pub(super) fn told_by_header(frame: &Frame) -> FieldShape {
    let [width, height] = frame.size_px.map(|side| side as f64 - 0.5);
    let corners = [[-0.5, -0.5], [width, -0.5], [-0.5, height], [width, height]].map(DVec2::from_array);
    // By more than half a pixel.
    let crosses = |depth_px: &dyn Fn(DVec2) -> f64| corners.iter().any(|corner| depth_px(*corner) < -0.5);
    let mut told = FieldShape::default();
    for opening in [&frame.tags.collimator, &frame.tags.display_shutter].into_iter().flatten() {
        let FieldShape { half_planes, disc, .. } = opening_in_frame(opening, frame);
        let within = |plane: &HalfPlane| {
            crosses(&|corner| plane.limit_px - plane.normal.dot(corner))
                && corners.iter().any(|corner| plane.limit_px > plane.normal.dot(*corner))
        };
        told.half_planes.extend(half_planes.into_iter().filter(within));
        let within = |disc: &Disc| crosses(&|corner| disc.radius_px - disc.centre.distance(corner));
        told.disc = told.disc.or(disc.filter(within));
    }
    told
}

/// The sides of a convex polygon, whose corners go round it in either sense.
fn sides(corners: &[DVec2]) -> Vec<HalfPlane> {
    let count = corners.len();
    let along = |n: usize| corners[(n + 1) % count] - corners[n % count];
    let turn = |n: usize| along(n).perp_dot(along(n + 1));
    let all: f64 = (0..count).map(turn).sum();
    if !(all.abs() > 0.0 && (0..count).all(|n| all.signum() * turn(n) >= 0.0)) {
        return Vec::new();
    }
    let side = |n: usize| {
        let along = along(n);
        let normal = (all.signum() * DVec2::new(along.y, -along.x)).try_normalize()?;
        Some(HalfPlane { normal, limit_px: normal.dot(corners[n]) })
    };
    (0..count).filter_map(side).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::geometry::ConsoleGeometry;
    use crate::image::Image;

    fn frame(columns: usize, rows: usize, collimator: CollimatorTags) -> Frame {
        let pixels = Image::filled(columns, rows, 1.0f32);
        let mut frame = Frame::from_pixels("f", pixels, Domain::Linear).expect("a frame");
        frame.tags.collimator = Some(collimator);
        frame
    }

    /// Whether a place in the frame is open.
    fn is_open(told: &FieldShape, u: f64, v: f64) -> bool {
        told.depth_px(DVec2::new(u, v)) > 0.0
    }

    /// Columns 11 to 60 and all rows: the left ten of the file's columns are shut.
    fn left_shut(columns: usize, rows: usize) -> CollimatorTags {
        let edges_px = Some([11.0, 1.0, columns as f64, rows as f64]);
        CollimatorTags { edges_px, ..CollimatorTags::default() }
    }

    #[test]
    fn edges_of_the_header_lie_where_the_file_s_columns_came_to() {
        let whole = told_by_header(&frame(60, 40, left_shut(60, 40)));
        assert_eq!(whole.half_planes.len(), 1, "those at the frame's sides shut nothing: {whole:?}");
        assert_eq!([is_open(&whole, 9.0, 20.0), is_open(&whole, 10.0, 20.0)], [false, true]);
        // Mirrored columns were put back in order.
        let unmirrored = told_by_header(&Frame { unmirrored: true, ..frame(60, 40, left_shut(60, 40)) });
        assert_eq!([is_open(&unmirrored, 50.0, 20.0), is_open(&unmirrored, 49.0, 20.0)], [false, true], "{unmirrored:?}");
        // Turned clockwise by a quarter as stored: what is left in the file is at the bottom of the panel's picture.
        let console = ConsoleGeometry { rotation_deg: 90.0, ..ConsoleGeometry::default() };
        let turned = frame(60, 40, left_shut(60, 40)).oriented(&console, None);
        assert_eq!(turned.size_px, [40, 60]);
        let turned = told_by_header(&turned);
        assert_eq!([is_open(&turned, 20.0, 50.0), is_open(&turned, 20.0, 49.0)], [false, true], "{turned:?}");
    }

    #[test]
    fn polygons_and_irises_are_told_and_what_cannot_be_one_is_not() {
        let corners_px = vec![[31.0, 1.0], [60.0, 21.0], [31.0, 40.0], [1.0, 21.0]];
        let polygon = |corners_px: Vec<[f64; 2]>| {
            told_by_header(&frame(60, 40, CollimatorTags { corners_px, ..CollimatorTags::default() }))
        };
        let other_way: Vec<[f64; 2]> = corners_px.iter().rev().copied().collect();
        for told in [polygon(corners_px.clone()), polygon(other_way)] {
            assert_eq!((told.half_planes.len(), is_open(&told, 30.0, 20.0), is_open(&told, 3.0, 3.0)), (4, true, false));
        }
        let crossed = vec![corners_px[0], corners_px[2], corners_px[1], corners_px[3]];
        assert!(polygon(crossed).half_planes.is_empty());
        let iris = |radius_px: f64| CollimatorTags {
            centre_px: Some([31.0, 21.0]),
            radius_px: Some(radius_px),
            ..CollimatorTags::default()
        };
        let told = told_by_header(&frame(60, 40, iris(15.0)));
        assert_eq!([is_open(&told, 30.0, 34.0), is_open(&told, 30.0, 36.0)], [true, false], "{told:?}");
        assert_eq!(told_by_header(&frame(60, 40, iris(60.0))).disc, None, "it leaves all of the frame open");
        // A shape that is named alone leaves the numbers of others aside.
        let shapes = vec![CollimatorShape::Rectangular];
        assert_eq!(told_by_header(&frame(60, 40, CollimatorTags { shapes, ..iris(15.0) })), FieldShape::default());
    }
}
