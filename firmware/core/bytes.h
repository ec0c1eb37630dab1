/* A ring of bytes between one interrupt and the main loop, without locks. */
#ifndef RIG_BYTES_H
#define RIG_BYTES_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

/* head is written by who puts, tail by who gets; both count up and wrap at 2^32. size: a power of
 * two. */
struct rig_bytes {
    uint8_t *bytes;
    uint32_t size;
    atomic_uint_least32_t head;
    atomic_uint_least32_t tail;
};

/* Before any interrupt uses it; constant time. */
void rig_bytes_init(struct rig_bytes *ring, uint8_t *bytes, uint32_t size);

/* Free bytes, or more by the time they are used. Whoever puts; constant time. */
uint32_t rig_bytes_room(const struct rig_bytes *ring);

/* Write a byte `ahead` of the head, where there is room; it is not seen before rig_bytes_publish.
 * Whoever puts; constant time. */
void rig_bytes_write(struct rig_bytes *ring, uint32_t ahead, uint8_t byte);

/* Make n written bytes visible. Whoever puts; constant time. */
void rig_bytes_publish(struct rig_bytes *ring, uint32_t n);

/* Append a byte; false if there is no room. Whoever puts; constant time. */
bool rig_bytes_put(struct rig_bytes *ring, uint8_t byte);

/* Take the oldest byte; false if there is none. Whoever gets; constant time. */
bool rig_bytes_get(struct rig_bytes *ring, uint8_t *byte);

/* Whether there is a byte to take. Whoever gets; constant time. */
bool rig_bytes_any(const struct rig_bytes *ring);

/* Forget all bytes. Nobody may put or get meanwhile; constant time. */
void rig_bytes_clear(struct rig_bytes *ring);

#endif
