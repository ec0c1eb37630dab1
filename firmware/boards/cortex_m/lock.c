#include "board.h"

uint32_t board_lock(void) {
    uint32_t token;
    __asm__ volatile("mrs %0, primask\n\tcpsid i" : "=r"(token) : : "memory");
    return token;
}

void board_unlock(uint32_t token) {
    __asm__ volatile("msr primask, %0" : : "r"(token) : "memory");
}
