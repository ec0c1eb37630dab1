/* Plays sequences of events from standard input, and writes what came of them.
 *
 * A sequence is u32 n and n bytes of events, numbers little-endian:
 *   0  u16 n, n bytes                    from the line
 *   1  u32                               ticks of the clock that pass
 *   2  3 x i32, i32, i32, f32, u8        inputs: analog, count, its increment, rate, at the end
 *   3  u32                               bytes that the line takes from now on, the largest: any
 *   4                                    the timer stands still: a fault
 *   5  u16 n, n bytes                    from the line, while the main loop hangs
 * Its trace is u32 n and n bytes: for every event
 *   u32 n, n bytes                       to the line
 *   u16 n, n x (u32 tick, 2 x i16)       ticks, and what each applied
 *   u8 state, u8 latch, 2 x i16          afterwards, with the outputs
 *   u8 phase, f32 turns                  announced last
 *   u32                                  times that the independent watchdog was fed
 */
#include <stdio.h>
#include <stdlib.h>

#include "host.h"

#define LONGEST (1u << 24)

static struct rig_device device;
static uint8_t events[LONGEST];
static uint8_t trace[LONGEST];
static uint32_t traced;
static uint8_t ticks[LONGEST];
static uint32_t ticked_bytes;
static uint32_t takes;

static void reserve(uint32_t used, uint32_t n) {
    if (LONGEST - used < n) {
        (void)fputs("replay: a sequence that is too long\n", stderr);
        exit(2);
    }
}

static void put8(uint8_t value) {
    reserve(traced, 1u);
    trace[traced] = value;
    traced++;
}

static void put16(uint16_t value) {
    put8((uint8_t)(value & 0xFFu));
    put8((uint8_t)(value >> 8));
}

static void put32(uint32_t value) {
    put16((uint16_t)(value & 0xFFFFu));
    put16((uint16_t)(value >> 16));
}

static void drain(void) {
    uint8_t byte;
    while ((takes != 0u) && rig_byte_out(&device, &byte)) {
        put8(byte);
        takes -= (takes != UINT32_MAX) ? 1u : 0u;
    }
}

static void note_tick(struct rig_device *ticking) {
    drain();
    reserve(ticked_bytes, 8u);
    rig_put32(ticks + ticked_bytes, ticking->run.tick - 1u);
    rig_put16(ticks + ticked_bytes + 4, (uint16_t)host_board.outputs[0]);
    rig_put16(ticks + ticked_bytes + 6, (uint16_t)host_board.outputs[1]);
    ticked_bytes += 8u;
}

static uint32_t play(const uint8_t *event, uint32_t place) {
    ticked_bytes = 0u;
    const uint32_t sent_at = traced;
    put32(0u);
    switch (event[0]) {
    case 0: {
        const uint32_t n = rig_get16(event + 1);
        host_feed(&device, event + 3, n);
        place += 3u + n;
        break;
    }
    case 1:
        host_run(&device, host_board.clock + rig_get32(event + 1), note_tick);
        place += 5u;
        break;
    case 3:
        takes = rig_get32(event + 1);
        place += 5u;
        break;
    case 4:
        host_board.period = 0u;
        place += 1u;
        break;
    case 5: {
        const uint32_t n = rig_get16(event + 1);
        for (uint32_t i = 0u; i < n; i++) {
            rig_byte_in(&device, event[3u + i]);
        }
        place += 3u + n;
        break;
    }
    default:
        for (uint32_t i = 0u; i < RIG_INPUTS; i++) {
            host_board.inputs.analog[i] = rig_signed32(rig_get32(event + 1u + 4u * i));
        }
        host_board.inputs.count = rig_signed32(rig_get32(event + 13));
        host_board.increment = rig_signed32(rig_get32(event + 17));
        host_board.inputs.rate = rig_float(rig_get32(event + 21));
        host_board.inputs.at_end = event[25] != 0u;
        place += 26u;
        break;
    }
    drain();
    rig_put32(trace + sent_at, traced - sent_at - 4u);
    put16((uint16_t)(ticked_bytes / 8u));
    for (uint32_t i = 0u; i < ticked_bytes; i++) {
        put8(ticks[i]);
    }
    put8((uint8_t)device.run.state);
    put8((uint8_t)device.run.latch);
    put16((uint16_t)host_board.outputs[0]);
    put16((uint16_t)host_board.outputs[1]);
    put8(host_board.phase);
    put32(rig_float_bits(host_board.turns));
    put32(host_board.fed);
    return place;
}

int main(void) {
    uint8_t length[4];
    while (fread(length, 1, sizeof length, stdin) == sizeof length) {
        const uint32_t n = rig_get32(length);
        reserve(0u, n);
        if (fread(events, 1, n, stdin) != n) {
            return 2;
        }
        host_reset(&device);
        traced = 0u;
        takes = UINT32_MAX;
        for (uint32_t place = 0u; place < n;) {
            place = play(events + place, place);
        }
        rig_put32(length, traced);
        if ((fwrite(length, 1, sizeof length, stdout) != sizeof length) ||
            (fwrite(trace, 1, traced, stdout) != traced) || (fflush(stdout) != 0)) {
            return 2;
        }
    }
    return 0;
}
