"""Packets of Sidecarm's wire, version 1 (mocks/PROTOCOL.md): the standard library alone, Python 3.8 or later.

Each function returns one whole frame, its delimiter included, and raises ValueError for what the wire cannot hold. Send a frame with one call;
one zero byte (`START`) before the first puts the receiver in step. Over a serial port, or as datagrams to the `udp://` port of a session:

    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.sendto(robot(sequence, device_us, commanded_deg=[1, 2, 0.5, -1, 0]), ("127.0.0.1", 5005))

Licence: MIT or Apache-2.0, at your option.
"""

import struct

SCHEMA_HASH = 0x9A57EB41
"""CRC-32C of the schema text; seeds every checksum."""
START = b"\0"
NO_COUNTER = 0xFFFFFFFF
FAULT, EMERGENCY_STOP, HOMING = 1, 2, 4
KIND_ROBOT, KIND_CARM = 1, 2

_LONGEST = 512
_NAN = float("nan")


def _table():
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


_TABLE = _table()


def crc32c(data):
    """Castagnoli's sum of `data`: 0xE3069283 for b"123456789"."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = (crc >> 8) ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFFFFFF


def stuffed(packet):
    """COBS (Cheshire and Baker 1999), without a delimiter."""
    out, block = bytearray(), bytearray()
    for byte in packet:
        if byte:
            block.append(byte)
        if not byte or len(block) == 254:
            out.append(len(block) + 1)
            out += block
            block.clear()
    out.append(len(block) + 1)
    return bytes(out + block)


def _frame(message, flags, sequence, device_us, payload):
    packet = struct.pack("<BBHIQ", 1, message, flags, sequence & 0xFFFFFFFF, device_us) + payload
    packet += struct.pack("<I", crc32c(struct.pack("<I", SCHEMA_HASH) + packet))
    frame = stuffed(packet)
    if len(frame) > _LONGEST:
        raise ValueError(f"the frame has {len(frame)} bytes, the wire carries at most {_LONGEST}")
    return frame + b"\0"


def _floats(values, count, form="f"):
    values = list(values)
    if len(values) != count:
        raise ValueError(f"{len(values)} values, expected {count}")
    # Every NaN is sent as the same one.
    return struct.pack(f"<{count}{form}", *(_NAN if value != value else value for value in values))


def robot(sequence, device_us, commanded_deg, sensed_deg=None, tendons=None, base_mm=None, base_xyzw=None, drill_rpm=_NAN, status=0):
    """A robot's packet. Angles: five, degrees. `tendons`: two of (position mm, velocity mm/s, tension N, current A). `base_mm`, `base_xyzw`:
    translation and unit quaternion of tracker_from_base, where the tracker sees it. NaN is what was not measured."""
    if (base_mm is None) != (base_xyzw is None):
        raise ValueError("base_mm and base_xyzw belong together")
    first, second = tendons or [[_NAN] * 4] * 2
    payload = _floats(commanded_deg, 5) + _floats(sensed_deg or [_NAN] * 5, 5) + _floats(first, 4) + _floats(second, 4)
    payload += _floats(base_mm or [_NAN] * 3, 3, "d") + _floats(base_xyzw or [_NAN] * 4, 4, "d")
    payload += _floats([drill_rpm], 1) + struct.pack("<I", status)
    flags = (1 if sensed_deg else 0) | (2 if base_mm else 0)
    return _frame(1, flags, sequence, device_us, payload)


def carm(
    sequence,
    device_us,
    lift_mm=_NAN,
    wig_wag_deg=_NAN,
    longitudinal_mm=_NAN,
    angulation_deg=_NAN,
    orbital_deg=_NAN,
    detector_rotation_deg=_NAN,
    source_to_detector_mm=_NAN,
    tube_kvp=_NAN,
    tube_ma=_NAN,
    pulse_width_ms=_NAN,
    filter_aluminium_mm=_NAN,
    filter_copper_mm=_NAN,
    field_mm=(_NAN, _NAN, _NAN, _NAN),
    xray_on=False,
    exposure_counter=None,
    status=0,
):
    """A C-arm's packet. `field_mm`: left, top, right, bottom from the panel's middle. `exposure_counter` goes up by one when X-ray goes on.
    NaN is what was not measured."""
    joints = [lift_mm, wig_wag_deg, longitudinal_mm, angulation_deg, orbital_deg, detector_rotation_deg, source_to_detector_mm]
    beam = [tube_kvp, tube_ma, pulse_width_ms, filter_aluminium_mm, filter_copper_mm]
    payload = _floats(joints, 7, "d") + _floats(beam, 5) + _floats(field_mm, 4)
    payload += struct.pack("<II", NO_COUNTER if exposure_counter is None else exposure_counter, status)
    return _frame(2, 1 if xray_on else 0, sequence, device_us, payload)


def metadata(sequence, device_us, kind, serial_number="", firmware="", calibration_id="", units="", limits=()):
    """What a device says of itself, once a second. `limits`: (least, largest) of each joint, in the order of the message."""
    payload = struct.pack("<BBHI", kind, len(limits), 0, SCHEMA_HASH)
    for text in (serial_number, firmware, calibration_id, units):
        data = text.encode()
        if len(data) > 255:
            raise ValueError(f"a text has {len(data)} bytes, the wire carries at most 255")
        payload += bytes([len(data)]) + data
    for least, largest in limits:
        payload += _floats([least, largest], 2)
    return _frame(3, 0, sequence, device_us, payload)
