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

/* Whether this tick's commands are a controller's references, not outputs. */
static bool is_answered(struct rig_run *run) {
#if RIG_HAS_LAW
    const bool before = run->law.on;
    if (rig_law_switch(&run->law, run->tick) && (run->law.on != before)) {
        run->last[0] = 0; /* what was held is of another kind */
        run->last[1] = 0;
    }
    return run->law.on;
#else
    (void)run;
    return false;
#endif
}

/* What the host wants of a tick, and its flags. */
static uint32_t command(struct rig_device *device, int16_t codes[RIG_OUTPUTS]) {
    struct rig_run *run = &device->run;
    uint32_t flags = 0u;
    codes[0] = 0;
    codes[1] = 0;
    if (run->latch != RIG_LATCH_NONE) {
        return (run->latch == RIG_LATCH_UNDERFLOW) ? (uint32_t)RIG_FLAG_UNDERFLOW : 0u;
    }
    const bool answered = is_answered(run);
    if (rig_commands_take(&device->commands, run->tick, codes)) {
        const bool clamped = !answered && rig_guard_clamp(&run->guard, codes);
        flags = clamped ? (uint32_t)RIG_FLAG_CLAMPED : 0u;
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

#if RIG_HAS_LAW
/* What a controller makes of it, within the clamps like any command. */
static uint32_t answer(struct rig_run *run, int16_t codes[RIG_OUTPUTS], uint32_t flags) {
    struct rig_law *law = &run->law;
    if (law->on) {
        law->reference = codes[0];
        if (!rig_law_outputs(law, codes)) {
            close_latch(run, RIG_LATCH_INTERLOCK);
            return RIG_FLAG_INTERLOCK;
        }
    }
    const bool blended = rig_law_blend(law, codes);
    if (!law->on && !blended) {
        return flags;
    }
    const bool clamped = rig_guard_clamp(&run->guard, codes);
    return flags | (uint32_t)RIG_FLAG_LAW | (clamped ? (uint32_t)RIG_FLAG_CLAMPED : 0u);
}
#endif

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
#if RIG_HAS_LAW
    if (run->latch == RIG_LATCH_NONE) {
        flags = answer(run, codes, flags);
    }
#endif
    if ((run->latch == RIG_LATCH_NONE) && rig_guard_beyond(&run->guard, &inputs)) {
        close_latch(run, RIG_LATCH_INTERLOCK);
        flags = RIG_FLAG_INTERLOCK;
    }
    if (run->latch != RIG_LATCH_NONE) {
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
#if RIG_HAS_LAW
    if (run->latch == RIG_LATCH_NONE) {
        rig_law_answer(&run->law, &inputs, codes);
    }
#endif
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
