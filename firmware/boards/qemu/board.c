/* QEMU's netduinoplus2: an STM32F405 without converters, whose plant is outside.
 *
 * TIM2 is the clock (QEMU lets it count at 1 GHz before the prescaler), SysTick the tick's interrupt,
 * once a period or, of a long one, once a part of it. Where the emulator is late, and QEMU's SysTick
 * is now and then by a period, also in virtual time, ticks follow each other at once; their number
 * and their order stay right. There is no independent watchdog. */
#include "board.h"

#include "device.h"
#include "plant.h"
#include "semihosting.h"
#include "sleep.h"

#define REG(ADDRESS) (*(volatile uint32_t *)(ADDRESS))
#define RCC_APB1ENR REG(0x40023840u)
#define RCC_APB2ENR REG(0x40023844u)
#define TIM2_CR1 REG(0x40000000u)
#define TIM2_EGR REG(0x40000014u)
#define TIM2_CNT REG(0x40000024u)
#define TIM2_PSC REG(0x40000028u)
#define TIM2_ARR REG(0x4000002Cu)
#define USART1_SR REG(0x40011000u)
#define USART1_DR REG(0x40011004u)
#define USART1_CR1 REG(0x4001100Cu)
#define SYST_CSR REG(0xE000E010u)
#define SYST_RVR REG(0xE000E014u)
#define SYST_CVR REG(0xE000E018u)
#define NVIC_ISER1 REG(0xE000E104u)
#define NVIC_IPR9 REG(0xE000E424u)
#define ICSR REG(0xE000ED04u)
#define PENDSTSET (1u << 26)

#define CLOCK 1000000u
#define CORE_CLOCK 168u /* per tick of CLOCK */
#define WATCH 1000u     /* ticks between two looks, at most */
#define IDLE_REAL 10000u /* ticks between two exchanges while nothing runs */
#define CATCH_UP 4u     /* ticks that follow each other at once, at most */
#define PARTS 128u      /* of a period, at most: SysTick counts 24 bits */
#define RXNE (1u << 5)
#define STEP (20.0 / 65536.0) /* V */

static struct rig_device device;
static uint32_t clock_high;
static uint32_t clock_low;
static uint32_t period; /* 0: the timer stands still */
static uint64_t due;
static uint64_t exchanged;

#define INPUT(NAME) {NAME, "V", STEP, 0.0, -32768 * STEP, 32767 * STEP}
static const struct rig_identity IDENTITY = {
    .device = "board in QEMU",
    .firmware = RIG_FIRMWARE,
    .serial = "netduinoplus2",
    .clock = CLOCK,
    .shortest_period = 250u,
    .watchdog_default = 100u,
    .watchdog_longest = 10000u,
    .lowest = {-32768, -32768},
    .highest = {32767, 32767},
    .channels = {INPUT("current_motor"), INPUT("current_brake"), INPUT("torque"), INPUT("motor"),
                 INPUT("brake"),
                 {"encoder", "count", 1.0, 0.0, -2147483648.0, 2147483647.0}},
};

uint64_t board_clock(void) {
    const uint32_t token = board_lock();
    const uint32_t low = TIM2_CNT;
    if (low < clock_low) {
        clock_high++;
    }
    clock_low = low;
    const uint64_t now = ((uint64_t)clock_high << 32) | low;
    board_unlock(token);
    return now;
}

void board_latch(struct rig_inputs *inputs) {
    plant_inputs(inputs);
}

void board_apply(const int16_t codes[RIG_OUTPUTS], int16_t applied[RIG_OUTPUTS]) {
    plant_outputs(codes);
    applied[0] = codes[0];
    applied[1] = codes[1];
}

void board_zero(void) {
    static const int16_t zero[RIG_OUTPUTS] = {0, 0};
    plant_outputs(zero);
}

static void set_systick(uint32_t steps) {
    SYST_RVR = steps - 1u;
    SYST_CVR = 0u;
}

uint64_t board_timer_start(uint32_t ticks) {
    /* A whole part of the period, of a watch at most; where there is none, the tick comes with the
     * first interrupt after its time. */
    uint32_t steps = WATCH * CORE_CLOCK;
    const uint32_t least = (ticks + WATCH - 1u) / WATCH;
    for (uint32_t n = least; n < least + PARTS; n++) {
        const uint64_t whole = (uint64_t)ticks * CORE_CLOCK;
        if (whole % n == 0u) {
            steps = (uint32_t)(whole / n);
            break;
        }
    }
    plant_run();
    due = board_clock();
    period = ticks;
    set_systick(steps);
    ICSR = PENDSTSET;
    return due;
}

void board_timer_stop(void) {
    period = 0u;
    set_systick(WATCH * CORE_CLOCK);
}

void board_transmit(void) {
    uint8_t byte;
    for (uint32_t i = 0u; (i < RIG_TRANSMIT) && !plant_carries() && rig_byte_out(&device, &byte);
         i++) {
        USART1_DR = byte; /* QEMU takes it at once */
    }
}

void board_feed(void) {
}

void board_announce(uint8_t phase, float turns) {
    plant_announce(phase, turns);
}

static void exchange_at(uint64_t instant) {
    plant_exchange(&device, (uint32_t)(instant - exchanged), board_clock() - instant);
    exchanged = instant;
}

void systick_handler(void);
void systick_handler(void) {
    uint64_t now = board_clock();
    bool ticked = false;
    for (uint32_t i = 0u; (i < CATCH_UP) && (period != 0u) && (now >= due); i++) {
        exchange_at(due);
        const uint32_t before = SYST_CVR; /* counts down */
        rig_on_tick(&device);
        const uint32_t after = SYST_CVR;
        /* cppcheck-suppress knownConditionTrueFalse; it counts meanwhile */
        plant_cost(before - after + ((after > before) ? SYST_RVR + 1u : 0u));
        due += period;
        ticked = true;
    }
    if (!ticked) {
        rig_on_watch(&device);
    }
    now = board_clock();
    if ((period == 0u) && (now - exchanged >= (plant_carries() ? WATCH : IDLE_REAL))) {
        exchange_at(now);
    }
}

void usart1_handler(void);
void usart1_handler(void) {
    if ((USART1_SR & RXNE) != 0u) {
        rig_byte_in(&device, (uint8_t)(USART1_DR & 0xFFu));
    }
}

static void set_up(void) {
    RCC_APB1ENR |= 1u;        /* TIM2 */
    RCC_APB2ENR |= 1u << 4;   /* USART1 */
    TIM2_PSC = 999u;
    TIM2_ARR = 0xFFFFFFFFu;
    TIM2_EGR = 1u;
    TIM2_CR1 = 1u;
    USART1_CR1 = (1u << 13) | (1u << 5) | (1u << 3) | (1u << 2); /* UE, RXNEIE, TE, RE */
    NVIC_IPR9 |= 0x80u << 8;  /* the line below the tick */
    NVIC_ISER1 = 1u << (37 - 32);
    set_systick(WATCH * CORE_CLOCK);
    SYST_CSR = 7u;
}

int main(void);
int main(void) {
    rig_init(&device, &IDENTITY);
    const uint32_t token = board_lock();
    set_up();
    plant_connect(&device);
    exchanged = board_clock();
    board_unlock(token);
    for (;;) {
        rig_poll(&device);
        sleep_unless_busy(&device);
    }
}
