/* Rates of an encoder: u32 count, u32 edge, u32 now from standard input, an f32 for each to standard
 * output. encoder CLOCK STANDSTILL COUNT */
#include <stdio.h>
#include <stdlib.h>

#include "encoder.h"
#include "wire.h"

int main(int count, char **words) {
    struct rig_encoder encoder;
    uint8_t row[12];
    if (count != 4) {
        return 2;
    }
    rig_encoder_init(&encoder, (uint32_t)strtoul(words[1], NULL, 10),
                     (uint32_t)strtoul(words[2], NULL, 10), (uint32_t)strtoul(words[3], NULL, 10));
    while (fread(row, 1, sizeof row, stdin) == sizeof row) {
        const float rate =
            rig_encoder_update(&encoder, rig_get32(row), rig_get32(row + 4), rig_get32(row + 8));
        rig_put32(row, rig_float_bits(rate));
        if (fwrite(row, 1, 4, stdout) != 4u) {
            return 2;
        }
    }
    return 0;
}
