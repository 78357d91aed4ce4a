//! The decoder against the golden frames, damage and random bytes.

use proptest::prelude::*;
use sidecarm::telemetry::{
    DecodeFault, Decoder, DeviceKind, Event, FrameFault, MAX_ENCODED_BYTES, Metadata, SCHEMA_HASH, Sample, Sequenced, Telling,
    blanked,
};

use crate::telemetry_frames::{GOLDEN_CARM, GOLDEN_METADATA, GOLDEN_ROBOT, bytes, carm, decode, frame, frame_of_schema, plain};

fn golden() -> [(DeviceKind, Vec<u8>); 3] {
    [(DeviceKind::Robot, bytes(GOLDEN_ROBOT)), (DeviceKind::Carm, bytes(GOLDEN_CARM)), (DeviceKind::Carm, bytes(GOLDEN_METADATA))]
}

fn samples(events: &[Event]) -> Vec<Sample> {
    events.iter().filter_map(|event| if let Event::Sample(sample, _) = event { Some(sample.clone()) } else { None }).collect()
}

/// Samples as text: NaN is not equal to itself.
fn texts(events: &[Event]) -> Vec<String> {
    samples(events).iter().map(|sample| format!("{sample:?}")).collect()
}

fn only(device: DeviceKind, stream: &[u8]) -> Sample {
    let found = samples(&decode(device, stream, 7).0);
    assert_eq!(found.len(), 1);
    found[0].clone()
}

#[test]
fn the_golden_robot_frame_has_its_values() {
    let Sample::Robot(robot) = only(DeviceKind::Robot, &bytes(GOLDEN_ROBOT)) else { panic!("a robot sample") };
    assert_eq!((robot.sequence, robot.device_us, robot.status), (1234, 987_654_321, 0));
    assert_eq!(robot.commanded_deg, [1.0, 2.0, 0.5, -1.0, 0.0]);
    assert_eq!(robot.sensed_deg, Some([1.125, 2.25, 0.5, -1.25, 0.0625]));
    let [first, second] = robot.tendons;
    assert_eq!([first.position_mm, first.velocity_mm_per_s, first.tension_n, first.current_a], [3.5, -0.25, 12.5, 0.75]);
    assert_eq!([second.position_mm, second.velocity_mm_per_s, second.tension_n, second.current_a], [-3.5, 0.25, 9.5, 0.5]);
    let base = robot.tracker_from_base.unwrap();
    assert_eq!(base.translation_mm.to_array(), [100.5, -20.25, 1500.0]);
    assert!((base.rotation.to_array()[2] - 0.6).abs() < 1e-12 && (base.rotation.w - 0.8).abs() < 1e-12);
    assert_eq!(robot.drill_rpm, 8000.0);
}

#[test]
fn the_golden_carm_frame_has_its_values() {
    let Sample::Carm(carm) = only(DeviceKind::Carm, &bytes(GOLDEN_CARM)) else { panic!("a C-arm sample") };
    assert_eq!((carm.sequence, carm.device_us, carm.status), (77, 123_456_789_012, 0));
    let j = carm.joints;
    assert_eq!((j.lift_mm, j.longitudinal_mm, j.source_to_detector_mm), (120.5, 40.0, 1020.0));
    for (found_rad, expected_deg) in [(j.wig_wag_rad, -3.25f64), (j.angulation_rad, 12.5), (j.orbital_rad, -30.25)] {
        assert!((found_rad - expected_deg.to_radians()).abs() < 1e-15);
    }
    assert!(j.detector_rotation_rad.is_nan(), "not measured");
    assert_eq!([carm.tube_kvp, carm.tube_ma, carm.pulse_width_ms], [74.0, 3.5, 8.0]);
    assert_eq!([carm.filter_mm_al, carm.filter_mm_cu], [4.5, 0.25]);
    assert_eq!(carm.field_mm, [-120.0, -93.0, 120.0, 93.0]);
    assert!(carm.xray_on);
    assert_eq!(carm.exposure_counter, Some(17));
}

#[test]
fn the_golden_metadata_frame_has_its_values() {
    let Sample::Metadata(metadata) = only(DeviceKind::Carm, &bytes(GOLDEN_METADATA)) else { panic!("metadata") };
    assert_eq!((metadata.device, metadata.sequence, metadata.device_us), (DeviceKind::Carm, 78, 123_456_800_000));
    assert_eq!(metadata.serial_number, "CARM-0042");
    assert_eq!(metadata.firmware, "1.4.2");
    assert_eq!(metadata.calibration_id, "carm-nominal");
    assert_eq!(metadata.units, "mm,deg,kV,mA,ms");
    let limits: Vec<(f64, f64)> = metadata.limits.iter().map(|limit| (limit.min, limit.max)).collect();
    let expected = [(0.0, 400.0), (-10.0, 10.0), (0.0, 200.0), (-190.0, 190.0), (-90.0, 90.0), (-180.0, 180.0), (900.0, 1200.0)];
    assert_eq!(limits, expected);
}

#[test]
fn the_sender_of_these_tests_agrees_with_the_golden_frame() {
    let joints = [120.5, -3.25, 40.0, 12.5, -30.25, f64::NAN, 1020.0];
    assert_eq!(carm(77, 123_456_789_012, joints, true, Some(17)), bytes(GOLDEN_CARM));
}

#[test]
fn chunks_do_not_matter() {
    let stream: Vec<u8> = (0..20).flat_map(plain).collect();
    let whole = decode(DeviceKind::Carm, &stream, stream.len()).0;
    assert_eq!(samples(&whole).len(), 20);
    for chunk in [1, 2, 5, 64, 113] {
        assert_eq!(decode(DeviceKind::Carm, &stream, chunk).0, whole, "chunks of {chunk}");
    }
}

#[test]
fn no_truncation_is_delivered_and_the_next_frame_is() {
    let mut cases = 0;
    for (device, golden) in golden() {
        let whole = format!("{:?}", only(device, &golden));
        for cut in 1..golden.len() - 1 {
            // A lone delimiter first: the stream is in step. Then a torn frame, then the whole one.
            let stream = [&[0], &golden[..cut], &[0], &golden[..]].concat();
            let (events, decoder) = decode(device, &stream, 16);
            assert_eq!(texts(&events), std::slice::from_ref(&whole), "cut at {cut}");
            assert_eq!(decoder.health().corrupt, 1, "cut at {cut}");
            cases += 1;
        }
    }
    assert!(cases > 300);
}

#[test]
fn no_single_bit_flip_is_delivered_as_a_different_sample() {
    let mut cases = 0;
    for (device, golden) in golden() {
        let whole = format!("{:?}", only(device, &golden));
        let next = format!("{:?}", only(DeviceKind::Carm, &plain(5_000)));
        for bit in 0..golden.len() * 8 {
            let mut flipped = golden.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            let stream = [&[0], &flipped[..], &golden[..], &plain(5_000)[..]].concat();
            let (events, decoder) = decode(device, &stream, 31);
            for text in texts(&events) {
                assert!(text == whole || text == next, "bit {bit} changed the sample to {text}");
            }
            let health = decoder.health();
            assert!(health.corrupt >= 1, "bit {bit} passed unnoticed: {health:?}");
            // Damage costs at most the damaged frame and its neighbour.
            if bit / 8 < golden.len() - 1 {
                assert!(texts(&events).contains(&whole), "bit {bit}: the frame after the damaged one is lost");
            }
            cases += 1;
        }
    }
    assert!(cases > 2_000);
}

#[test]
fn the_negative_control_is_seen() {
    // If checksums were not looked at, this changed and re-stamped frame would pass for the original. It must differ.
    let other = carm(77, 123_456_789_012, [120.5, -3.25, 40.0, 12.5, -30.5, f64::NAN, 1020.0], true, Some(17));
    assert_ne!(format!("{:?}", only(DeviceKind::Carm, &other)), format!("{:?}", only(DeviceKind::Carm, &bytes(GOLDEN_CARM))));
}

#[test]
fn other_versions_messages_schemas_and_lengths_are_told_apart() {
    let payload = [0u8; 100];
    let metadata = {
        let mut payload = vec![2u8, 0, 0, 0];
        payload.extend(0xDEAD_BEEFu32.to_le_bytes());
        payload.extend([0, 0, 0, 0]);
        payload
    };
    let stream = [
        vec![0],
        frame(2, 2, 0, 1, 1, &payload),
        frame(1, 9, 0, 2, 2, &payload),
        frame(1, 2, 0, 3, 3, &payload[..99]),
        frame(1, 2, 0, 4, 4, &[0; 101]),
        frame(1, 2, 0, 4, 4, &[0; 101]),
        frame_of_schema(0xDEAD_BEEF, 1, 3, 0, 4, 4, &metadata),
        frame_of_schema(0xDEAD_BEEF, 1, 2, 0, 5, 5, &payload),
        frame_of_schema(0x1234_5678, 1, 2, 0, 5, 5, &payload),
        bytes(GOLDEN_ROBOT),
        plain(9),
    ]
    .concat();
    let (events, decoder) = decode(DeviceKind::Carm, &stream, 50);
    let health = decoder.health();
    assert_eq!(health.version_mismatch, 1);
    assert_eq!((health.malformed, health.duplicate), (2, 1), "what makes no sense twice is a copy");
    assert_eq!(health.lost, 4, "from 4 to 9: packets that make no sense came all the same");
    assert_eq!(health.schema_mismatch, 2, "announced by metadata, then recognised");
    assert_eq!(health.corrupt, 1, "an unknown schema is indistinguishable from damage");
    assert_eq!(health.unknown_message, 1, "message 9");
    assert_eq!(health.wrong_device, 1, "a robot message on the C-arm's port");
    assert_eq!(samples(&events).len(), 1);
    assert!(events.contains(&Event::Fault(DecodeFault::Frame(FrameFault::VersionMismatch { expected: 1, found: 2 }))));
    let swapped = DecodeFault::WrongDevice { expected: DeviceKind::Carm, found: DeviceKind::Robot };
    assert!(events.contains(&Event::Fault(swapped)));
}

#[test]
fn a_line_without_delimiters_costs_bounded_memory_and_one_count() {
    let noise = vec![0x55u8; 100 * MAX_ENCODED_BYTES];
    let stream = [&[0], &noise[..], &[0], &plain(1)[..]].concat();
    let (events, decoder) = decode(DeviceKind::Carm, &stream, 4096);
    assert_eq!(decoder.health().overlong, 1);
    assert_eq!(decoder.health().corrupt, 0);
    assert_eq!(samples(&events).len(), 1);
}

#[test]
fn lost_duplicate_reordered_and_reset_are_counted() {
    let mut stream = Vec::new();
    for sequence in [u32::MAX - 1, u32::MAX, 0, 1, 1, 5, 3, 6] {
        // Device time goes on over the wrap.
        let step = sequence.wrapping_sub(u32::MAX - 1);
        stream.extend(carm(sequence, 1_000_000 + u64::from(step) * 33_333, [0.0; 7], false, None));
    }
    stream.extend(plain(0));
    stream.extend(plain(1));
    let (events, decoder) = decode(DeviceKind::Carm, &stream, 200);
    let health = decoder.health();
    assert_eq!((health.lost, health.duplicate, health.reordered, health.resets), (2, 1, 1, 1));
    assert_eq!(samples(&events).len(), 9);
    assert!(events.contains(&Event::Fault(DecodeFault::Lost { count: 3, while_closed: false })));
    assert!(events.contains(&Event::Fault(DecodeFault::Reset { sequence: 0 })));
}

/// The first packet of a device that began anew has an unknown message: that it began anew is said all the same.
#[test]
fn a_restart_that_begins_with_what_cannot_be_read_is_one() {
    let begun: Vec<u8> = (500..520).flat_map(|n| carm(n, 1_000_000 + u64::from(n) * 33_333, [0.0; 7], false, None)).collect();
    let stream = [begun, frame(1, 9, 0, 0, 1_000, &[0; 100]), carm(1, 34_333, [0.0; 7], false, None)].concat();
    let (events, decoder) = decode(DeviceKind::Carm, &stream, 200);
    assert_eq!((decoder.health().resets, decoder.health().lost), (1, 0));
    let last = events.iter().rev().find_map(|event| match event {
        Event::Sample(_, sequenced) => Some(*sequenced),
        Event::Fault(_) => None,
    });
    assert_eq!(last, Some(Sequenced::Reset));
}

#[test]
fn a_frame_cut_by_opening_the_port_is_no_fault() {
    let mut decoder = Decoder::new(DeviceKind::Carm);
    decoder.begin_epoch();
    let stream = [&plain(3)[40..], &plain(4)[..]].concat();
    let mut found = 0;
    decoder.push(&stream, &mut |event| found += usize::from(matches!(event, Event::Sample(..))));
    assert_eq!((found, decoder.health().corrupt, decoder.health().partial_at_open), (1, 0, 1));
    // A torn frame later on is one.
    decoder.push(&[&plain(5)[40..], &plain(6)[..]].concat(), &mut |_| {});
    assert_eq!(decoder.health().corrupt, 1);
    // What was begun before the port closed is not joined with what comes after.
    decoder.push(&plain(7)[..30], &mut |_| {});
    decoder.begin_epoch();
    decoder.push(&plain(20), &mut |_| {});
    assert_eq!((decoder.health().corrupt, decoder.health().missed_unplugged), (1, 13));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn random_bytes_never_panic_and_never_become_samples(noise in proptest::collection::vec(any::<u8>(), 0..4096), chunk in 1usize..600) {
        let (events, decoder) = decode(DeviceKind::Robot, &noise, chunk);
        prop_assert!(samples(&events).is_empty());
        prop_assert_eq!(decoder.health().bytes, noise.len() as u64);
    }

    #[test]
    fn random_payloads_with_right_checksums_never_panic(
        message in 0u8..5, flags in any::<u16>(), sequence in any::<u32>(), device_us in any::<u64>(),
        payload in proptest::collection::vec(any::<u8>(), 0..300),
    ) {
        let stream = [&[0], &frame(1, message, flags, sequence, device_us, &payload)[..], &plain(sequence.wrapping_add(1))[..]].concat();
        let (events, _) = decode(DeviceKind::Carm, &stream, 512);
        prop_assert!(samples(&events).iter().any(|sample| sample.sequence() == sequence.wrapping_add(1)));
    }

    #[test]
    fn after_any_damage_the_decoder_is_in_step_within_one_frame(
        noise in proptest::collection::vec(any::<u8>(), 0..700), at in 0usize..113, cut in 0usize..113,
    ) {
        let torn = &plain(1)[at.min(plain(1).len())..];
        let stream = [&[0], &torn[..cut.min(torn.len())], &noise[..], &plain(2)[..], &plain(3)[..]].concat();
        let (events, _) = decode(DeviceKind::Carm, &stream, 97);
        prop_assert!(samples(&events).iter().any(|sample| sample.sequence() == 3));
    }
}

/// Whoever wrote something else where a device states its units would find it in a log that was given away.
#[test]
fn of_the_units_of_a_blanked_packet_only_units_are_left() {
    let with_units = |units: &str| {
        let mut payload = vec![2, 0, 0, 0];
        payload.extend(SCHEMA_HASH.to_le_bytes());
        for text in ["SN-1", "1.0", "c", units] {
            payload.push(text.len() as u8);
            payload.extend(text.as_bytes());
        }
        frame(1, 3, 0, 7, 1_000_000, &payload)
    };
    for (units, kept) in [
        ("mm,deg,kV,mA,ms", "mm,deg,kV,mA,ms"),
        ("mm, deg; N", "mm, deg; N"),
        ("mm,deg Quaxwelk,Trullgasse 4", "mm,deg ????????,?????????? ?"),
        ("MM,rad/s,", "??,rad/s,"),
        ("", ""),
    ] {
        let packet = with_units(units);
        let Telling::Blanked(mut now) = blanked(packet.strip_suffix(&[0]).expect("a delimiter")) else { panic!("{units}") };
        assert_eq!(now.len() + 1, packet.len());
        now.push(0);
        let Sample::Metadata(told) = only(DeviceKind::Carm, &now) else { panic!("{units}") };
        let letter = told.serial_number.chars().next().expect("as long as before");
        assert_eq!(told.units, kept.replace('?', &letter.to_string()), "{units}");
    }
}

/// What is given away keeps its length, its checksum and all else that it says.
#[test]
fn a_blanked_packet_tells_the_same_but_no_serial_number() {
    let stuffed = |hex: &str| bytes(hex).strip_suffix(&[0]).expect("a delimiter").to_vec();
    let packet = stuffed(GOLDEN_METADATA);
    let Telling::Blanked(mut now) = blanked(&packet) else { panic!("a metadata packet") };
    assert_eq!(now.len(), packet.len());
    now.push(0);
    let (Sample::Metadata(before), Sample::Metadata(after)) =
        (only(DeviceKind::Carm, &bytes(GOLDEN_METADATA)), only(DeviceKind::Carm, &now))
    else {
        panic!("metadata")
    };
    let texts = |metadata: &Metadata| [&metadata.serial_number, &metadata.firmware, &metadata.calibration_id].map(String::clone);
    assert_eq!(texts(&after).map(|text| text.len()), texts(&before).map(|text| text.len()));
    let letter = after.serial_number.chars().next().expect("as long as before");
    assert!(texts(&after).iter().all(|text| !text.is_empty() && text.chars().all(|other| other == letter)), "{after:?}");
    let blank = |metadata: &Metadata| Metadata {
        serial_number: String::new(),
        firmware: String::new(),
        calibration_id: String::new(),
        ..metadata.clone()
    };
    assert_eq!(blank(&before), blank(&after));
    // Packets that tell none stay as they are, and nothing is known of what is not intact.
    assert_eq!([GOLDEN_ROBOT, GOLDEN_CARM].map(|hex| blanked(&stuffed(hex))), [Telling::Nothing, Telling::Nothing]);
    let mut corrupt = packet.clone();
    corrupt[30] ^= 1;
    assert_eq!([blanked(&corrupt), blanked(&packet[..40]), blanked(&[])], [Telling::Unknown, Telling::Unknown, Telling::Unknown]);
}
