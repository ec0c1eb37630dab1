/* What the timer's interrupts do: samples, commands, the latches that close by themselves. */
#include "device.h"

static void close_latch(struct rig_run *run, enum rig_latch latch) {
    run->latch = latch;
    run->urgent = true;
}

static void watch(struct rig_run *run) {
    const struct rig_watchdog *watchdog = &run->watchdog;
    if ((run->latch != RIG_LATCH_WATCHDOG) &&
        rig_watchdog_silent(watchdog, board_clock(), watchdog->limit)) {
        close_latch(run, RIG_LATCH_WATCHDOG);
    }
}

/* The output of a tick, and its flags. */
static uint32_t command(struct rig_device *device, int16_t codes[RIG_OUTPUTS]) {
    struct rig_run *run = &device->run;
    uint32_t flags = 0u;
    codes[0] = 0;
    codes[1] = 0;
    if (run->latch != RIG_LATCH_NONE) {
        flags = (run->latch == RIG_LATCH_UNDERFLOW) ? (uint32_t)RIG_FLAG_UNDERFLOW : 0u;
    } else if (rig_commands_take(&device->commands, run->tick, codes)) {
        flags = rig_guard_clamp(&run->guard, codes) ? (uint32_t)RIG_FLAG_CLAMPED : 0u;
        run->last[0] = codes[0];
        run->last[1] = codes[1];
    } else if (device->commands.closed) {
        flags = RIG_FLAG_HELD;
        codes[0] = run->last[0];
        codes[1] = run->last[1];
    } else {
        close_latch(run, RIG_LATCH_UNDERFLOW);
        flags = RIG_FLAG_UNDERFLOW;
    }
    return flags;
}

void rig_on_tick(struct rig_device *device) {
    struct rig_run *run = &device->run;
    if ((run->state != RIG_RUNNING) || (run->tick == UINT32_MAX)) {
        return;
    }
    struct rig_inputs inputs;
    board_latch(&inputs);
    watch(run);
    int16_t codes[RIG_OUTPUTS];
    uint32_t flags = command(device, codes);
    if ((run->latch == RIG_LATCH_NONE) && rig_guard_beyond(&run->guard, &inputs)) {
        close_latch(run, RIG_LATCH_INTERLOCK);
        flags = RIG_FLAG_INTERLOCK;
        codes[0] = 0;
        codes[1] = 0;
    }
    struct rig_sample sample = {.tick = run->tick,
                                .analog = {inputs.analog[0], inputs.analog[1], inputs.analog[2]},
                                .count = inputs.count,
                                .rate = inputs.rate,
                                .applied = {0, 0},
                                .flags = flags};
    sample.flags |= inputs.at_end ? (uint32_t)RIG_FLAG_SATURATED : 0u;
    board_apply(codes, sample.applied);
    if (!rig_samples_put(&device->samples, &sample)) {
        run->overflow++;
    }
    run->tick++;
}

void rig_on_watch(struct rig_device *device) {
    struct rig_run *run = &device->run;
    if (run->state == RIG_RUNNING) {
        watch(run);
        if (run->latch == RIG_LATCH_WATCHDOG) {
            board_zero();
        }
    }
}

void rig_byte_in(struct rig_device *device, uint8_t byte) {
    (void)rig_bytes_put(&device->received, byte);
}

bool rig_byte_out(struct rig_device *device, uint8_t *byte) {
    return rig_bytes_get(&device->waiting, byte);
}
