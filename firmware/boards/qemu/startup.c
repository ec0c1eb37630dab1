/* From reset to main, and what ends in a fault. */
#include <stdint.h>

#include "semihosting.h"

extern uint32_t stack_top;
extern uint32_t data_image;
extern uint32_t data_start;
extern uint32_t data_end;
extern uint32_t bss_start;
extern uint32_t bss_end;

int main(void);
void systick_handler(void);
void usart1_handler(void);
void reset_handler(void);
void fault_handler(void);

#define CPACR (*(volatile uint32_t *)0xE000ED88u)
#define FAULT 3u /* status of the emulator */

void reset_handler(void) {
    CPACR |= 0xFu << 20; /* floating point */
    __asm__ volatile("dsb\n\tisb");
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

void fault_handler(void) {
    semihosting_exit(FAULT);
}

typedef void (*vector)(void);

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
