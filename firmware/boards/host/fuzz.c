/* Damages frames and feeds them to the decoder: fuzz FRAMES SEED. None may be accepted.
 *
 * Of each new frame there are fifteen damaged ones, and then itself. Damage: bits turned, bytes replaced, dropped, inserted, the end cut off, two frames' halves
 * joined. A code that decodes to the very bytes that were sent is another way to write the same
 * frame, not a damaged one, and counts as such. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "host.h"

#define ROOM 1024u
#define SHARE 16u /* one of so many goes through whole */

static uint64_t state;

static uint32_t draw(uint32_t n) { /* below n; xorshift64* */
    state ^= state >> 12;
    state ^= state << 25;
    state ^= state >> 27;
    return (uint32_t)((state * 0x2545F4914F6CDD1DuLL) >> 33) % n;
}

/* A frame on the wire without its zeros; its length. */
static uint32_t make(uint8_t *wire, uint8_t *body, uint32_t *size) {
    static uint8_t bytes[2048];
    struct rig_bytes ring;
    struct rig_frame frame = {0};
    static const uint16_t lengths[] = {0u, 2u, 8u, 8u, 12u, 40u, 60u, 72u, 260u, 264u};
    frame.type = (uint8_t)draw(0x14u);
    frame.session = (uint16_t)draw(0x10000u);
    frame.number = (uint16_t)draw(0x10000u);
    frame.length = lengths[draw(10u)];
    const bool sparse = draw(2u) == 0u; /* as commands and limits are: many zeros */
    for (uint32_t i = 0u; i < frame.length; i++) {
        body[RIG_HEADER_SIZE + i] = (uint8_t)((sparse && (draw(2u) != 0u)) ? 0u : draw(256u));
    }
    rig_bytes_init(&ring, bytes, sizeof bytes);
    if (!rig_encode(&ring, body, &frame, 0u)) {
        exit(2);
    }
    *size = frame.length + RIG_FRAME_OVERHEAD;
    uint32_t n = 0u;
    uint8_t byte;
    while (rig_bytes_get(&ring, &byte)) {
        if (byte != 0u) {
            wire[n] = byte;
            n++;
        }
    }
    return n;
}

/* other: a frame of m bytes whose halves may be joined to it. */
static uint32_t damage(uint8_t *wire, uint32_t n, const uint8_t *other, uint32_t m) {
    const uint32_t times = 1u + draw(3u);
    for (uint32_t i = 0u; (i < times) && (n > 1u); i++) {
        const uint32_t at = draw(n);
        switch (draw(6u)) {
        case 0:
            wire[at] = (uint8_t)(wire[at] ^ (1u << draw(8u)));
            break;
        case 1:
            wire[at] = (uint8_t)draw(256u);
            break;
        case 2:
            n--;
            for (uint32_t k = at; k < n; k++) {
                wire[k] = wire[k + 1u];
            }
            break;
        case 3:
            for (uint32_t k = n; k > at; k--) {
                wire[k] = wire[k - 1u];
            }
            wire[at] = (uint8_t)draw(256u);
            n++;
            break;
        case 4:
            n = at + 1u;
            break;
        default:
            /* Behind session and number, which differ: else it would be the other one, whole. */
            for (uint32_t k = (at < 8u) ? 8u : at; (k < m) && (k < ROOM / 2u); k++) {
                wire[k] = other[k];
                n = k + 1u;
            }
            break;
        }
    }
    return n;
}

int main(int count, char **words) {
    if (count != 3) {
        (void)fputs("fuzz FRAMES SEED\n", stderr);
        return 2;
    }
    const unsigned long frames = strtoul(words[1], NULL, 10);
    state = strtoull(words[2], NULL, 10) * 2u + 1u;
    struct rig_decoder decoder;
    struct rig_frame frame;
    uint8_t body[ROOM];
    uint8_t scratch[ROOM];
    uint8_t made[ROOM];
    uint8_t other[ROOM];
    uint8_t wire[ROOM];
    uint32_t size = 0u;
    uint32_t length = 0u;
    uint32_t joined = 0u;
    unsigned long accepted = 0u;
    unsigned long same = 0u;
    unsigned long whole = 0u;
    rig_decoder_reset(&decoder);
    for (unsigned long i = 0u; i < frames; i++) {
        if (i % SHARE == 0u) {
            joined = make(other, scratch, &size);
            length = make(made, body, &size);
        }
        (void)memcpy(wire, made, length);
        const bool hurt = (i % SHARE) != SHARE - 1u;
        const uint32_t n = hurt ? damage(wire, length, other, joined) : length;
        for (uint32_t k = 0u; k <= n; k++) {
            if (rig_decode(&decoder, (k < n) ? wire[k] : 0u, &frame)) {
                const bool equal = (frame.length + RIG_FRAME_OVERHEAD == size) &&
                                   (memcmp(frame.payload - RIG_HEADER_SIZE, body, size) == 0);
                whole += (!hurt && equal) ? 1u : 0u;
                same += (hurt && equal) ? 1u : 0u;
                accepted += equal ? 0u : 1u;
            }
        }
    }
    (void)printf("{\"frames\": %lu, \"accepted\": %lu, \"same\": %lu, \"whole\": %lu}\n", frames,
                 accepted, same, whole);
    return ((accepted == 0u) && (whole == frames / SHARE)) ? 0 : 1;
}
