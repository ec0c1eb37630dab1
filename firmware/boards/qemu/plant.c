#include "plant.h"

#include "semihosting.h"

/* To the plant: u32 ticks, 2 x i16 outputs, u8 state, u8 latch, u8 phase, u8 announcements,
 * f32 turns, u32 period, u16 session, u8 runs, u8 0, u16 n,
 * u16 late in ticks, u16 cost of the last tick in steps of SysTick, u16 0, n bytes of the
 * line. */
#define OUT_HEAD 32u
#define OUT_BYTES 1024u
/* From the plant: 3 x i32 analog, i32 count, f32 rate, u8 at the end, u8 carries, u16 n, n bytes
 * of the line. */
#define IN_HEAD 24u
#define IN_BYTES 512u
#define GONE 4u /* status of the emulator */

static int32_t out_pipe;
static int32_t in_pipe;
static uint8_t out[OUT_HEAD + OUT_BYTES];
static uint8_t in[IN_HEAD + IN_BYTES];
static int16_t outputs[RIG_OUTPUTS];
static uint8_t phase;
static uint8_t announcements;
static float turns;
static uint8_t runs;
static uint16_t cost;

static void read_whole(uint8_t *bytes, uint32_t n) {
    uint32_t left = n;
    while (left != 0u) { /* at most n times: each reads a byte or ends */
        const uint32_t before = left;
        left = semihosting_read(in_pipe, bytes + (n - left), left);
        if (left >= before) {
            semihosting_exit(GONE);
        }
    }
}

void plant_connect(struct rig_device *device) {
    out_pipe = semihosting_open("plant.out", 9u, SEMIHOSTING_WRITE);
    in_pipe = semihosting_open("plant.in", 8u, SEMIHOSTING_READ);
    if ((out_pipe < 0) || (in_pipe < 0)) {
        semihosting_exit(GONE);
    }
    plant_exchange(device, 0u, 0u);
}

void plant_exchange(struct rig_device *device, uint32_t ticks, uint64_t late) {
    uint32_t n = 0u;
    while (plant_carries() && (n < OUT_BYTES) && rig_byte_out(device, &out[OUT_HEAD + n])) {
        n++;
    }
    rig_put32(out, ticks);
    rig_put16(out + 4, (uint16_t)outputs[0]);
    rig_put16(out + 6, (uint16_t)outputs[1]);
    out[8] = (uint8_t)device->run.state;
    out[9] = (uint8_t)device->run.latch;
    out[10] = phase;
    out[11] = announcements;
    rig_put32(out + 12, rig_float_bits(turns));
    rig_put32(out + 16, device->run.period);
    rig_put16(out + 20, device->session);
    out[22] = runs;
    out[23] = 0u;
    rig_put16(out + 24, (uint16_t)n);
    rig_put16(out + 26, (uint16_t)((late < 65535u) ? late : 65535u));
    rig_put16(out + 28, cost);
    rig_put16(out + 30, 0u);
    if (semihosting_write(out_pipe, out, OUT_HEAD + n) != 0u) {
        semihosting_exit(GONE);
    }
    read_whole(in, IN_HEAD);
    const uint32_t came = rig_get16(in + 22);
    if (came > IN_BYTES) {
        semihosting_exit(GONE);
    }
    read_whole(in + IN_HEAD, came);
    for (uint32_t i = 0u; i < came; i++) {
        rig_byte_in(device, in[IN_HEAD + i]);
    }
}

void plant_inputs(struct rig_inputs *inputs) {
    for (uint32_t i = 0u; i < RIG_INPUTS; i++) {
        inputs->analog[i] = rig_signed32(rig_get32(in + 4u * i));
    }
    inputs->count = rig_signed32(rig_get32(in + 12));
    inputs->rate = rig_float(rig_get32(in + 16));
    inputs->at_end = in[20] != 0u;
}

void plant_outputs(const int16_t codes[RIG_OUTPUTS]) {
    outputs[0] = codes[0];
    outputs[1] = codes[1];
}

void plant_announce(uint8_t begun, float asked) {
    phase = begun;
    turns = asked;
    announcements++;
}

void plant_cost(uint32_t steps) {
    cost = (uint16_t)((steps < 65535u) ? steps : 65535u);
}

void plant_run(void) {
    runs++;
}

bool plant_carries(void) {
    return in[21] != 0u;
}
