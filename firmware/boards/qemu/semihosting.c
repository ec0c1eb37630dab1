#include "semihosting.h"

static uint32_t call(uint32_t operation, const void *block) {
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = block;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

int32_t semihosting_open(const char *name, uint32_t length, enum semihosting_mode mode) {
    const uint32_t block[3] = {(uint32_t)(uintptr_t)name, (uint32_t)mode, length};
    return (int32_t)call(0x01u, block);
}

uint32_t semihosting_write(int32_t handle, const uint8_t *bytes, uint32_t n) {
    const uint32_t block[3] = {(uint32_t)handle, (uint32_t)(uintptr_t)bytes, n};
    return call(0x05u, block);
}

uint32_t semihosting_read(int32_t handle, uint8_t *bytes, uint32_t n) {
    const uint32_t block[3] = {(uint32_t)handle, (uint32_t)(uintptr_t)bytes, n};
    return call(0x06u, block);
}

_Noreturn void semihosting_exit(uint32_t status) {
    const uint32_t block[2] = {0x20026u, status}; /* ADP_Stopped_ApplicationExit */
    for (;;) {
        (void)call(0x20u, block);
    }
}
