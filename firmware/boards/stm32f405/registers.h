/* Registers that this board uses (RM0090; ARMv7-M Architecture Reference Manual). */
#ifndef STM32F405_REGISTERS_H
#define STM32F405_REGISTERS_H

#include <stdint.h>

#define REG(ADDRESS) (*(volatile uint32_t *)(ADDRESS))

#define RCC_CR REG(0x40023800u)
#define RCC_PLLCFGR REG(0x40023804u)
#define RCC_CFGR REG(0x40023808u)
#define RCC_CIR REG(0x4002380Cu)
#define RCC_AHB1ENR REG(0x40023830u)
#define RCC_APB1ENR REG(0x40023840u)
#define RCC_APB2ENR REG(0x40023844u)
#define FLASH_ACR REG(0x40023C00u)
#define PWR_CR REG(0x40007000u)

#define GPIOA 0x40020000u
#define GPIOB 0x40020400u
#define GPIOC 0x40020800u
#define GPIO_MODER(PORT) REG((PORT) + 0x00u)
#define GPIO_OSPEEDR(PORT) REG((PORT) + 0x08u)
#define GPIO_PUPDR(PORT) REG((PORT) + 0x0Cu)
#define GPIO_IDR(PORT) REG((PORT) + 0x10u)
#define GPIO_BSRR(PORT) REG((PORT) + 0x18u)
#define GPIO_AFRL(PORT) REG((PORT) + 0x20u)
#define GPIO_AFRH(PORT) REG((PORT) + 0x24u)

#define TIM2 0x40000000u
#define TIM3 0x40000400u
#define TIM5 0x40000C00u
#define TIM_CR1(TIMER) REG((TIMER) + 0x00u)
#define TIM_CR2(TIMER) REG((TIMER) + 0x04u)
#define TIM_SMCR(TIMER) REG((TIMER) + 0x08u)
#define TIM_DIER(TIMER) REG((TIMER) + 0x0Cu)
#define TIM_SR(TIMER) REG((TIMER) + 0x10u)
#define TIM_EGR(TIMER) REG((TIMER) + 0x14u)
#define TIM_CCMR1(TIMER) REG((TIMER) + 0x18u)
#define TIM_CCER(TIMER) REG((TIMER) + 0x20u)
#define TIM_CNT(TIMER) REG((TIMER) + 0x24u)
#define TIM_PSC(TIMER) REG((TIMER) + 0x28u)
#define TIM_ARR(TIMER) REG((TIMER) + 0x2Cu)
#define TIM_CCR1(TIMER) REG((TIMER) + 0x34u)
#define TIM_CCR2(TIMER) REG((TIMER) + 0x38u)

#define SPI1 0x40013000u
#define SPI2 0x40003800u
#define SPI_CR1(SPI) REG((SPI) + 0x00u)
#define SPI_SR(SPI) REG((SPI) + 0x08u)
#define SPI_DR(SPI) REG((SPI) + 0x0Cu)

#define USART1_SR REG(0x40011000u)
#define USART1_DR REG(0x40011004u)
#define USART1_BRR REG(0x40011008u)
#define USART1_CR1 REG(0x4001100Cu)
#define USART1_CR3 REG(0x40011014u)

#define DMA2_HISR REG(0x40026404u)
#define DMA2_LIFCR REG(0x40026408u)
#define DMA2_HIFCR REG(0x4002640Cu)
#define DMA2_STREAM2 0x40026440u /* channel 4: USART1 received */
#define DMA2_STREAM7 0x400264B8u /* channel 4: USART1 transmits */
#define DMA_CR(STREAM) REG((STREAM) + 0x00u)
#define DMA_NDTR(STREAM) REG((STREAM) + 0x04u)
#define DMA_PAR(STREAM) REG((STREAM) + 0x08u)
#define DMA_M0AR(STREAM) REG((STREAM) + 0x0Cu)

#define EXTI_IMR REG(0x40013C00u)
#define EXTI_RTSR REG(0x40013C08u)

#define IWDG_KR REG(0x40003000u)
#define IWDG_PR REG(0x40003004u)
#define IWDG_RLR REG(0x40003008u)
#define IWDG_SR REG(0x4000300Cu)

#define UNIQUE_ID REG(0x1FFF7A10u)

#define SYST_CSR REG(0xE000E010u)
#define SYST_RVR REG(0xE000E014u)
#define SYST_CVR REG(0xE000E018u)
#define NVIC_ISER0 REG(0xE000E100u)
#define NVIC_ISER1 REG(0xE000E104u)
#define NVIC_ISER2 REG(0xE000E108u)
#define NVIC_IPR0 REG(0xE000E400u)  /* interrupts 0 to 3 */
#define NVIC_IPR17 REG(0xE000E444u) /* 68 to 71 */
#define NVIC_IPR7 REG(0xE000E41Cu) /* interrupts 28 to 31 */
#define NVIC_IPR9 REG(0xE000E424u) /* 36 to 39 */
#define SHPR3 REG(0xE000ED20u)     /* PendSV, SysTick */

#define IRQ_PVD 1u
#define IRQ_DMA2_STREAM7 70u
#define IRQ_TIM2 28u
#define IRQ_USART1 37u

#endif
