/* A board that is memory: its clock stands where a test puts it. */
#ifndef HOST_H
#define HOST_H

#include <stdbool.h>

#include "device.h"

#define HOST_CLOCK 1000000u /* Hz */

/* What stands at the inputs, and what was done to the outputs. Written and read by tests. */
struct host_board {
    uint64_t clock;
    struct rig_inputs inputs;
    int32_t increment; /* of the count, from latch to latch */
    int16_t outputs[RIG_OUTPUTS];
    uint32_t period; /* 0: the timer stands still */
    uint64_t due;    /* of the next tick */
    uint32_t fed;    /* times that the independent watchdog was */
    uint8_t phase;
    float turns;
};

extern struct host_board host_board;
extern const struct rig_identity host_identity;

/* All as after reset. */
void host_reset(struct rig_device *device);

/* Let time pass until `clock`: ticks, the watch of the host, the main loop, each at its time. After
 * a tick `ticked` is called, unless it is NULL. */
void host_run(struct rig_device *device, uint64_t clock, void (*ticked)(struct rig_device *));

/* Bytes from the line at the present time, and the main loop until it has looked at all. */
void host_feed(struct rig_device *device, const uint8_t *bytes, uint32_t n);

#endif
