/* The vectors, for any Cortex-M; your vendor's startup code does as well, in place of this and of
 * cortex_m/reset.c, if every exception ends in zero outputs as here. */
#include "reset.h"

#include "board.h"

#define INTERRUPTS 82 /* of your microcontroller: the last number of its vector table, and one */

/* Faults, and interrupts that nobody asked for. board_zero must work here before main has begun. */
void fault_handler(void) {
    __asm__ volatile("cpsid i" : : : "memory");
    board_zero();
    for (;;) {
        /* Not fed, the independent watchdog resets. */
    }
}

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
