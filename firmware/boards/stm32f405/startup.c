/* The vectors; what ends in a fault ends with zero outputs, and then in a reset. */
#include "reset.h"

#include "board.h"
#include "registers.h"

void tim2_handler(void);
void systick_handler(void);
void usart1_handler(void);
void dma2_stream7_handler(void);

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
