/* CRC-32 as in Ethernet, zip and zlib. */
#ifndef RIG_CRC32_H
#define RIG_CRC32_H

#include <stddef.h>
#include <stdint.h>

/* CRC of n bytes. Any context; n steps. */
uint32_t rig_crc32(const uint8_t *bytes, size_t n);

#endif
