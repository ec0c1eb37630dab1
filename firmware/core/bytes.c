#include "bytes.h"

void rig_bytes_init(struct rig_bytes *ring, uint8_t *bytes, uint32_t size) {
    ring->bytes = bytes;
    ring->size = size;
    atomic_init(&ring->head, 0u);
    atomic_init(&ring->tail, 0u);
}

uint32_t rig_bytes_room(const struct rig_bytes *ring) {
    const uint32_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    const uint32_t tail = atomic_load_explicit(&ring->tail, memory_order_acquire);
    return ring->size - (head - tail);
}

void rig_bytes_write(struct rig_bytes *ring, uint32_t ahead, uint8_t byte) {
    const uint32_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    ring->bytes[(head + ahead) & (ring->size - 1u)] = byte;
}

void rig_bytes_publish(struct rig_bytes *ring, uint32_t n) {
    const uint32_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    atomic_store_explicit(&ring->head, head + n, memory_order_release);
}

bool rig_bytes_put(struct rig_bytes *ring, uint8_t byte) {
    if (rig_bytes_room(ring) == 0u) {
        return false;
    }
    rig_bytes_write(ring, 0u, byte);
    rig_bytes_publish(ring, 1u);
    return true;
}

bool rig_bytes_any(const struct rig_bytes *ring) {
    return atomic_load_explicit(&ring->head, memory_order_acquire) !=
           atomic_load_explicit(&ring->tail, memory_order_relaxed);
}

bool rig_bytes_get(struct rig_bytes *ring, uint8_t *byte) {
    const uint32_t tail = atomic_load_explicit(&ring->tail, memory_order_relaxed);
    if (atomic_load_explicit(&ring->head, memory_order_acquire) == tail) {
        return false;
    }
    *byte = ring->bytes[tail & (ring->size - 1u)];
    atomic_store_explicit(&ring->tail, tail + 1u, memory_order_release);
    return true;
}

void rig_bytes_clear(struct rig_bytes *ring) {
    const uint32_t head = atomic_load_explicit(&ring->head, memory_order_relaxed);
    atomic_store_explicit(&ring->tail, head, memory_order_relaxed);
}
