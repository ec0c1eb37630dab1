/* From reset to main; what ends in a fault ends with zero outputs, and then in a reset. */
#include <stdint.h>

#include "board.h"
#include "registers.h"

extern uint32_t stack_top;
extern uint32_t data_image;
extern uint32_t data_start;
extern uint32_t data_end;
extern uint32_t bss_start;
extern uint32_t bss_end;

int main(void);
void tim2_handler(void);
void systick_handler(void);
void usart1_handler(void);
void dma2_stream7_handler(void);
void reset_handler(void);
void fault_handler(void);

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

/* Faults, a quartz that fails (NMI), a supply that sags (PVD), interrupts that nobody asked for. */
void fault_handler(void) {
    __asm__ volatile("cpsid i" : : : "memory");
    RCC_AHB1ENR |= 1u << 2; /* port C, should it not be on yet */
    (void)RCC_AHB1ENR;
    board_zero();
    GPIO_MODER(GPIOC) = (GPIO_MODER(GPIOC) & ~(3u << 12)) | (1u << 12);
    for (;;) {
        /* Not fed, the independent watchdog resets. */
    }
}

typedef void (*vector)(void);

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    vector exceptions[15];
    vector interrupts[82];
} VECTORS = {
    .stack = &stack_top,
    .exceptions = {reset_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, fault_handler, fault_handler, fault_handler, fault_handler,
                   fault_handler, fault_handler, fault_handler, fault_handler, systick_handler},
    .interrupts = {[0 ... IRQ_TIM2 - 1u] = fault_handler,
                   [IRQ_TIM2] = tim2_handler,
                   [IRQ_TIM2 + 1u ... IRQ_USART1 - 1u] = fault_handler,
                   [IRQ_USART1] = usart1_handler,
                   [IRQ_USART1 + 1u ... IRQ_DMA2_STREAM7 - 1u] = fault_handler,
                   [IRQ_DMA2_STREAM7] = dma2_stream7_handler,
                   [IRQ_DMA2_STREAM7 + 1u ... 81] = fault_handler},
};
