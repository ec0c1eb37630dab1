/* An STM32F405 at 168 MHz with converters of 16 bits over +-10 V on SPI.
 *
 *   inputs    AD7606, V1 to V3: SPI1 PA5 SCK, PA6 DOUTA, PA4 CS; PA15 CONVST (TIM2_CH1), PC7 BUSY,
 *             PC8 RESET
 *   outputs   AD5752R, A and B: SPI2 PB13 SCK, PB15 SDIN, PB12 SYNC; PB3 LDAC (TIM2_CH2),
 *             PC6 CLR with 10 kOhm to ground, BIN/2sCOMP to ground
 *   encoder   A to PB4 (TIM3_CH1) and PA0 (TIM5_CH1), B to PB5 (TIM3_CH2) and PA1 (TIM5_CH2)
 *   line      USART1 PA9 TX, PA10 RX, 2 Mbit/s
 *
 * TIM2 runs freely at 84 MHz and is the clock. Its first compare starts the conversions, its second
 * loads the outputs 30 us later: both instants are the timer's, however long an interrupt waited.
 * CLR is held low by its resistor while the pin floats: in reset, in the bootloader, without a
 * program. The firmware pulls it low for zero, whatever else goes wrong.
 *
 * Written from the data sheets; it has not met this hardware. */
#include "board.h"

#include "device.h"
#include "encoder.h"
#include "registers.h"
#include "sleep.h"

#define CLOCK 84000000u /* Hz, of TIM2 and TIM5 */
#define LEAD 840u       /* ticks from GO to tick 0: 10 us */
#define LOAD 2520u      /* ticks from a tick to the loading of the outputs: 30 us */
#define SETTLE 168u     /* ticks that a compare must lie ahead: 2 us */
#define SYSTICK 168000u /* a millisecond */
#define WAIT 2000u      /* turns of a loop that waits for a converter, at most: some 50 us */
#define START_UP 1000000u /* of one that waits for the quartz */
#define PRIORITY_TICK 0x10u
#define PRIORITY_LINE 0x80u

#define STEP (20.0 / 65536.0) /* V */
/* What the outputs ever give; narrow it to what the amplifiers behind them may get. */
#define LOWEST_MOTOR (-16384)
#define HIGHEST_MOTOR 16384
#define LOWEST_BRAKE 0
#define HIGHEST_BRAKE 1245

#define CS_ADC (1u << 4)   /* of port A */
#define SYNC_DAC (1u << 12) /* of port B */
#define CLR_DAC (1u << 6)  /* of port C */
#define BUSY_ADC (1u << 7)
#define RESET_ADC (1u << 8)
#define LOW(PIN) ((PIN) << 16) /* in BSRR */

#define SPI_RXNE 1u
#define SPI_TXE 2u
#define SPI_BSY 0x80u

/* Output compare modes of a channel, of 4 bits. */
#define MATCH_HIGH 1u
#define MATCH_LOW 2u
#define FORCE_LOW 4u
#define FORCE_HIGH 5u

#define RECEIVED 1024u /* bytes, circular; twice what comes in 2 ms */
#define SENDING 256u

static struct rig_device device;
static struct rig_encoder encoder;
static char serial[25];
static uint32_t clock_high;
static uint32_t clock_low;
static uint32_t period;
static uint32_t instant; /* of the tick, low half of the clock */
static uint32_t count;   /* of 32 bits */
static bool cleared = true; /* whether CLR holds the outputs at zero */
static uint8_t received[RECEIVED];
static uint32_t taken; /* place in it */
static uint8_t sending[SENDING];

#define INPUT(NAME) {NAME, "V", STEP, 0.0, -32768 * STEP, 32767 * STEP}
static const struct rig_identity IDENTITY = {
    .device = "STM32F405",
    .firmware = RIG_FIRMWARE,
    .serial = serial,
    .clock = CLOCK,
    .shortest_period = CLOCK / 4000u,
    .watchdog_default = 100u,
    .watchdog_longest = 10000u,
    .lowest = {LOWEST_MOTOR, LOWEST_BRAKE},
    .highest = {HIGHEST_MOTOR, HIGHEST_BRAKE},
    .channels = {INPUT("current_motor"), INPUT("current_brake"), INPUT("torque"),
                 {"motor", "V", STEP, 0.0, LOWEST_MOTOR * STEP, HIGHEST_MOTOR * STEP},
                 {"brake", "V", STEP, 0.0, LOWEST_BRAKE * STEP, HIGHEST_BRAKE * STEP},
                 {"encoder", "count", 1.0, 0.0, -2147483648.0, 2147483647.0}},
};

/* --- interrupts and time ------------------------------------------------------------------------ */

uint32_t board_lock(void) {
    uint32_t token;
    __asm__ volatile("mrs %0, basepri\n\tmsr basepri_max, %1\n\tisb"
                     : "=&r"(token)
                     : "r"(PRIORITY_TICK)
                     : "memory");
    return token;
}

void board_unlock(uint32_t token) {
    __asm__ volatile("msr basepri, %0" : : "r"(token) : "memory");
}

/* Called at least once a millisecond, so that no turn of the counter (51 s) is missed. */
uint64_t board_clock(void) {
    const uint32_t token = board_lock();
    const uint32_t low = TIM_CNT(TIM2);
    if (low < clock_low) {
        clock_high++;
    }
    clock_low = low;
    const uint64_t now = ((uint64_t)clock_high << 32) | low;
    board_unlock(token);
    return now;
}

static void set_mode(uint32_t channel, uint32_t mode) {
    const uint32_t shift = (channel == 1u) ? 4u : 12u;
    TIM_CCMR1(TIM2) = (TIM_CCMR1(TIM2) & ~(7u << shift)) | (mode << shift);
}

uint64_t board_timer_start(uint32_t ticks) {
    const uint64_t now = board_clock();
    period = ticks;
    instant = (uint32_t)(now & 0xFFFFFFFFu) + LEAD;
    GPIO_BSRR(GPIOC) = CLR_DAC; /* the registers hold zero until they are loaded */
    cleared = false;
    set_mode(1u, FORCE_LOW);
    TIM_CCR1(TIM2) = instant;
    set_mode(1u, MATCH_HIGH);
    TIM_SR(TIM2) = ~2u;
    TIM_DIER(TIM2) = 2u;
    return now + LEAD;
}

void board_timer_stop(void) {
    TIM_DIER(TIM2) = 0u;
    TIM_SR(TIM2) = ~2u;
    set_mode(1u, FORCE_LOW);
    period = 0u;
}

void board_zero(void) {
    GPIO_BSRR(GPIOC) = LOW(CLR_DAC);
    cleared = true;
}

void board_feed(void) {
    IWDG_KR = 0xAAAAu;
}

void tim2_handler(void);
void tim2_handler(void) {
    TIM_SR(TIM2) = ~2u;
    instant = TIM_CCR1(TIM2);
    set_mode(2u, FORCE_HIGH); /* LDAC, for its next fall */
    rig_on_tick(&device);
    set_mode(1u, FORCE_LOW); /* CONVST, for its next rise */
    TIM_CCR1(TIM2) = instant + period;
    set_mode(1u, MATCH_HIGH);
}

void systick_handler(void);
void systick_handler(void) {
    (void)board_clock();
    rig_on_watch(&device);
}

/* --- converters and encoder --------------------------------------------------------------------- */

/* A frame of a converter; 0 where the peripheral does not answer in time. */
static uint16_t transfer(uint32_t spi, uint16_t word) {
    SPI_DR(spi) = word;
    for (uint32_t i = 0u; i < WAIT; i++) {
        if ((SPI_SR(spi) & SPI_RXNE) != 0u) {
            return (uint16_t)(SPI_DR(spi) & 0xFFFFu);
        }
    }
    return 0u;
}

/* 24 bits to the AD5752R: register and channel, then a value. */
static void write_dac(uint8_t address, uint16_t value) {
    GPIO_BSRR(GPIOB) = LOW(SYNC_DAC);
    (void)transfer(SPI2, address);
    (void)transfer(SPI2, (uint16_t)(value >> 8));
    (void)transfer(SPI2, (uint16_t)(value & 0xFFu));
    GPIO_BSRR(GPIOB) = SYNC_DAC;
}

/* The count and the time of its last edge, which belong together: no edge came between. */
static uint32_t latch_encoder(void) {
    uint32_t edge = TIM_CCR1(TIM5);
    uint32_t low = TIM_CNT(TIM3);
    for (uint32_t i = 0u; i < 3u; i++) {
        const uint32_t again = TIM_CCR1(TIM5);
        if (again == edge) {
            break;
        }
        edge = again;
        low = TIM_CNT(TIM3);
    }
    const uint16_t moved = (uint16_t)(low - count);
    count += (uint32_t)(int32_t)rig_signed16(moved);
    return edge;
}

static bool is_converted(void) {
    for (uint32_t i = 0u; i < WAIT; i++) {
        if ((GPIO_IDR(GPIOC) & BUSY_ADC) == 0u) {
            return true;
        }
    }
    return false;
}

void board_latch(struct rig_inputs *inputs) {
    const uint32_t edge = latch_encoder();
    const bool converted = is_converted(); /* 4 us after the tick */
    inputs->at_end = !converted;
    GPIO_BSRR(GPIOA) = LOW(CS_ADC);
    for (uint32_t i = 0u; i < RIG_INPUTS; i++) {
        /* A converter that does not answer stands at its end, which is beyond any guard. */
        const int16_t code = rig_signed16(transfer(SPI1, 0u));
        inputs->analog[i] = converted ? code : INT16_MAX;
        inputs->at_end = inputs->at_end || (code == INT16_MAX) || (code == INT16_MIN);
    }
    GPIO_BSRR(GPIOA) = CS_ADC;
    inputs->count = rig_signed32(count);
    inputs->rate = rig_encoder_update(&encoder, count, edge, instant);
}

void board_apply(const int16_t codes[RIG_OUTPUTS], int16_t applied[RIG_OUTPUTS]) {
    applied[0] = (int16_t)(cleared ? 0 : codes[0]);
    applied[1] = (int16_t)(cleared ? 0 : codes[1]);
    write_dac(0x00u, (uint16_t)applied[0]);
    write_dac(0x02u, (uint16_t)applied[1]);
    if ((codes[0] == 0) && (codes[1] == 0)) {
        set_mode(2u, FORCE_LOW); /* zero waits for nothing */
        return;
    }
    TIM_CCR2(TIM2) = instant + LOAD;
    set_mode(2u, MATCH_LOW);
    if (TIM_CNT(TIM2) - instant > LOAD - SETTLE) {
        set_mode(2u, FORCE_LOW); /* the interrupt came too late for it */
    }
}

void board_announce(uint8_t phase, float turns) {
    (void)phase; /* here is no lamp */
    (void)turns;
}

/* --- the line ----------------------------------------------------------------------------------- */

/* Bytes that the DMA has written since the last time. Main. */
static void receive(void) {
    const uint32_t place = RECEIVED - DMA_NDTR(DMA2_STREAM2);
    for (uint32_t i = 0u; (i < RECEIVED) && (taken != place % RECEIVED); i++) {
        rig_byte_in(&device, received[taken]);
        taken = (taken + 1u) % RECEIVED;
    }
}

/* Give the DMA what waits. Interrupts of the line locked. */
static void send_more(void) {
    uint32_t n = 0u;
    if ((DMA_CR(DMA2_STREAM7) & 1u) != 0u) {
        return; /* it is at work */
    }
    while ((n < SENDING) && rig_byte_out(&device, &sending[n])) {
        n++;
    }
    if (n != 0u) {
        DMA2_HIFCR = 0x3Du << 22;
        DMA_NDTR(DMA2_STREAM7) = n;
        DMA_CR(DMA2_STREAM7) |= 1u;
    }
}

void board_transmit(void) {
    const uint32_t token = board_lock();
    send_more();
    board_unlock(token);
}

void dma2_stream7_handler(void);
void dma2_stream7_handler(void) {
    DMA2_HIFCR = 0x3Du << 22;
    send_more();
}

void usart1_handler(void);
void usart1_handler(void) { /* the line has fallen silent: the main loop wakes */
    (void)USART1_SR;
    (void)USART1_DR;
}

/* --- from reset to the main loop ---------------------------------------------------------------- */

static void wait_for(volatile const uint32_t *address, uint32_t mask, uint32_t value) {
    for (uint32_t i = 0u; i < START_UP; i++) {
        if ((*address & mask) == value) {
            return;
        }
    }
    for (;;) {
        /* Without its quartz the board has no clock; the independent watchdog starts it anew. */
    }
}

static void set_clock(void) {
    RCC_APB1ENR |= 1u << 28; /* PWR */
    PWR_CR |= (1u << 14) | (7u << 5) | (1u << 4); /* full speed; PVD at 2.9 V */
    RCC_CR |= 1u << 16; /* HSE, 8 MHz */
    wait_for(&RCC_CR, 1u << 17, 1u << 17);
    RCC_PLLCFGR = 8u | (336u << 6) | (1u << 22) | (7u << 24); /* 8 / 8 * 336 / 2 = 168 MHz */
    RCC_CR |= (1u << 24) | (1u << 19); /* PLL; clock security: NMI if the quartz fails */
    wait_for(&RCC_CR, 1u << 25, 1u << 25);
    FLASH_ACR = 5u | (7u << 8); /* wait states, caches, prefetch */
    RCC_CFGR = (5u << 10) | (4u << 13) | 2u; /* APB1 42 MHz, APB2 84 MHz */
    wait_for(&RCC_CFGR, 3u << 2, 2u << 2);
}

static void alternate(uint32_t port, uint32_t pin, uint32_t function) {
    const uint32_t shift = (pin % 8u) * 4u;
    volatile uint32_t *select = (pin < 8u) ? &GPIO_AFRL(port) : &GPIO_AFRH(port);
    *select = (*select & ~(15u << shift)) | (function << shift);
    GPIO_OSPEEDR(port) |= 3u << (2u * pin);
    GPIO_MODER(port) = (GPIO_MODER(port) & ~(3u << (2u * pin))) | (2u << (2u * pin));
}

static void output(uint32_t port, uint32_t pin) {
    GPIO_OSPEEDR(port) |= 2u << (2u * pin);
    GPIO_MODER(port) = (GPIO_MODER(port) & ~(3u << (2u * pin))) | (1u << (2u * pin));
}

static void set_pins(void) {
    GPIO_BSRR(GPIOA) = CS_ADC;
    GPIO_BSRR(GPIOB) = SYNC_DAC;
    output(GPIOA, 4u);
    output(GPIOB, 12u);
    output(GPIOC, 8u);
    alternate(GPIOA, 5u, 5u);
    alternate(GPIOA, 6u, 5u);
    alternate(GPIOA, 9u, 7u);
    alternate(GPIOA, 10u, 7u);
    alternate(GPIOA, 15u, 1u);
    alternate(GPIOA, 0u, 2u);
    alternate(GPIOA, 1u, 2u);
    alternate(GPIOB, 3u, 1u);
    alternate(GPIOB, 4u, 2u);
    alternate(GPIOB, 5u, 2u);
    alternate(GPIOB, 13u, 5u);
    alternate(GPIOB, 15u, 5u);
}

static void set_timers(void) {
    TIM_ARR(TIM2) = 0xFFFFFFFFu;
    TIM_CCMR1(TIM2) = (FORCE_HIGH << 12) | (FORCE_LOW << 4);
    TIM_CCER(TIM2) = 0x11u;
    /* The count: both edges of both channels, filtered over 8 clocks. */
    TIM_ARR(TIM3) = 0xFFFFu;
    TIM_CCMR1(TIM3) = (3u << 12) | (1u << 8) | (3u << 4) | 1u;
    TIM_SMCR(TIM3) = 3u;
    /* The time of every edge: A exclusive-or B, either way. */
    TIM_ARR(TIM5) = 0xFFFFFFFFu;
    TIM_CR2(TIM5) = 1u << 7;
    TIM_CCMR1(TIM5) = (3u << 4) | 1u;
    TIM_CCER(TIM5) = 1u | (1u << 1) | (1u << 3);
    TIM_CR1(TIM3) = 1u;
    TIM_CR1(TIM5) = 1u;
    TIM_CR1(TIM2) = 1u;
    /* Both clocks read the same, but for the few ticks between these two lines. */
    TIM_CNT(TIM5) = 0u;
    TIM_CNT(TIM2) = 0u;
}

static void set_converters(void) {
    /* 16 bits, idle high, taken at the first edge, 10.5 MHz. */
    SPI_CR1(SPI1) = (1u << 11) | (3u << 8) | (2u << 3) | (1u << 2) | (1u << 1);
    SPI_CR1(SPI1) |= 1u << 6;
    /* 8 bits, idle low, taken at the second edge, 10.5 MHz. */
    SPI_CR1(SPI2) = (3u << 8) | (1u << 3) | (1u << 2) | 1u;
    SPI_CR1(SPI2) |= 1u << 6;
    GPIO_BSRR(GPIOC) = RESET_ADC;
    write_dac(0x0Cu, 4u);      /* both outputs +-10 V */
    write_dac(0x19u, 0x0Cu);   /* thermal shut-down and clamp on; CLR means 0 V */
    write_dac(0x10u, 0x15u);   /* both on, and the reference */
    write_dac(0x04u, 0u);      /* both zero, also once CLR is let go */
    GPIO_BSRR(GPIOC) = LOW(RESET_ADC);
}

static void set_line(void) {
    USART1_BRR = 42u; /* 84 MHz / 42 = 2 Mbit/s */
    USART1_CR3 = (1u << 7) | (1u << 6); /* DMA both ways */
    USART1_CR1 = (1u << 13) | (1u << 4) | (1u << 3) | (1u << 2); /* on, interrupt when silent */
    DMA_PAR(DMA2_STREAM2) = (uint32_t)&USART1_DR;
    DMA_M0AR(DMA2_STREAM2) = (uint32_t)(uintptr_t)received;
    DMA_NDTR(DMA2_STREAM2) = RECEIVED;
    DMA_CR(DMA2_STREAM2) = (4u << 25) | (1u << 10) | (1u << 8) | 1u; /* circular */
    DMA_PAR(DMA2_STREAM7) = (uint32_t)&USART1_DR;
    DMA_M0AR(DMA2_STREAM7) = (uint32_t)(uintptr_t)sending;
    DMA_CR(DMA2_STREAM7) = (4u << 25) | (1u << 10) | (1u << 6) | (1u << 4); /* interrupt at end */
}

static void set_interrupts(void) {
    NVIC_IPR0 &= ~(0xFFu << 8); /* the supply before everything */
    NVIC_IPR7 = (NVIC_IPR7 & ~0xFFu) | PRIORITY_TICK;
    SHPR3 = PRIORITY_TICK << 24;
    NVIC_IPR9 = (NVIC_IPR9 & ~(0xFFu << 8)) | (PRIORITY_LINE << 8);
    NVIC_IPR17 = (NVIC_IPR17 & ~(0xFFu << 16)) | (PRIORITY_LINE << 16);
    EXTI_IMR |= 1u << 16; /* PVD */
    EXTI_RTSR |= 1u << 16;
    NVIC_ISER0 = (1u << IRQ_TIM2) | (1u << IRQ_PVD);
    NVIC_ISER1 = 1u << (IRQ_USART1 - 32u);
    NVIC_ISER2 = 1u << (IRQ_DMA2_STREAM7 - 64u);
    SYST_RVR = SYSTICK - 1u;
    SYST_CVR = 0u;
    SYST_CSR = 7u;
}

static void read_serial(void) {
    static const char DIGITS[] = "0123456789ABCDEF";
    for (uint32_t i = 0u; i < 24u; i++) {
        const uint32_t word = REG(0x1FFF7A10u + 4u * (i / 8u));
        serial[i] = DIGITS[(word >> (28u - 4u * (i % 8u))) & 15u];
    }
}

int main(void);
int main(void) {
    IWDG_KR = 0xCCCCu; /* on, and nothing stops it: 32 kHz / 16 / 100 = 50 ms, by +-40 % */
    IWDG_KR = 0x5555u;
    IWDG_PR = 2u;
    IWDG_RLR = 99u;
    RCC_AHB1ENR |= 7u | (1u << 22); /* ports A to C, DMA2 */
    board_zero();
    output(GPIOC, 6u);
    set_clock();
    RCC_APB1ENR |= 1u | (1u << 1) | (1u << 3) | (1u << 14);
    RCC_APB2ENR |= (1u << 4) | (1u << 12);
    set_pins();
    set_timers();
    set_converters();
    read_serial();
    rig_init(&device, &IDENTITY);
    rig_encoder_init(&encoder, CLOCK, CLOCK / 10u, 0u);
    set_line();
    set_interrupts();
    for (;;) {
        receive();
        rig_poll(&device);
        sleep_unless_busy(&device);
    }
}
