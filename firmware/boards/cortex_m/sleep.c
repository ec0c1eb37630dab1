#include "sleep.h"

void sleep_unless_busy(const struct rig_device *device) {
    /* Not by board_lock: one by BASEPRI keeps its interrupts from waking. */
    __asm__ volatile("cpsid i" : : : "memory");
    if (!rig_is_busy(device)) {
        __asm__ volatile("wfi" : : : "memory"); /* wakes though PRIMASK is set */
    }
    __asm__ volatile("cpsie i" : : : "memory");
}
