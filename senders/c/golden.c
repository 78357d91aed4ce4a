/*
 * Writes the frames of ../golden.txt; a sender that is right writes the same lines:
 *
 *     cc -std=c99 -Wall -Wextra -Werror -pedantic golden.c sidecarm_wire.c -o golden && ./golden | diff - ../golden.txt
 */

#include "sidecarm_wire.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

static void show(const char *name, const uint8_t *bytes, size_t count) {
    size_t at;
    printf("%s ", name);
    for (at = 0; at < count; at++) {
        printf("%02x", bytes[at]);
    }
    printf("\n");
}

static const float LIMITS[7][2] = {{0, 400}, {-10, 10}, {0, 200}, {-190, 190}, {-90, 90}, {-180, 180}, {900, 1200}};

int main(void) {
    uint8_t out[SIDECARM_FRAME_BYTES];
    char serial[101], firmware[101], calibration[61], longest[256];
    size_t count;
    sidecarm_stamp stamp;

    sidecarm_robot robot = {
        {1.0f, 2.0f, 0.5f, -1.0f, 0.0f}, 1, {1.125f, 2.25f, 0.5f, -1.25f, 0.0625f},
        {{3.5f, -0.25f, 12.5f, 0.75f}, {-3.5f, 0.25f, 9.5f, 0.5f}},
        1, {100.5, -20.25, 1500.0}, {0.0, 0.0, 0.6, 0.8}, 8000.0f, 0};
    sidecarm_carm carm = {120.5, -3.25, 40.0, 12.5, -30.25, NAN, 1020.0, 74.0f, 3.5f, 8.0f, 4.5f, 0.25f,
                          {-120.0f, -93.0f, 120.0f, 93.0f}, 1, 17, 0};
    sidecarm_metadata metadata = {SIDECARM_KIND_CARM, "CARM-0042", "1.4.2", "carm-nominal", "mm,deg,kV,mA,ms", 7, LIMITS};
    sidecarm_robot unmeasured = {
        {0, 0, 0, 0, 0}, 0, {0, 0, 0, 0, 0}, {{NAN, NAN, NAN, NAN}, {NAN, NAN, NAN, NAN}}, 0, {0, 0, 0}, {0, 0, 0, 0}, NAN,
        SIDECARM_FAULT | SIDECARM_HOMING};
    sidecarm_carm dark = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, {NAN, NAN, NAN, NAN}, 0, SIDECARM_NO_COUNTER,
                          SIDECARM_FAULT | SIDECARM_EMERGENCY_STOP};
    sidecarm_metadata wordy = {SIDECARM_KIND_ROBOT, serial, firmware, calibration, "mm,deg", 0, NULL};

    memset(serial, 'S', 100), serial[100] = 0;
    memset(firmware, 'f', 100), firmware[100] = 0;
    memset(calibration, 'c', 60), calibration[60] = 0;
    memset(longest, 'x', 255), longest[255] = 0;

    stamp.sequence = 1234, stamp.device_us = 987654321;
    show("robot", out, sidecarm_write_robot(out, sizeof out, stamp, &robot));
    stamp.sequence = 77, stamp.device_us = 123456789012;
    show("carm", out, sidecarm_write_carm(out, sizeof out, stamp, &carm));
    stamp.sequence = 78, stamp.device_us = 123456800000;
    show("metadata", out, sidecarm_write_metadata(out, sizeof out, stamp, &metadata));
    stamp.sequence = 0, stamp.device_us = 0;
    show("robot_unmeasured", out, sidecarm_write_robot(out, sizeof out, stamp, &unmeasured));
    stamp.sequence = 4294967295u, stamp.device_us = 18446744073709551615u;
    show("carm_dark", out, sidecarm_write_carm(out, sizeof out, stamp, &dark));
    stamp.sequence = 7, stamp.device_us = 1;
    show("metadata_long", out, sidecarm_write_metadata(out, sizeof out, stamp, &wordy));

    /* What does not fit is nothing: one byte too little, and a frame longer than the wire has. */
    count = sidecarm_write_robot(out, sizeof out, stamp, &robot);
    if (sidecarm_write_robot(out, count - 1, stamp, &robot) != 0 || sidecarm_write_robot(out, count, stamp, &robot) != count) {
        fprintf(stderr, "a frame that does not fit was written\n");
        return 1;
    }
    wordy.serial_number = wordy.firmware = longest;
    if (sidecarm_write_metadata(out, sizeof out, stamp, &wordy) != 0) {
        fprintf(stderr, "a frame longer than the wire has was written\n");
        return 1;
    }
    return 0;
}
