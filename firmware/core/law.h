/* A torque controller between the samples and the outputs: what rig export c wrote, where the build
 * has one (make LAW=FOLDER). Without one nothing of this is in the firmware but RIG_HAS_LAW. */
#ifndef RIG_LAW_H
#define RIG_LAW_H

#include <stdbool.h>
#include <stdint.h>

#include "guard.h"
#include "wire.h"

/* RIG_FIRMWARE: what WELCOME calls the firmware, by which a host knows the controller. */
#ifdef RIG_LAW_HEADER
#define RIG_HAS_LAW 1
#include RIG_LAW_HEADER
#define RIG_FIRMWARE "hybrid-rig 1, law " RIG_CONTROLLER_FINGERPRINT
#else
#define RIG_HAS_LAW 0
#define RIG_FIRMWARE "hybrid-rig 1"
#endif

#if RIG_HAS_LAW

/* Codes of the inputs and of the reference as the controller wants them. */
struct rig_law_scales {
    int32_t count;      /* at angle 0 */
    float angle;        /* rad per count */
    float current;      /* of the motor, A per code */
    float current_zero; /* A at code 0 */
    float torque;       /* N*m per code */
    float torque_zero;  /* N*m at code 0 */
    float reference;    /* N*m per code */
};

/* What LAW asks for. */
struct rig_law_order {
    struct rig_law_scales scales;
    uint32_t first; /* tick from which on it holds */
    uint32_t blend; /* ticks over which the outputs move over */
    bool on;
};

/* Written by the main loop with interrupts locked, or while no tick comes: order and waits. */
struct rig_law {
    struct rig_law_order order;
    bool waits; /* for its tick */
    bool on;
    uint32_t blend;
    uint32_t passed; /* ticks since the last switch */
    struct rig_law_scales scales;
    float per_volt[RIG_OUTPUTS]; /* codes */
    int16_t reference;           /* code, held where none comes */
    int16_t from[RIG_OUTPUTS];   /* what was applied at the switch */
    int16_t given[RIG_OUTPUTS];  /* what was applied last */
    float answer[RIG_OUTPUTS];   /* to the sample before, codes */
    rig_controller controller;
};

/* Off, and nothing ordered. Main, while no tick comes; constant time. */
void rig_law_clear(struct rig_law *law);

/* The order of LAW's payload; false for values that none has, or for a controller of another period
 * than this. Main; constant time. */
bool rig_law_read(struct rig_law_order *order, const uint8_t *at, uint32_t period, uint32_t clock);

/* Begin what is ordered for this tick; whether something was. Interrupt; constant time beside
 * rig_controller_reset. */
bool rig_law_switch(struct rig_law *law, uint32_t tick);

/* The answer to the sample before; false where it is no number. Interrupt; constant time. */
bool rig_law_outputs(const struct rig_law *law, int16_t codes[RIG_OUTPUTS]);

/* On the way from what was applied at the switch to these codes; whether they were changed.
 * Interrupt; constant time. */
bool rig_law_blend(const struct rig_law *law, int16_t codes[RIG_OUTPUTS]);

/* What this tick applied, and, while the controller is on, its answer to this tick's inputs, for the
 * next. Interrupt, once the outputs stand; constant time beside rig_controller_step. */
void rig_law_answer(struct rig_law *law, const struct rig_inputs *inputs,
                    const int16_t codes[RIG_OUTPUTS]);

#endif

#endif
