/* Numbers and byte order of the serial protocol (docs/serial-protocol.md). */
#ifndef RIG_WIRE_H
#define RIG_WIRE_H

#include <stdint.h>
#include <string.h>

#define RIG_INPUTS 3u
#define RIG_OUTPUTS 2u
#define RIG_CHANNELS 6u
#define RIG_VERSION 1u

enum rig_type {
    RIG_HELLO = 0x01,
    RIG_START = 0x02,
    RIG_GO = 0x03,
    RIG_STOP = 0x04,
    RIG_SAFE = 0x05,
    RIG_CLEAR = 0x06,
    RIG_ANNOUNCE = 0x07,
    RIG_LAW = 0x08,
    RIG_COMMANDS = 0x10,
    RIG_PING = 0x11,
    RIG_WELCOME = 0x81,
    RIG_REPLY = 0x82,
    RIG_SAMPLES_TYPE = 0x90,
    RIG_PONG = 0x91,
    RIG_STATUS = 0x92
};

enum rig_state { RIG_IDLE = 0, RIG_ARMED = 1, RIG_RUNNING = 2 };

enum rig_latch {
    RIG_LATCH_NONE = 0,
    RIG_LATCH_SAFE = 1,
    RIG_LATCH_UNDERFLOW = 2,
    RIG_LATCH_INTERLOCK = 3,
    RIG_LATCH_WATCHDOG = 4
};

enum rig_result {
    RIG_OK = 0,
    RIG_NO_SESSION = 1,
    RIG_WRONG_STATE = 2,
    RIG_BAD_VALUE = 3,
    RIG_LATCHED = 4,
    RIG_UNKNOWN = 5
};

enum rig_flag {
    RIG_FLAG_CLAMPED = 1,
    RIG_FLAG_HELD = 2,
    RIG_FLAG_INTERLOCK = 8,
    RIG_FLAG_UNDERFLOW = 16,
    RIG_FLAG_SATURATED = 32,
    RIG_FLAG_LAW = 128
};

/* Sizes in bytes. */
#define RIG_HEADER_SIZE 8u
#define RIG_CRC_SIZE 4u
#define RIG_START_SIZE 60u
#define RIG_RUN_SIZE 2u
#define RIG_ANNOUNCE_SIZE 8u
#define RIG_LAW_SIZE 40u
#define RIG_COMMANDS_HEAD 8u
#define RIG_COMMAND_SIZE 4u
#define RIG_PING_SIZE 8u
#define RIG_HELLO_HEAD 6u
#define RIG_STATUS_SIZE 24u
#define RIG_REPLY_SIZE 28u
#define RIG_PONG_SIZE 48u
#define RIG_SAMPLES_HEAD 40u
#define RIG_SAMPLE_SIZE 28u
#define RIG_WELCOME_HEAD 124u
#define RIG_CHANNEL_SIZE 56u
#define RIG_WELCOME_SIZE (RIG_WELCOME_HEAD + RIG_CHANNELS * RIG_CHANNEL_SIZE)

/* Little-endian numbers at any address. Any context; constant time. */

static inline uint16_t rig_get16(const uint8_t *at) {
    return (uint16_t)((uint32_t)at[0] | ((uint32_t)at[1] << 8));
}

static inline uint32_t rig_get32(const uint8_t *at) {
    return (uint32_t)rig_get16(at) | ((uint32_t)rig_get16(at + 2) << 16);
}

static inline void rig_put16(uint8_t *at, uint16_t value) {
    at[0] = (uint8_t)(value & 0xFFu);
    at[1] = (uint8_t)(value >> 8);
}

static inline void rig_put32(uint8_t *at, uint32_t value) {
    rig_put16(at, (uint16_t)(value & 0xFFFFu));
    rig_put16(at + 2, (uint16_t)(value >> 16));
}

static inline void rig_put64(uint8_t *at, uint64_t value) {
    rig_put32(at, (uint32_t)(value & 0xFFFFFFFFu));
    rig_put32(at + 4, (uint32_t)(value >> 32));
}

/* Two's complement, and floats by their bits, without what C leaves to the compiler. Any context;
 * constant time. */
static inline int32_t rig_signed32(uint32_t bits) {
    int32_t value;
    (void)memcpy(&value, &bits, sizeof value);
    return value;
}

static inline int16_t rig_signed16(uint16_t bits) {
    int16_t value;
    (void)memcpy(&value, &bits, sizeof value);
    return value;
}

static inline float rig_float(uint32_t bits) {
    float value;
    (void)memcpy(&value, &bits, sizeof value);
    return value;
}

static inline uint32_t rig_float_bits(float value) {
    uint32_t bits;
    (void)memcpy(&bits, &value, sizeof bits);
    return bits;
}

static inline uint64_t rig_double_bits(double value) {
    uint64_t bits;
    (void)memcpy(&bits, &value, sizeof bits);
    return bits;
}

#endif
