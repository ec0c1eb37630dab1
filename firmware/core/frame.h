/* Frames on the wire: a zero, COBS of header, payload and CRC, a zero. */
#ifndef RIG_FRAME_H
#define RIG_FRAME_H

#include <stdbool.h>
#include <stdint.h>

#include "bytes.h"
#include "config.h"
#include "wire.h"

#define RIG_FRAME_OVERHEAD (RIG_HEADER_SIZE + RIG_CRC_SIZE)
#define RIG_BODY_IN (RIG_FRAME_OVERHEAD + RIG_PAYLOAD)

/* A frame that passed every check; the payload stays valid until the decoder gets its next byte. */
struct rig_frame {
    uint8_t type;
    uint16_t session;
    uint16_t number;
    uint16_t length;
    const uint8_t *payload;
};

/* One byte after the other; body holds what is decoded of the frame so far. */
struct rig_decoder {
    uint8_t body[RIG_BODY_IN];
    uint32_t size;
    uint8_t left; /* data bytes that its group still has */
    bool zero;    /* whether a zero follows that group, if another group does */
    bool begun;   /* whether a byte came since the last zero */
    bool broken;  /* whether this frame is wrong already */
};

/* Forget a frame begun. Main; constant time. */
void rig_decoder_reset(struct rig_decoder *decoder);

/* Take a byte from the line; true when it completes a frame, which is then in *frame. Everything
 * else that is wrong is dropped. Main; constant time, but for the CRC of RIG_BODY_IN bytes. */
bool rig_decode(struct rig_decoder *decoder, uint8_t byte, struct rig_frame *frame);

/* Bytes on the wire of a body (header to CRC) of n bytes, at most. Any context; constant time. */
static inline uint32_t rig_wire_size(uint32_t n) {
    return n + n / 254u + 3u;
}

/* Write header and CRC around a payload that stands at body + RIG_HEADER_SIZE, and the whole as a
 * frame into the ring. False, and nothing done, where the ring has not room for it and `reserve`
 * more bytes. Main; n + RIG_FRAME_OVERHEAD steps. */
bool rig_encode(struct rig_bytes *ring, uint8_t *body, const struct rig_frame *frame,
                uint32_t reserve);

#endif
