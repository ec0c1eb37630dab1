/* The vectors, and what ends in a fault. */
#include "reset.h"

#include "semihosting.h"

#define FAULT 3u /* status of the emulator */

void systick_handler(void);
void usart1_handler(void);

void fault_handler(void) {
    semihosting_exit(FAULT);
}

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    vector exceptions[15];
    vector interrupts[38];
} VECTORS = {
    .stack = &stack_top,
    .exceptions = {reset_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, 0, 0, 0, 0, fault_handler, fault_handler, 0, fault_handler,
                   systick_handler},
    .interrupts = {[37] = usart1_handler},
};
