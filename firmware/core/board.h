/* What a board gives the core: everything that touches hardware. Outputs are zero from the first
 * instruction after reset on, before any of these is called. All take constant time, a few dozen
 * instructions, and wait for nothing, but board_latch and board_apply for their converters. */
#ifndef RIG_BOARD_H
#define RIG_BOARD_H

#include <stdint.h>

#include "guard.h"
#include "wire.h"

struct rig_channel {
    const char *name;
    const char *unit;
    double scale; /* units per code */
    double offset;
    double low;
    double high;
};

/* What WELCOME says. */
struct rig_identity {
    const char *device;
    const char *firmware;
    const char *serial;
    uint32_t clock;            /* Hz, a thousand or more */
    uint32_t shortest_period;  /* ticks of the clock from sample to sample */
    uint16_t watchdog_default; /* ms */
    uint16_t watchdog_longest; /* ms */
    int16_t lowest[RIG_OUTPUTS];  /* codes that the outputs ever give */
    int16_t highest[RIG_OUTPUTS];
    struct rig_channel channels[RIG_CHANNELS]; /* in the order of the protocol */
};

/* Ticks of the device's clock since power on; never goes back, never runs over. Any context;
 * constant time. */
uint64_t board_clock(void);

/* The inputs of this tick: latched by the timer's hardware or, where it cannot, first thing here.
 * Interrupt (tick); no longer than half of the shortest period. */
void board_latch(struct rig_inputs *inputs);

/* Put codes on the outputs, where they stay until told otherwise. applied: read back from the
 * converter, or the codes where it cannot be read. Interrupt (tick); as board_latch. */
void board_apply(const int16_t codes[RIG_OUTPUTS], int16_t applied[RIG_OUTPUTS]);

/* Both outputs to zero, by the shortest way. Any context, interrupts locked or not. */
void board_zero(void);

/* Call rig_on_tick now, and every `period` ticks of the clock from now; the instant of the first.
 * Main, interrupts locked: the first call comes once they are unlocked. */
uint64_t board_timer_start(uint32_t period);

/* No further rig_on_tick. Main, interrupts locked. */
void board_timer_stop(void);

/* Keep every interrupt off that calls the core; a token for board_unlock. May be nested. Main. */
uint32_t board_lock(void);

/* Undo one board_lock. Main. */
void board_unlock(uint32_t token);

/* There are bytes to be had from rig_byte_out. Main; must not wait. */
void board_transmit(void);

/* Feed the independent watchdog, which resets the board when this is not called for some tens of
 * milliseconds. Main. */
void board_feed(void);

/* A phase of a run begins (docs/serial-protocol.md, ANNOUNCE); may light a lamp. Main; must not
 * wait. */
void board_announce(uint8_t phase, float turns);

#endif
