/*
 * Packets of Sidecarm's wire, version 1 (mocks/PROTOCOL.md), for firmware and for programs beside it.
 *
 * C99, no allocation, no floating-point arithmetic, no state but what the caller keeps. Each function writes one whole frame, its
 * delimiter included, and returns how many bytes that are; 0 when they do not fit, and then nothing of it may be sent. Send a frame with
 * one call; when the transmitter is full drop it, never wait. One zero byte before the first frame puts the receiver in step.
 *
 * Licence: MIT or Apache-2.0, at your option.
 */
#ifndef SIDECARM_WIRE_H
#define SIDECARM_WIRE_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* CRC-32C of the schema text; seeds every checksum. */
#define SIDECARM_SCHEMA_HASH 0x9A57EB41u
/* Room for any frame with its delimiter. */
#define SIDECARM_FRAME_BYTES 513
/* Exposure counter of an arm that has none. */
#define SIDECARM_NO_COUNTER 0xFFFFFFFFu

/* Bits of a status. */
#define SIDECARM_FAULT 1u
#define SIDECARM_EMERGENCY_STOP 2u
#define SIDECARM_HOMING 4u /* robot only */

/* What the caller counts: one up for every packet of the device, whatever its message; microseconds of the device's clock at the moment of
 * measurement, from any epoch. */
typedef struct {
    uint32_t sequence;
    uint64_t device_us;
} sidecarm_stamp;

typedef struct {
    float position_mm;
    float velocity_mm_per_s;
    float tension_n;
    float current_a;
} sidecarm_tendon;

/* NaN is what was not measured. */
typedef struct {
    float commanded_deg[5];
    int has_sensed; /* else sensed_deg is not read */
    float sensed_deg[5];
    sidecarm_tendon tendons[2];
    int is_tracked; /* else the base is not read */
    double tracker_from_base_mm[3];
    double tracker_from_base_xyzw[4]; /* unit quaternion */
    float drill_rpm;
    uint32_t status;
} sidecarm_robot;

typedef struct {
    double lift_mm;
    double wig_wag_deg;
    double longitudinal_mm;
    double angulation_deg;
    double orbital_deg;
    double detector_rotation_deg;
    double source_to_detector_mm;
    float tube_kvp;
    float tube_ma;
    float pulse_width_ms;
    float filter_aluminium_mm;
    float filter_copper_mm;
    float field_mm[4]; /* left, top, right, bottom from the panel's middle, at the detector */
    int xray_on;
    uint32_t exposure_counter; /* one up when X-ray goes on */
    uint32_t status;
} sidecarm_carm;

/* Of whom metadata are. */
#define SIDECARM_KIND_ROBOT 1
#define SIDECARM_KIND_CARM 2

typedef struct {
    uint8_t kind;
    /* UTF-8, ended by a zero, at most 255 bytes each. */
    const char *serial_number;
    const char *firmware;
    const char *calibration_id;
    const char *units;
    /* Least and largest of the joints, in the order of the message. */
    uint8_t limit_count;
    const float (*limits)[2];
} sidecarm_metadata;

/* `out` has room for `capacity` bytes; SIDECARM_FRAME_BYTES are always enough. */
size_t sidecarm_write_robot(uint8_t *out, size_t capacity, sidecarm_stamp stamp, const sidecarm_robot *message);
size_t sidecarm_write_carm(uint8_t *out, size_t capacity, sidecarm_stamp stamp, const sidecarm_carm *message);
size_t sidecarm_write_metadata(uint8_t *out, size_t capacity, sidecarm_stamp stamp, const sidecarm_metadata *message);

#ifdef __cplusplus
}
#endif

#endif
