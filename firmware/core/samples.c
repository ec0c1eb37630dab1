#include "samples.h"

void rig_samples_clear(struct rig_samples *samples) {
    atomic_store_explicit(&samples->head, 0u, memory_order_relaxed);
    atomic_store_explicit(&samples->tail, 0u, memory_order_relaxed);
}

bool rig_samples_put(struct rig_samples *samples, const struct rig_sample *sample) {
    const uint32_t head = atomic_load_explicit(&samples->head, memory_order_relaxed);
    const uint32_t tail = atomic_load_explicit(&samples->tail, memory_order_acquire);
    if (head - tail == RIG_SAMPLES) {
        return false;
    }
    samples->ring[head % RIG_SAMPLES] = *sample;
    atomic_store_explicit(&samples->head, head + 1u, memory_order_release);
    return true;
}

uint32_t rig_samples_waiting(const struct rig_samples *samples) {
    const uint32_t head = atomic_load_explicit(&samples->head, memory_order_acquire);
    return head - atomic_load_explicit(&samples->tail, memory_order_relaxed);
}

uint32_t rig_samples_taken(const struct rig_samples *samples) {
    return (uint32_t)atomic_load_explicit(&samples->head, memory_order_acquire);
}

const struct rig_sample *rig_samples_at(const struct rig_samples *samples, uint32_t ahead) {
    const uint32_t tail = atomic_load_explicit(&samples->tail, memory_order_relaxed);
    return &samples->ring[(tail + ahead) % RIG_SAMPLES];
}

void rig_samples_drop(struct rig_samples *samples, uint32_t n) {
    const uint32_t tail = atomic_load_explicit(&samples->tail, memory_order_relaxed);
    atomic_store_explicit(&samples->tail, tail + n, memory_order_release);
}

void rig_sample_pack(const struct rig_sample *sample, uint8_t *at) {
    for (uint32_t i = 0u; i < RIG_INPUTS; i++) {
        rig_put32(at + 4u * i, (uint32_t)sample->analog[i]);
    }
    rig_put32(at + 12, (uint32_t)sample->count);
    rig_put32(at + 16, rig_float_bits(sample->rate));
    for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
        rig_put16(at + 20u + 2u * i, (uint16_t)sample->applied[i]);
    }
    rig_put32(at + 24, sample->flags);
}
