#include "host.h"

#include <string.h>

#define STEP (20.0 / 65536.0) /* V, of 16 bits over +-10 V */
#define PIECE 600u /* bytes that come between two turns of the main loop: two of them */
#define LINGER (2u * (uint64_t)HOST_CLOCK)

struct host_board host_board;

#define ANALOG(NAME) {NAME, "V", STEP, 0.0, -10.0, 10.0}

const struct rig_identity host_identity = {
    .device = "host",
    .firmware = RIG_FIRMWARE,
    .serial = "0",
    .clock = HOST_CLOCK,
    .shortest_period = 250u,
    .watchdog_default = 100u,
    .watchdog_longest = 10000u,
    .lowest = {-16384, 0},
    .highest = {16384, 1245},
    .channels = {ANALOG("current_motor"), ANALOG("current_brake"), ANALOG("torque"),
                 {"motor", "V", STEP, 0.0, -16384 * STEP, 16384 * STEP},
                 {"brake", "V", STEP, 0.0, 0.0, 1245 * STEP},
                 {"encoder", "count", 1.0, 0.0, -2147483648.0, 2147483647.0}},
};

uint64_t board_clock(void) {
    return host_board.clock;
}

void board_latch(struct rig_inputs *inputs) {
    *inputs = host_board.inputs;
    host_board.inputs.count =
        rig_signed32((uint32_t)inputs->count + (uint32_t)host_board.increment);
}

void board_apply(const int16_t codes[RIG_OUTPUTS], int16_t applied[RIG_OUTPUTS]) {
    (void)memcpy(host_board.outputs, codes, sizeof host_board.outputs);
    (void)memcpy(applied, codes, sizeof host_board.outputs);
}

void board_zero(void) {
    (void)memset(host_board.outputs, 0, sizeof host_board.outputs);
}

uint64_t board_timer_start(uint32_t period) {
    host_board.period = period;
    host_board.due = host_board.clock;
    return host_board.clock;
}

void board_timer_stop(void) {
    host_board.period = 0u;
}

uint32_t board_lock(void) {
    return 0u;
}

void board_unlock(uint32_t token) {
    (void)token;
}

void board_transmit(void) {
    /* Tests take what there is. */
}

void board_feed(void) {
    host_board.fed++;
}

void board_announce(uint8_t phase, float turns) {
    host_board.phase = phase;
    host_board.turns = turns;
}

void host_reset(struct rig_device *device) {
    (void)memset(&host_board, 0, sizeof host_board);
    rig_init(device, &host_identity);
}

static uint64_t earlier(uint64_t a, uint64_t b) {
    return (a < b) ? a : b;
}

void host_run(struct rig_device *device, uint64_t clock, void (*ticked)(struct rig_device *)) {
    for (;;) {
        const struct rig_run *run = &device->run;
        uint64_t next = clock;
        if (host_board.period != 0u) {
            const struct rig_watchdog *watchdog = &run->watchdog;
            const uint64_t silent = watchdog->heard + watchdog->limit + 1u;
            next = earlier(next, host_board.due);
            if (run->latch != RIG_LATCH_WATCHDOG) {
                next = earlier(next, silent);
            }
            next = earlier(next, watchdog->heard + LINGER + 1u);
        }
        if (next > host_board.clock) {
            host_board.clock = next;
        }
        const bool ticks = (host_board.period != 0u) && (host_board.due <= host_board.clock);
        if (ticks) {
            host_board.due += host_board.period;
            rig_on_tick(device);
            if (ticked != NULL) {
                ticked(device);
            }
        } else {
            rig_on_watch(device);
        }
        rig_poll(device);
        if (!ticks && (host_board.clock >= clock)) {
            return;
        }
    }
}

void host_feed(struct rig_device *device, const uint8_t *bytes, uint32_t n) {
    for (uint32_t i = 0u; i < n; i++) {
        rig_byte_in(device, bytes[i]);
        if ((i % PIECE == PIECE - 1u) || (i + 1u == n)) {
            do {
                rig_poll(device);
            } while (rig_is_busy(device));
        }
    }
}
