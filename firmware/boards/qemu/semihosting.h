/* The host's files, by ARM semihosting: pipes to the plant. */
#ifndef QEMU_SEMIHOSTING_H
#define QEMU_SEMIHOSTING_H

#include <stdint.h>

enum semihosting_mode { SEMIHOSTING_READ = 1, SEMIHOSTING_WRITE = 5 };

/* Open a file; its handle, negative for none. A named pipe waits for its other end. */
int32_t semihosting_open(const char *name, uint32_t length, enum semihosting_mode mode);

/* Write n bytes; how many were not. */
uint32_t semihosting_write(int32_t handle, const uint8_t *bytes, uint32_t n);

/* Read up to n bytes, and wait for the first; how many of n were not read. */
uint32_t semihosting_read(int32_t handle, uint8_t *bytes, uint32_t n);

/* End the emulator with a status. */
_Noreturn void semihosting_exit(uint32_t status);

#endif
