#include "reset.h"

#define CPACR (*(volatile uint32_t *)0xE000ED88u)

/* Of board.ld. */
extern uint32_t data_image;
extern uint32_t data_start;
extern uint32_t data_end;
extern uint32_t bss_start;
extern uint32_t bss_end;

int main(void);

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
