#include "guard.h"

bool rig_guard_read(struct rig_guard *guard, const uint8_t *start,
                    const int16_t lowest[RIG_OUTPUTS], const int16_t highest[RIG_OUTPUTS]) {
    bool legal = true;
    for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
        const int16_t low = rig_signed16(rig_get16(start + 12u + 2u * i));
        const int16_t high = rig_signed16(rig_get16(start + 16u + 2u * i));
        legal = legal && (low <= 0) && (high >= 0);
        guard->lowest[i] = (int16_t)((low > lowest[i]) ? low : lowest[i]);
        guard->highest[i] = (int16_t)((high < highest[i]) ? high : highest[i]);
    }
    for (uint32_t i = 0u; i < RIG_INPUTS; i++) {
        guard->analog_low[i] = rig_signed32(rig_get32(start + 20u + 4u * i));
        guard->analog_high[i] = rig_signed32(rig_get32(start + 32u + 4u * i));
    }
    guard->count_low = rig_signed32(rig_get32(start + 44));
    guard->count_high = rig_signed32(rig_get32(start + 48));
    guard->rate = rig_float(rig_get32(start + 52));
    guard->step = rig_get32(start + 56);
    guard->begun = false;
    return legal && (guard->rate >= 0.0f); /* which NaN is not */
}

bool rig_guard_clamp(const struct rig_guard *guard, int16_t codes[RIG_OUTPUTS]) {
    bool clamped = false;
    for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
        if (codes[i] < guard->lowest[i]) {
            codes[i] = guard->lowest[i];
            clamped = true;
        } else if (codes[i] > guard->highest[i]) {
            codes[i] = guard->highest[i];
            clamped = true;
        } else {
            /* Within. */
        }
    }
    return clamped;
}

static uint32_t magnitude(uint32_t difference) {
    return (difference > (uint32_t)INT32_MAX) ? 0u - difference : difference;
}

bool rig_guard_beyond(struct rig_guard *guard, const struct rig_inputs *inputs) {
    const uint32_t count = (uint32_t)inputs->count;
    if (!guard->begun) {
        guard->begun = true;
        guard->first = count;
        guard->before = count;
    }
    const int32_t travel = rig_signed32(count - guard->first);
    const uint32_t step = magnitude(count - guard->before);
    guard->before = count;
    bool beyond = (travel < guard->count_low) || (travel > guard->count_high) ||
                  (step > guard->step) ||
                  !((inputs->rate >= -guard->rate) && (inputs->rate <= guard->rate));
    for (uint32_t i = 0u; i < RIG_INPUTS; i++) {
        const int32_t code = inputs->analog[i];
        beyond = beyond || (code < guard->analog_low[i]) || (code > guard->analog_high[i]);
    }
    return beyond;
}
