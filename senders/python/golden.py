"""Writes the frames of ../golden.txt; a sender that is right writes the same lines: `python3 golden.py | diff - ../golden.txt`."""

from sidecarm_wire import EMERGENCY_STOP, FAULT, HOMING, KIND_CARM, KIND_ROBOT, carm, crc32c, metadata, robot

LIMITS = [(0, 400), (-10, 10), (0, 200), (-190, 190), (-90, 90), (-180, 180), (900, 1200)]

FRAMES = {
    "robot": robot(
        1234,
        987654321,
        commanded_deg=[1, 2, 0.5, -1, 0],
        sensed_deg=[1.125, 2.25, 0.5, -1.25, 0.0625],
        tendons=[(3.5, -0.25, 12.5, 0.75), (-3.5, 0.25, 9.5, 0.5)],
        base_mm=[100.5, -20.25, 1500],
        base_xyzw=[0, 0, 0.6, 0.8],
        drill_rpm=8000,
    ),
    "carm": carm(
        77,
        123456789012,
        lift_mm=120.5,
        wig_wag_deg=-3.25,
        longitudinal_mm=40,
        angulation_deg=12.5,
        orbital_deg=-30.25,
        source_to_detector_mm=1020,
        tube_kvp=74,
        tube_ma=3.5,
        pulse_width_ms=8,
        filter_aluminium_mm=4.5,
        filter_copper_mm=0.25,
        field_mm=[-120, -93, 120, 93],
        xray_on=True,
        exposure_counter=17,
    ),
    "metadata": metadata(78, 123456800000, KIND_CARM, "CARM-0042", "1.4.2", "carm-nominal", "mm,deg,kV,mA,ms", LIMITS),
    "robot_unmeasured": robot(0, 0, commanded_deg=[0] * 5, status=FAULT | HOMING),
    "carm_dark": carm(4294967295, 18446744073709551615, *[0] * 12, status=FAULT | EMERGENCY_STOP),
    "metadata_long": metadata(7, 1, KIND_ROBOT, "S" * 100, "f" * 100, "c" * 60, "mm,deg"),
}

if __name__ == "__main__":
    assert crc32c(b"123456789") == 0xE3069283
    for name, frame in FRAMES.items():
        print(name, frame.hex())
    try:
        metadata(0, 0, KIND_ROBOT, "x" * 255, "x" * 255)
    except ValueError:
        pass
    else:
        raise SystemExit("a frame longer than the wire has was written")
