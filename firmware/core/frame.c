#include "frame.h"

#include "crc32.h"

#define FULL_GROUP 0xFFu /* 254 bytes of data, and no zero behind them */

void rig_decoder_reset(struct rig_decoder *decoder) {
    decoder->size = 0u;
    decoder->left = 0u;
    decoder->zero = false;
    decoder->begun = false;
    decoder->broken = false;
}

static void append(struct rig_decoder *decoder, uint8_t byte) {
    if (decoder->size < RIG_BODY_IN) {
        decoder->body[decoder->size] = byte;
        decoder->size++;
    } else {
        decoder->broken = true;
    }
}

static bool complete(const struct rig_decoder *decoder, struct rig_frame *frame) {
    const uint8_t *body = decoder->body;
    if (decoder->broken || (decoder->left != 0u) || (decoder->size < RIG_FRAME_OVERHEAD)) {
        return false;
    }
    const uint32_t length = decoder->size - RIG_FRAME_OVERHEAD;
    const uint32_t covered = RIG_HEADER_SIZE + length;
    if ((body[1] != 0u) || (rig_get16(body + 6) != length) ||
        (rig_get32(body + covered) != rig_crc32(body, covered))) {
        return false;
    }
    frame->type = body[0];
    frame->session = rig_get16(body + 2);
    frame->number = rig_get16(body + 4);
    frame->length = (uint16_t)length;
    frame->payload = body + RIG_HEADER_SIZE;
    return true;
}

bool rig_decode(struct rig_decoder *decoder, uint8_t byte, struct rig_frame *frame) {
    if (byte == 0u) {
        const bool whole = complete(decoder, frame);
        rig_decoder_reset(decoder);
        return whole;
    }
    if (decoder->left != 0u) {
        decoder->left--;
        append(decoder, byte);
    } else {
        if (decoder->begun && decoder->zero) {
            append(decoder, 0u);
        }
        decoder->begun = true;
        decoder->zero = byte != FULL_GROUP;
        decoder->left = (uint8_t)(byte - 1u);
    }
    return false;
}

/* The COBS code of n bytes, behind a zero and before another; its length on the wire. */
static uint32_t stuff(struct rig_bytes *ring, const uint8_t *body, uint32_t n) {
    uint32_t place = 1u; /* of the group's length */
    uint32_t end = 2u;
    uint8_t group = 1u;
    rig_bytes_write(ring, 0u, 0u);
    for (uint32_t i = 0u; i < n; i++) {
        if (body[i] != 0u) {
            rig_bytes_write(ring, end, body[i]);
            end++;
            group++;
        }
        if ((body[i] == 0u) || ((group == FULL_GROUP) && (i + 1u < n))) {
            rig_bytes_write(ring, place, group);
            place = end;
            end++;
            group = 1u;
        }
    }
    rig_bytes_write(ring, place, group);
    rig_bytes_write(ring, end, 0u);
    return end + 1u;
}

bool rig_encode(struct rig_bytes *ring, uint8_t *body, const struct rig_frame *frame,
                uint32_t reserve) {
    const uint32_t covered = RIG_HEADER_SIZE + (uint32_t)frame->length;
    const uint32_t size = covered + RIG_CRC_SIZE;
    if (rig_bytes_room(ring) < rig_wire_size(size) + reserve) {
        return false;
    }
    body[0] = frame->type;
    body[1] = 0u;
    rig_put16(body + 2, frame->session);
    rig_put16(body + 4, frame->number);
    rig_put16(body + 6, frame->length);
    rig_put32(body + covered, rig_crc32(body, covered));
    rig_bytes_publish(ring, stuff(ring, body, size));
    return true;
}
