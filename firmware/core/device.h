/* A device of the serial protocol (docs/serial-protocol.md): what a board calls.
 *
 * Three contexts: the interrupts of the timer (rig_on_tick, rig_on_watch: one priority, neither
 * interrupts the other), the interrupt of the line (rig_byte_in, rig_byte_out), and the main loop
 * (everything else). The rings pass bytes, commands and samples between them without locks; what
 * else they share is struct rig_run, which the main loop touches with interrupts locked only. */
#ifndef RIG_DEVICE_H
#define RIG_DEVICE_H

#include <stdbool.h>
#include <stdint.h>

#include "board.h"
#include "bytes.h"
#include "commands.h"
#include "config.h"
#include "frame.h"
#include "guard.h"
#include "law.h"
#include "samples.h"
#include "watchdog.h"
#include "wire.h"

#define RIG_SAMPLES_PAYLOAD (RIG_SAMPLES_HEAD + RIG_BLOCK * RIG_SAMPLE_SIZE)
#define RIG_LONGEST_OUT \
    ((RIG_SAMPLES_PAYLOAD > RIG_WELCOME_SIZE) ? RIG_SAMPLES_PAYLOAD : RIG_WELCOME_SIZE)

/* The run, shared by interrupts and main loop. */
struct rig_run {
    enum rig_state state; /* written by the main loop */
    enum rig_latch latch;
    bool urgent; /* a latch has closed: what waits for the line goes out at once */
    uint32_t tick; /* the next to be latched */
    uint32_t period;
    uint32_t overflow;
    uint64_t origin; /* clock at tick 0 */
    int16_t last[RIG_OUTPUTS]; /* what closed loop holds */
    struct rig_guard guard;
    struct rig_watchdog watchdog;
#if RIG_HAS_LAW
    struct rig_law law;
#endif
};

/* A device; one that is all zeros has not been initialised. */
struct rig_device {
    const struct rig_identity *identity;
    struct rig_run run;
    struct rig_commands commands;
    struct rig_samples samples;
    struct rig_bytes received;
    struct rig_bytes waiting; /* to be transmitted */
    /* The main loop's own from here on. */
    struct rig_decoder decoder;
    uint16_t session; /* 0: none yet */
    uint16_t number; /* of the run */
    uint16_t sequence; /* of SAMPLES and STATUS */
    uint16_t answered; /* number of the last request */
    bool has_answered;
    bool flushing;
    uint32_t seen; /* samples taken when rig_poll last looked */
    uint32_t block; /* ticks of a block that nobody waits for */
    uint8_t answer[RIG_REPLY_SIZE]; /* to the last request */
    uint8_t body[RIG_FRAME_OVERHEAD + RIG_LONGEST_OUT];
    uint8_t received_bytes[RIG_RECEIVE];
    uint8_t waiting_bytes[RIG_TRANSMIT];
};

/* IDLE, outputs zero, no session. Main, before any interrupt is on; a step for every byte of it. */
void rig_init(struct rig_device *device, const struct rig_identity *identity);

/* What there is to do now: up to 256 bytes received, samples to be sent, the independent watchdog.
 * Main, again and again. At most 4 frames of RIG_BLOCK samples, three steps a byte, and RIG_QUEUE
 * steps for each session and each run that these bytes begin, of which there is room for 13. */
void rig_poll(struct rig_device *device);

/* Whether rig_poll has something to do at once; where not, the main loop may sleep until the next
 * interrupt. Main, interrupts locked; constant time. */
bool rig_is_busy(const struct rig_device *device);

/* One tick: latch, then apply. Interrupt of the timer, highest priority; constant time beside
 * board_latch and board_apply. */
void rig_on_tick(struct rig_device *device);

/* Look whether the host is silent. Interrupt at the priority of the tick's, every millisecond;
 * constant time. */
void rig_on_watch(struct rig_device *device);

/* A byte from the line; one that finds no room is lost, and its frame with it. Interrupt of the
 * line; constant time. */
void rig_byte_in(struct rig_device *device, uint8_t byte);

/* The next byte for the line; false if there is none. Interrupt of the line; constant time. */
bool rig_byte_out(struct rig_device *device, uint8_t *byte);

#endif
