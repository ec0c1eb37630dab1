#include "law.h"

#if RIG_HAS_LAW

#include <string.h>

_Static_assert(RIG_CONTROLLER_AHEAD == 1, "LAW: its answers act a tick after their sample: ahead: 1");

#define MOST 32767.0f       /* codes */
#define TOLERANCE 0.0001f   /* of the period */
#define LARGEST 3.402823e38f /* what no finite number passes */

static bool is_finite(float value) {
    return (value >= -LARGEST) && (value <= LARGEST);
}

static int16_t rounded(float code) {
    const float within = (code > MOST) ? MOST : ((code < -MOST) ? -MOST : code);
    return (int16_t)((within < 0.0f) ? within - 0.5f : within + 0.5f);
}

void rig_law_clear(struct rig_law *law) {
    (void)memset(law, 0, sizeof *law);
}

bool rig_law_read(struct rig_law_order *order, const uint8_t *at, uint32_t period, uint32_t clock) {
    order->on = at[2] == 1u;
    order->first = rig_get32(at + 4);
    order->blend = rig_get16(at + 8);
    struct rig_law_scales *scales = &order->scales;
    scales->count = rig_signed32(rig_get32(at + 12));
    scales->angle = rig_float(rig_get32(at + 16));
    scales->current = rig_float(rig_get32(at + 20));
    scales->current_zero = rig_float(rig_get32(at + 24));
    scales->torque = rig_float(rig_get32(at + 28));
    scales->torque_zero = rig_float(rig_get32(at + 32));
    scales->reference = rig_float(rig_get32(at + 36));
    const float tuned = (float)RIG_CONTROLLER_PERIOD;
    const float off = (float)period / (float)clock - tuned;
    return (at[2] <= 1u) && (off <= TOLERANCE * tuned) && (off >= -TOLERANCE * tuned) &&
           is_finite(scales->angle) && is_finite(scales->current) &&
           is_finite(scales->current_zero) && is_finite(scales->torque) &&
           is_finite(scales->torque_zero) && is_finite(scales->reference);
}

bool rig_law_switch(struct rig_law *law, uint32_t tick) {
    if (law->passed < law->blend) {
        law->passed++;
    }
    if (!law->waits || (tick != law->order.first)) {
        return false;
    }
    law->waits = false;
    law->blend = law->order.blend;
    law->passed = 0u;
    for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
        law->from[i] = law->given[i];
    }
    if (law->order.on) {
        law->scales = law->order.scales;
    }
    if (law->order.on && !law->on) {
        law->reference = 0;
        for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
            law->answer[i] = (float)law->given[i];
        }
        rig_controller_reset(&law->controller);
    }
    law->on = law->order.on;
    return true;
}

bool rig_law_outputs(const struct rig_law *law, int16_t codes[RIG_OUTPUTS]) {
    bool numbers = true;
    for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
        const bool number = law->answer[i] == law->answer[i];
        numbers = numbers && number;
        codes[i] = rounded(number ? law->answer[i] : 0.0f);
    }
    return numbers;
}

bool rig_law_blend(const struct rig_law *law, int16_t codes[RIG_OUTPUTS]) {
    if (law->passed >= law->blend) {
        return false;
    }
    const float part = (float)law->passed / (float)law->blend;
    for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
        const float from = (float)law->from[i];
        codes[i] = rounded(from + part * ((float)codes[i] - from));
    }
    return true;
}

void rig_law_answer(struct rig_law *law, const struct rig_inputs *inputs,
                    const int16_t codes[RIG_OUTPUTS]) {
    law->given[0] = codes[0];
    law->given[1] = codes[1];
    if (!law->on) {
        return;
    }
    const struct rig_law_scales *scales = &law->scales;
    const int32_t count = rig_signed32((uint32_t)inputs->count - (uint32_t)scales->count);
    const float theta = scales->angle * (float)count;
    const float omega = scales->angle * inputs->rate;
    const float current = scales->current * (float)inputs->analog[0] + scales->current_zero;
    const float torque = scales->torque * (float)inputs->analog[2] + scales->torque_zero;
    const float reference = scales->reference * (float)law->reference;
    rig_controller_step(&law->controller, (rig_real)theta, (rig_real)omega, (rig_real)torque,
                        (rig_real)current, (rig_real)reference, 0);
    for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
        law->answer[i] = law->per_volt[i] * (float)law->controller.volts[i];
    }
}

#endif
