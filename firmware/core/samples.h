/* Samples on their way from the tick's interrupt to the line. */
#ifndef RIG_SAMPLES_H
#define RIG_SAMPLES_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "config.h"
#include "wire.h"

/* One sample, with the tick at which it was latched. */
struct rig_sample {
    uint32_t tick;
    int32_t analog[RIG_INPUTS];
    int32_t count;
    float rate; /* counts per second */
    int16_t applied[RIG_OUTPUTS];
    uint32_t flags;
};

struct rig_samples {
    struct rig_sample ring[RIG_SAMPLES];
    atomic_uint_least32_t head; /* written by the interrupt */
    atomic_uint_least32_t tail; /* written by the main loop */
};

/* Forget all. Main, while no tick comes; constant time. */
void rig_samples_clear(struct rig_samples *samples);

/* Keep a sample; false if there is no room. Interrupt; constant time. */
bool rig_samples_put(struct rig_samples *samples, const struct rig_sample *sample);

/* How many wait. Main; constant time. */
uint32_t rig_samples_waiting(const struct rig_samples *samples);

/* How many were ever put, modulo 2^32. Main; constant time. */
uint32_t rig_samples_taken(const struct rig_samples *samples);

/* The first of those that wait, and `ahead` after it; it must be there. Main; constant time. */
const struct rig_sample *rig_samples_at(const struct rig_samples *samples, uint32_t ahead);

/* Forget the first n. Main; constant time. */
void rig_samples_drop(struct rig_samples *samples, uint32_t n);

/* The 28 bytes of a sample. Main; constant time. */
void rig_sample_pack(const struct rig_sample *sample, uint8_t *at);

#endif
