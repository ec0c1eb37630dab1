/* From reset to main, for any Cortex-M; your vendor's does it as well, if every exception ends in
 * zero outputs as here. */
#include <stdint.h>

#include "board.h"

#define INTERRUPTS 82 /* of your microcontroller: the last number of its vector table, and one */
#define CPACR (*(volatile uint32_t *)0xE000ED88u)

extern uint32_t stack_top;
extern uint32_t data_image;
extern uint32_t data_start;
extern uint32_t data_end;
extern uint32_t bss_start;
extern uint32_t bss_end;

int main(void);
void reset_handler(void);
void fault_handler(void);

void reset_handler(void) {
#if defined(__ARM_FP)
    CPACR |= 0xFu << 20; /* floating point */
    __asm__ volatile("dsb\n\tisb");
#endif
    const uint32_t *from = &data_image;
    for (uint32_t *to = &data_start; to < &data_end; to++) {
        *to = *from;
        from++;
    }
    for (uint32_t *to = &bss_start; to < &bss_end; to++) {
        *to = 0u;
    }
    (void)main();
    fault_handler();
}

/* Faults, and interrupts that nobody asked for. board_zero must work here before main has begun. */
void fault_handler(void) {
    __asm__ volatile("cpsid i" : : : "memory");
    board_zero();
    for (;;) {
        /* Not fed, the independent watchdog resets. */
    }
}

typedef void (*vector)(void);

/* Put the handlers of board.c in their places, by the table in the reference manual:
 *   [0 ... 27] = fault_handler, [28] = timer_handler, [29 ... INTERRUPTS - 1] = fault_handler
 * and SysTick's, the last of the exceptions. */
__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    vector exceptions[15];
    vector interrupts[INTERRUPTS];
} VECTORS = {
    .stack = &stack_top,
    .exceptions = {reset_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, fault_handler, fault_handler, fault_handler, fault_handler},
    .interrupts = {[0 ... INTERRUPTS - 1] = fault_handler},
};
