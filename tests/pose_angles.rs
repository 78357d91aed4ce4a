//! C-arm angles in four conventions: an asymmetric phantom in all eight octants and four patient positions.

use glam::{DMat3, DQuat, DVec2, DVec3};
use sidecarm::geometry::{
    AngleConvention, CarmAngles, CarmCalibration, CarmJoints, Intrinsics, PatientPosition, Projection, Rigid, dicom_angles_deg,
};

use crate::pose_convert::{data, get, phantom};

/// The camera of angles: the isocentre is the origin of `lps`.
fn projection(
    convention: AngleConvention,
    degrees: [f64; 3],
    position: PatientPosition,
    k: &Intrinsics,
    isocentre_mm: f64,
) -> Projection {
    let lps_from_camera = convention.lps_from_camera(CarmAngles::from_degrees(degrees), position);
    let camera_from_lps = Rigid { rotation: lps_from_camera.conjugate(), translation_mm: DVec3::new(0.0, 0.0, isocentre_mm) };
    Projection::compose(k, &camera_from_lps)
}

const K: Intrinsics = Intrinsics { fx: 2040.0, fy: 2040.0, skew: 0.0, cx: 309.5, cy: 239.5 };

/// Signs of (first, second, third), all eight.
fn octants() -> impl Iterator<Item = [f64; 3]> {
    (0..8).map(|n| {
        let sign = |bit: i32| if n & bit == 0 { 1.0 } else { -1.0 };
        [25.0 * sign(1), 40.0 * sign(2), 15.0 * sign(4)]
    })
}

#[test]
fn deepdrr_angles_put_the_phantom_where_its_mobile_c_arm_does() {
    let file = data("deepdrr.json");
    let phantom = phantom(&file);
    let angles = file["angles"].as_array().expect("cases");
    assert_eq!(angles.len(), 32);
    let mut worst = 0.0f64;
    for case in angles {
        let position: PatientPosition = get(case, "position");
        let focal: f64 = get(case, "focal_px");
        let [cx, cy] = get(case, "principal_point_px");
        let k = Intrinsics { fx: focal, fy: focal, skew: 0.0, cx, cy };
        let degrees = [get(case, "alpha_deg"), get(case, "beta_deg"), get(case, "gamma_deg")];
        let p = projection(AngleConvention::DeepDrr, degrees, position, &k, get(case, "source_to_isocentre_mm"));
        for (point, pixel) in phantom.iter().zip(get::<Vec<[f64; 2]>>(case, "image_px")) {
            worst = worst.max(p.project(*point).0.distance(DVec2::from_array(pixel)));
        }
        // Its documentation: alpha + is RAO, beta + is caudal.
        let (_, camera_from_lps) = p.decompose().expect("a camera");
        let (primary, secondary) = dicom_angles_deg(camera_from_lps.rotation.conjugate() * DVec3::Z);
        if position == PatientPosition::HeadFirstSupine {
            assert!(primary * degrees[0] < 0.0 && secondary * degrees[1] < 0.0, "{degrees:?}: {primary} {secondary}");
        }
        let source = camera_from_lps.inverse().translation_mm;
        assert!(source.distance(DVec3::from_array(get(case, "source_in_lps_mm"))) < 1e-3);
    }
    // DeepDRR computes in single precision.
    assert!(worst < 5e-3, "{worst} px");
}

#[test]
fn device_angles_are_the_joints_of_our_chain() {
    let calibration: CarmCalibration = serde_json::from_value(serde_json::json!({
        "origin": "test", "columns_px": 620, "rows_px": 480, "pitch_mm": 0.5, "source_to_isocentre_mm": 600.0,
        "source_to_detector_mm": 1020.0, "column_to_isocentre_mm": [0.0, 0.0, 0.0]
    }))
    .expect("valid");
    let phantom = phantom(&data("deepdrr.json"));
    // Left, posterior and superior of each position in the room: head first points to +y, an upright face to +z.
    let rooms = [
        (PatientPosition::HeadFirstSupine, [DVec3::X, -DVec3::Z, DVec3::Y]),
        (PatientPosition::HeadFirstProne, [-DVec3::X, DVec3::Z, DVec3::Y]),
        (PatientPosition::FeetFirstSupine, [-DVec3::X, -DVec3::Z, -DVec3::Y]),
        (PatientPosition::FeetFirstProne, [DVec3::X, DVec3::Z, -DVec3::Y]),
    ];
    let mut cases = 0;
    for (position, [left, posterior, superior]) in rooms {
        let world_from_lps = Rigid::rotation(DQuat::from_mat3(&DMat3::from_cols(left, posterior, superior)));
        for degrees in octants() {
            let joints = CarmJoints {
                angulation_rad: degrees[0].to_radians(),
                orbital_rad: degrees[1].to_radians(),
                detector_rotation_rad: degrees[2].to_radians(),
                ..CarmJoints::ZERO
            };
            let camera_from_lps = calibration.world_from_camera(&joints).expect("measured").inverse() * world_from_lps;
            let chain = Projection::compose(&calibration.intrinsics(&joints).expect("K"), &camera_from_lps);
            let angles = projection(AngleConvention::Device, degrees, position, &K, 600.0);
            for point in &phantom {
                assert!(chain.project(*point).0.distance(angles.project(*point).0) < 1e-8, "{position:?} {degrees:?}");
            }
            cases += 1;
        }
    }
    assert_eq!(cases, 32);
}

#[test]
fn dicom_angles_move_the_detector_to_the_side_they_name() {
    for position in PatientPosition::ALL {
        for degrees in octants() {
            let p = projection(AngleConvention::Dicom, degrees, position, &K, 600.0);
            let (_, camera_from_lps) = p.decompose().expect("a camera");
            let beam = camera_from_lps.rotation.conjugate() * DVec3::Z;
            assert_eq!(beam.x > 0.0, degrees[0] > 0.0, "LAO: the detector on the left, {degrees:?}");
            assert_eq!(beam.z > 0.0, degrees[1] > 0.0, "CRA: the detector towards the head, {degrees:?}");
            assert!(beam.y < 0.0, "the detector is anterior");
            let found = dicom_angles_deg(beam);
            assert!((found.0 - degrees[0]).abs() < 1e-9 && (found.1 - degrees[1]).abs() < 1e-9);
        }
        // Straight from the front: the head is up and the patient's right on the right, as the source sees it from behind.
        let p = projection(AngleConvention::Dicom, [0.0; 3], position, &K, 600.0);
        let (centre, _) = p.project(DVec3::ZERO);
        let (left, _) = p.project(DVec3::new(40.0, 0.0, 0.0));
        let (head, _) = p.project(DVec3::new(0.0, 0.0, 55.0));
        assert!(left.x < centre.x - 100.0 && (left.y - centre.y).abs() < 1e-9);
        assert!(head.y < centre.y - 100.0 && (head.x - centre.x).abs() < 1e-9);
    }
}

/// What is documented of xReg: the nominal extrinsic, and that orbiting is a turn about its x.
#[test]
fn xreg_orbits_about_the_x_of_its_frame() {
    // Columns run along −z of the frame here, as ours are not mirrored; rows along −x; the detector at +y.
    let at_zero = AngleConvention::Xreg.lps_from_camera(CarmAngles::from_degrees([0.0; 3]), PatientPosition::HeadFirstSupine);
    // The head at +x of the frame and the face at +y: left is +z.
    let frame_from_lps = DQuat::from_mat3(&DMat3::from_cols(DVec3::Z, -DVec3::Y, DVec3::X));
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| frame_from_lps * (at_zero * axis));
    for (found, expected) in axes.into_iter().zip([-DVec3::Z, -DVec3::X, DVec3::Y]) {
        assert!(found.distance(expected) < 1e-12, "{found} {expected}");
    }
    let orbit =
        AngleConvention::Xreg.lps_from_camera(CarmAngles::from_degrees([0.0, 30.0, 0.0]), PatientPosition::HeadFirstSupine);
    let turned = frame_from_lps * (orbit * at_zero.conjugate()) * frame_from_lps.conjugate();
    assert!(turned.to_scaled_axis().distance(DVec3::X * 30f64.to_radians()) < 1e-12);
}

#[test]
fn every_convention_says_the_same_of_every_beam() {
    let phantom = phantom(&data("deepdrr.json"));
    let mut cases = 0;
    for position in PatientPosition::ALL {
        for from in AngleConvention::ALL {
            // Beams into all eight octants of the patient, the detector's turn with both signs.
            for (n, degrees) in octants().flat_map(|o| [o, [180.0 - o[0], o[1], o[2]], [o[0], o[1] * 3.5, -o[2]]]).enumerate() {
                let seen = projection(from, degrees, position, &K, 600.0);
                for to in AngleConvention::ALL {
                    let angles = from.convert(CarmAngles::from_degrees(degrees), to, position);
                    let again = projection(to, angles.to_degrees(), position, &K, 600.0);
                    for point in &phantom {
                        let off = seen.project(*point).0.distance(again.project(*point).0);
                        assert!(off < 1e-8, "{n}: {from:?} {degrees:?} is {to:?} {:?}: {off} px", angles.to_degrees());
                    }
                    let back = to.convert(angles, from, position);
                    let same = projection(from, back.to_degrees(), position, &K, 600.0).project(phantom[4]).0;
                    assert!(same.distance(seen.project(phantom[4]).0) < 1e-8);
                    cases += 1;
                }
            }
        }
    }
    assert_eq!(cases, 4 * 4 * 24 * 4);
}

/// Angles in their usual range come back as the same numbers, not only as the same picture.
#[test]
fn usual_angles_come_back_as_numbers() {
    for position in PatientPosition::ALL {
        for convention in AngleConvention::ALL {
            for degrees in octants().chain([[0.0; 3], [10.0, 0.0, 0.0], [0.0, -20.0, 170.0]]) {
                let rotation = convention.lps_from_camera(CarmAngles::from_degrees(degrees), position);
                let back = convention.angles(rotation, position).to_degrees();
                let off = back.iter().zip(degrees).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(off < 1e-9, "{convention:?} {position:?}: {degrees:?} came back as {back:?}");
            }
        }
    }
    // An orbit beyond 90° stays an orbit: the C passes overhead and does not tip over.
    let joints = CarmAngles::from_degrees([5.0, 150.0, 10.0]);
    let position = PatientPosition::HeadFirstSupine;
    let back = AngleConvention::Device.angles(AngleConvention::Device.lps_from_camera(joints, position), position).to_degrees();
    assert!((back[0] - 5.0).abs() < 1e-9 && (back[1] - 150.0).abs() < 1e-9, "{back:?}");
}

/// Where a beam runs along the axis of the outer turn that turn is free; the picture must still be the same.
#[test]
fn beams_along_an_axis_keep_their_picture() {
    let poles =
        [[0.0, 90.0, 30.0], [0.0, -90.0, 30.0], [90.0, 0.0, 30.0], [-90.0, 0.0, 30.0], [0.0, 180.0, 30.0], [30.0, 90.0, 10.0]];
    for position in PatientPosition::ALL {
        for convention in AngleConvention::ALL {
            for degrees in poles {
                let rotation = convention.lps_from_camera(CarmAngles::from_degrees(degrees), position);
                for to in AngleConvention::ALL {
                    let again = to.lps_from_camera(to.angles(rotation, position), position);
                    assert!(rotation.dot(again).abs() > 1.0 - 1e-12, "{convention:?} {degrees:?} in {to:?}");
                }
            }
        }
    }
}

/// The control: a patient who lies otherwise, or another convention, is another picture.
#[test]
fn positions_and_conventions_are_not_interchangeable() {
    let phantom = phantom(&data("deepdrr.json"));
    let picture = |convention, position| {
        let p = projection(convention, [25.0, 40.0, 15.0], position, &K, 600.0);
        phantom.iter().map(|point| p.project(*point).0).collect::<Vec<_>>()
    };
    let differ = |a: &[DVec2], b: &[DVec2]| a.iter().zip(b).any(|(a, b)| a.distance(*b) > 5.0);
    for convention in AngleConvention::ALL {
        for (n, a) in PatientPosition::ALL.into_iter().enumerate() {
            for b in PatientPosition::ALL.into_iter().skip(n + 1) {
                let same = !differ(&picture(convention, a), &picture(convention, b));
                assert_eq!(same, convention == AngleConvention::Dicom, "{convention:?} {a:?} {b:?}");
            }
        }
    }
    let supine = PatientPosition::HeadFirstSupine;
    for (n, a) in AngleConvention::ALL.into_iter().enumerate() {
        for b in AngleConvention::ALL.into_iter().skip(n + 1) {
            assert!(differ(&picture(a, supine), &picture(b, supine)), "{a:?} {b:?}");
        }
    }
}
