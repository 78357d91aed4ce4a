/* See sidecarm_wire.h. A frame is stuffed and summed while it is written: there is no second buffer. */

#include "sidecarm_wire.h"

#include <string.h>

/* Reflected polynomial of CRC-32C. */
#define CASTAGNOLI 0x82F63B78u
/* Longest stuffed frame without its delimiter. */
#define LONGEST 512u
/* What stands for a value that was not measured. */
#define NAN_32 0x7FC00000u
#define NAN_64 0x7FF8000000000000u

typedef struct {
    uint8_t *out;
    size_t capacity;
    size_t at;
    /* Where the count of the running block goes, and the count. */
    size_t code_at;
    uint8_t code;
    uint32_t crc;
    int is_full;
} frame;

static uint32_t summed(uint32_t crc, uint8_t byte) {
    int bit;
    crc ^= byte;
    for (bit = 0; bit < 8; bit++) {
        crc = (crc >> 1) ^ (CASTAGNOLI & (0u - (crc & 1u)));
    }
    return crc;
}

static void put_raw(frame *f, uint8_t byte) {
    if (f->at >= f->capacity || f->at >= LONGEST) {
        f->is_full = 1;
        return;
    }
    f->out[f->at++] = byte;
}

static void end_block(frame *f) {
    if (!f->is_full) {
        f->out[f->code_at] = f->code;
    }
    f->code_at = f->at;
    f->code = 1;
}

/* COBS: zeros become the lengths of the blocks that they end. */
static void stuff(frame *f, uint8_t byte) {
    if (byte != 0) {
        put_raw(f, byte);
        f->code++;
    }
    if (byte == 0 || f->code == 0xFF) {
        end_block(f);
        put_raw(f, 0);
    }
}

static void put_8(frame *f, uint8_t value) {
    f->crc = summed(f->crc, value);
    stuff(f, value);
}

static void put_16(frame *f, uint16_t value) {
    put_8(f, (uint8_t)(value & 0xFF));
    put_8(f, (uint8_t)(value >> 8));
}

static void put_32(frame *f, uint32_t value) {
    put_16(f, (uint16_t)(value & 0xFFFF));
    put_16(f, (uint16_t)(value >> 16));
}

static void put_64(frame *f, uint64_t value) {
    put_32(f, (uint32_t)(value & 0xFFFFFFFFu));
    put_32(f, (uint32_t)(value >> 32));
}

/* Every NaN is sent as the same one. */
static void put_float(frame *f, float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    put_32(f, (bits & 0x7FFFFFFFu) > 0x7F800000u ? NAN_32 : bits);
}

static void put_double(frame *f, double value) {
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    put_64(f, (bits & 0x7FFFFFFFFFFFFFFFu) > 0x7FF0000000000000u ? NAN_64 : bits);
}

static void put_text(frame *f, const char *text) {
    size_t length = text == NULL ? 0 : strlen(text);
    size_t at;
    if (length > 255) {
        f->is_full = 1;
        return;
    }
    put_8(f, (uint8_t)length);
    for (at = 0; at < length; at++) {
        put_8(f, (uint8_t)text[at]);
    }
}

static void begin(frame *f, uint8_t *out, size_t capacity, uint8_t message, uint16_t flags, sidecarm_stamp stamp) {
    int shift;
    f->out = out;
    f->capacity = capacity;
    f->at = 0;
    f->code_at = 0;
    f->code = 1;
    f->crc = 0xFFFFFFFFu;
    f->is_full = 0;
    put_raw(f, 0);
    /* The schema is summed and not sent: a sender with another one fails every checksum. */
    for (shift = 0; shift < 32; shift += 8) {
        f->crc = summed(f->crc, (uint8_t)(SIDECARM_SCHEMA_HASH >> shift));
    }
    put_8(f, 1);
    put_8(f, message);
    put_16(f, flags);
    put_32(f, stamp.sequence);
    put_64(f, stamp.device_us);
}

static size_t end(frame *f) {
    put_32(f, f->crc ^ 0xFFFFFFFFu);
    end_block(f);
    if (f->is_full || f->at >= f->capacity) {
        return 0;
    }
    f->out[f->at++] = 0;
    return f->at;
}

size_t sidecarm_write_robot(uint8_t *out, size_t capacity, sidecarm_stamp stamp, const sidecarm_robot *message) {
    frame f;
    int at;
    uint16_t flags = (uint16_t)((message->has_sensed ? 1u : 0u) | (message->is_tracked ? 2u : 0u));
    begin(&f, out, capacity, 1, flags, stamp);
    for (at = 0; at < 5; at++) {
        put_float(&f, message->commanded_deg[at]);
    }
    for (at = 0; at < 5; at++) {
        if (message->has_sensed) {
            put_float(&f, message->sensed_deg[at]);
        } else {
            put_32(&f, NAN_32);
        }
    }
    for (at = 0; at < 2; at++) {
        put_float(&f, message->tendons[at].position_mm);
        put_float(&f, message->tendons[at].velocity_mm_per_s);
        put_float(&f, message->tendons[at].tension_n);
        put_float(&f, message->tendons[at].current_a);
    }
    for (at = 0; at < 7; at++) {
        if (message->is_tracked) {
            put_double(&f, at < 3 ? message->tracker_from_base_mm[at] : message->tracker_from_base_xyzw[at - 3]);
        } else {
            put_64(&f, NAN_64);
        }
    }
    put_float(&f, message->drill_rpm);
    put_32(&f, message->status);
    return end(&f);
}

size_t sidecarm_write_carm(uint8_t *out, size_t capacity, sidecarm_stamp stamp, const sidecarm_carm *message) {
    frame f;
    int at;
    begin(&f, out, capacity, 2, message->xray_on ? 1 : 0, stamp);
    put_double(&f, message->lift_mm);
    put_double(&f, message->wig_wag_deg);
    put_double(&f, message->longitudinal_mm);
    put_double(&f, message->angulation_deg);
    put_double(&f, message->orbital_deg);
    put_double(&f, message->detector_rotation_deg);
    put_double(&f, message->source_to_detector_mm);
    put_float(&f, message->tube_kvp);
    put_float(&f, message->tube_ma);
    put_float(&f, message->pulse_width_ms);
    put_float(&f, message->filter_aluminium_mm);
    put_float(&f, message->filter_copper_mm);
    for (at = 0; at < 4; at++) {
        put_float(&f, message->field_mm[at]);
    }
    put_32(&f, message->exposure_counter);
    put_32(&f, message->status);
    return end(&f);
}

size_t sidecarm_write_metadata(uint8_t *out, size_t capacity, sidecarm_stamp stamp, const sidecarm_metadata *message) {
    frame f;
    int at;
    begin(&f, out, capacity, 3, 0, stamp);
    put_8(&f, message->kind);
    put_8(&f, message->limit_count);
    put_16(&f, 0);
    put_32(&f, SIDECARM_SCHEMA_HASH);
    put_text(&f, message->serial_number);
    put_text(&f, message->firmware);
    put_text(&f, message->calibration_id);
    put_text(&f, message->units);
    for (at = 0; at < message->limit_count; at++) {
        put_float(&f, message->limits[at][0]);
        put_float(&f, message->limits[at][1]);
    }
    return end(&f);
}
