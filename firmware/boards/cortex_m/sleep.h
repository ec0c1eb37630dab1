/* The main loop's sleep. */
#ifndef CORTEX_M_SLEEP_H
#define CORTEX_M_SLEEP_H

#include "device.h"

/* Sleep until an interrupt comes, unless rig_poll has something to do at once. Main, nothing
 * locked. */
void sleep_unless_busy(const struct rig_device *device);

#endif
