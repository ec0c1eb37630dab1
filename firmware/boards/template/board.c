/* A board to begin with: copy this folder, and write what each comment asks for.
 *
 *   cp -r boards/template boards/mine; make BOARD=mine
 *
 * docs/firmware.md goes through it in an order in which a mistake costs little. Everything that is
 * zero here is legal, and does nothing. */
#include "board.h"

#include "device.h"
#include "encoder.h"
#include "sleep.h"

/* The clock that times everything: a timer that runs freely. Samples are whole numbers of its ticks
 * apart, so that rate and clock can only be wrong together. A quartz, no RC oscillator: a host
 * refuses a clock that is 1 % wrong. */
#define CLOCK 1000000u /* Hz */

/* Volts per code. A negative scale says that the stage behind the converter inverts. */
#define STEP_IN (20.0 / 65536.0)
#define STEP_OUT (20.0 / 65536.0)

static struct rig_device device;
static struct rig_encoder encoder;

/* What WELCOME says. The limits of the outputs are the device's own: no host gets beyond them. Code
 * 0 of an output must be 0 V. */
static const struct rig_identity IDENTITY = {
    .device = "my board",
    .firmware = RIG_FIRMWARE,
    .serial = "0001",
    .clock = CLOCK,
    .shortest_period = CLOCK / 4000u, /* by the longest that board_latch and board_apply take */
    .watchdog_default = 100u,
    .watchdog_longest = 10000u,
    .lowest = {-16384, 0},
    .highest = {16384, 1245},
    .channels = {{"current_motor", "V", STEP_IN, 0.0, -10.0, 10.0},
                 {"current_brake", "V", STEP_IN, 0.0, -10.0, 10.0},
                 {"torque", "V", STEP_IN, 0.0, -10.0, 10.0},
                 {"motor", "V", STEP_OUT, 0.0, -16384 * STEP_OUT, 16384 * STEP_OUT},
                 {"brake", "V", STEP_OUT, 0.0, 0.0, 1245 * STEP_OUT},
                 {"encoder", "count", 1.0, 0.0, -2147483648.0, 2147483647.0}},
};


/* board_lock and board_unlock are those of cortex_m/lock.c, which keep all interrupts off. With a lock
 * by BASEPRI, as boards/stm32f405 has it, a supply that sags is still heard; but it keeps off none of
 * priority 0, which all have after reset. */

/* A counter of 32 bits is extended here: note each time that it has become less. Then call this more
 * often than it runs over, from the interrupt of rig_on_watch. */
uint64_t board_clock(void) {
    return 0u;
}

/* First the encoder, then the converters; best of all, the timer's hardware starts them. A counter
 * of 16 bits is extended to 32: subtract as u16, read the result as i16, add it up. A converter that
 * does not answer is at its end: the guard then does what is right. */
void board_latch(struct rig_inputs *inputs) {
    for (uint32_t i = 0u; i < RIG_INPUTS; i++) {
        inputs->analog[i] = 0;
    }
    inputs->count = 0;
    inputs->at_end = false; /* whether a code is the first or the last of its converter */
    /* The time of the last edge, from a capture unit, in ticks of 32 bits. */
    inputs->rate = rig_encoder_update(&encoder, (uint32_t)inputs->count, 0u, 0u);
}

/* Best of all, the timer's hardware loads them at a fixed time behind the tick. */
void board_apply(const int16_t codes[RIG_OUTPUTS], int16_t applied[RIG_OUTPUTS]) {
    applied[0] = codes[0];
    applied[1] = codes[1];
}

/* A pin that clears the converter beats a message to it. With a resistor that holds the pin where
 * it clears, the outputs are zero in reset and in the bootloader too. */
void board_zero(void) {
}

/* Tick 0 at once, the next ones by the timer's compare: its interrupt adds `period` to the compare
 * register and calls rig_on_tick. Clear a tick that is pending from before. */
uint64_t board_timer_start(uint32_t period) {
    (void)period;
    return board_clock();
}

void board_timer_stop(void) {
}

/* Start the DMA, or the interrupt, that takes bytes by rig_byte_out until there is none. Waiting for
 * the line here would keep the main loop from hearing the host, whose silence then trips the
 * watchdog. */
void board_transmit(void) {
}

/* 50 ms are a good time for it. */
void board_feed(void) {
}

void board_announce(uint8_t phase, float turns) {
    (void)phase;
    (void)turns;
}

/* Interrupts: the timer's calls rig_on_tick(&device), one a millisecond rig_on_watch(&device) at the
 * same priority, a lower one gives the line's bytes to rig_byte_in(&device, byte). Their places are
 * in startup.c. */

int main(void);
int main(void) {
    /* In this order: the independent watchdog on; the outputs at zero; clocks, pins, converters. */
    rig_init(&device, &IDENTITY);
    rig_encoder_init(&encoder, CLOCK, CLOCK / 10u, 0u);
    /* Interrupts on. */
    for (;;) {
        rig_poll(&device);
        sleep_unless_busy(&device);
    }
}
