/* Silence of the host, in ticks of the device's clock. */
#ifndef RIG_WATCHDOG_H
#define RIG_WATCHDOG_H

#include <stdbool.h>
#include <stdint.h>

struct rig_watchdog {
    uint64_t heard; /* clock at the last valid frame of the session */
    uint64_t limit; /* ticks of silence that are allowed */
};

/* The silence that a run allows. Main, interrupts locked; constant time. */
static inline void rig_watchdog_set(struct rig_watchdog *watchdog, uint32_t milliseconds,
                                    uint32_t clock) {
    watchdog->limit = ((uint64_t)milliseconds * clock + 500u) / 1000u;
}

/* Note a frame. Main, interrupts locked; constant time. */
static inline void rig_watchdog_feed(struct rig_watchdog *watchdog, uint64_t now) {
    watchdog->heard = now;
}

/* Whether the host has been silent for longer than `limit` ticks. Any context, locked; constant
 * time. */
static inline bool rig_watchdog_silent(const struct rig_watchdog *watchdog, uint64_t now,
                                       uint64_t limit) {
    return now > watchdog->heard + limit;
}

#endif
