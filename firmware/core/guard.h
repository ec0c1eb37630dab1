/* The limits of START: clamps of the commands, and what no input may pass. */
#ifndef RIG_GUARD_H
#define RIG_GUARD_H

#include <stdbool.h>
#include <stdint.h>

#include "wire.h"

/* What a board latches at a tick. count: of 32 bits, modulo 2^32. at_end: whether an analog input
 * stands at the end of its converter. */
struct rig_inputs {
    int32_t analog[RIG_INPUTS];
    int32_t count;
    float rate; /* counts per second */
    bool at_end;
};

struct rig_guard {
    int16_t lowest[RIG_OUTPUTS];
    int16_t highest[RIG_OUTPUTS];
    int32_t analog_low[RIG_INPUTS];
    int32_t analog_high[RIG_INPUTS];
    int32_t count_low; /* less the count at tick 0 */
    int32_t count_high;
    float rate;    /* largest magnitude; infinity for none */
    uint32_t step; /* largest magnitude of the change from tick to tick */
    uint32_t first;
    uint32_t before;
    bool begun; /* whether tick 0 was */
};

/* The guard of START's payload, its clamps narrowed to the device's; false for values that no guard
 * has. Main; constant time. */
bool rig_guard_read(struct rig_guard *guard, const uint8_t *start,
                    const int16_t lowest[RIG_OUTPUTS], const int16_t highest[RIG_OUTPUTS]);

/* Clamp a command; whether it had to be. Interrupt; constant time. */
bool rig_guard_clamp(const struct rig_guard *guard, int16_t codes[RIG_OUTPUTS]);

/* Whether an input of this tick is beyond a limit; to be called at every tick, in order. A rate
 * that is no number is beyond every limit. Interrupt; constant time. */
bool rig_guard_beyond(struct rig_guard *guard, const struct rig_inputs *inputs);

#endif
