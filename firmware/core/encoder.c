#include "encoder.h"

#include "wire.h"

void rig_encoder_init(struct rig_encoder *encoder, uint32_t clock, uint32_t standstill,
                      uint32_t count) {
    encoder->clock = clock;
    encoder->standstill = standstill;
    encoder->count = count;
    encoder->edge = 0u;
    encoder->rate = 0.0f;
    encoder->direction = 0;
}

float rig_encoder_update(struct rig_encoder *encoder, uint32_t count, uint32_t edge, uint32_t now) {
    const int32_t moved = rig_signed32(count - encoder->count);
    if (moved != 0) {
        const int8_t direction = (moved > 0) ? 1 : -1;
        const uint32_t passed = edge - encoder->edge;
        /* After a reversal, or standing still, the edge before says nothing of the speed: it is the
         * same edge once more, or too long ago for its time. */
        const bool follows = (direction == encoder->direction) && (passed != 0u) &&
                             (passed <= encoder->standstill);
        encoder->rate =
            follows ? (float)moved * (float)encoder->clock / (float)passed : 0.0f;
        encoder->count = count;
        encoder->edge = edge;
        encoder->direction = direction;
        return encoder->rate;
    }
    const uint32_t waited = now - encoder->edge;
    if ((encoder->direction == 0) || (waited > encoder->standstill)) {
        encoder->direction = 0; /* before its time comes round again */
        encoder->rate = 0.0f;
        return 0.0f;
    }
    const float most = (float)encoder->clock / (float)((waited != 0u) ? waited : 1u);
    if (encoder->rate > most) {
        return most;
    }
    return (encoder->rate < -most) ? -most : encoder->rate;
}
