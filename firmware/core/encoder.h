/* Speed of a quadrature counter by the time between its edges.
 *
 * From tick to tick the counts that came are divided by the time between their last edges, as the
 * timer captured them: one count over the time between two edges at low speed, an average over a
 * tick at high speed. Without a new edge the speed is at most one count over the time since. */
#ifndef RIG_ENCODER_H
#define RIG_ENCODER_H

#include <stdbool.h>
#include <stdint.h>

struct rig_encoder {
    uint32_t clock;      /* of the edge times [Hz] */
    uint32_t standstill; /* ticks of that clock without an edge that count as standing still */
    uint32_t count;      /* at the last edge seen */
    uint32_t edge;       /* its time */
    float rate;          /* counts per second */
    int8_t direction;    /* of the last edge, 0: none was seen */
};

/* No edge has been seen yet. standstill: below half of the edge clock's range. Before the first
 * update; constant time. */
void rig_encoder_init(struct rig_encoder *encoder, uint32_t clock, uint32_t standstill,
                      uint32_t count);

/* The rate at a tick [1/s]. count: the counter's, modulo 2^32; edge: time of its last edge, and
 * now: of this tick, both modulo 2^32. Interrupt (tick), at every tick; constant time. */
float rig_encoder_update(struct rig_encoder *encoder, uint32_t count, uint32_t edge, uint32_t now);

#endif
