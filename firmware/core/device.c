/* What the main loop does: sessions, requests, the state machine, and what is sent. */
#include "device.h"

#include <string.h>

#define POLL_BYTES 256u /* looked at in one rig_poll */
#define POLL_FRAMES 4u  /* of samples, sent in one rig_poll */
#define LINGER 2u       /* s without a frame, after which sampling ends too */
#define NEWER 0x8000u   /* half of the numbers are newer than a given one, half older */
#define RESERVE 640u    /* bytes of the line's ring that samples leave to answers */
#define LATE 20u        /* thousandths of a second by which a tick may be late */
#define BLOCKS 50u      /* blocks of samples a second that nobody waits for */
#define TEXT 32u

_Static_assert((RIG_QUEUE & (RIG_QUEUE - 1u)) == 0u, "RIG_QUEUE is no power of two");
_Static_assert((RIG_SAMPLES & (RIG_SAMPLES - 1u)) == 0u, "RIG_SAMPLES is no power of two");
_Static_assert((RIG_RECEIVE & (RIG_RECEIVE - 1u)) == 0u, "RIG_RECEIVE is no power of two");
_Static_assert((RIG_TRANSMIT & (RIG_TRANSMIT - 1u)) == 0u, "RIG_TRANSMIT is no power of two");
_Static_assert((RIG_QUEUE >= 16u) && (RIG_QUEUE <= 1048576u), "RIG_QUEUE: 16 to 1048576");
_Static_assert((RIG_PAYLOAD >= 64u) && (RIG_PAYLOAD <= 4096u), "RIG_PAYLOAD: 64 to 4096");
_Static_assert(RIG_LONGEST_OUT <= 4096u, "RIG_BLOCK: more than a frame holds");
_Static_assert(RIG_TRANSMIT >= RIG_LONGEST_OUT + RIG_LONGEST_OUT / 254u + 16u + RESERVE,
               "RIG_TRANSMIT: less than a frame of samples");

static const uint8_t MAGIC[4] = {0x48u, 0x52u, 0x49u, 0x47u}; /* HRIG */

/* The run as it is at this instant. */
struct moment {
    enum rig_state state;
    enum rig_latch latch;
    uint32_t tick;
    uint32_t overflow;
};

static struct moment look(const struct rig_device *device) {
    const uint32_t token = board_lock();
    const struct moment now = {device->run.state, device->run.latch, device->run.tick,
                               device->run.overflow};
    board_unlock(token);
    return now;
}

/* --- what is sent --------------------------------------------------------------------------- */

static bool send(struct rig_device *device, enum rig_type type, uint16_t session, uint16_t number,
                 uint32_t length, uint32_t reserve) {
    const struct rig_frame frame = {.type = (uint8_t)type,
                                    .session = session,
                                    .number = number,
                                    .length = (uint16_t)length,
                                    .payload = NULL};
    const bool sent = rig_encode(&device->waiting, device->body, &frame, reserve);
    if (sent) {
        board_transmit();
    }
    return sent;
}

static uint8_t *payload(struct rig_device *device) {
    return device->body + RIG_HEADER_SIZE;
}

static void pack_status(const struct rig_device *device, uint8_t *at) {
    const struct moment now = look(device);
    rig_put16(at, device->number);
    at[2] = (uint8_t)now.state;
    at[3] = (uint8_t)now.latch;
    rig_put32(at + 4, now.tick);
    rig_put32(at + 8, device->commands.until);
    rig_put32(at + 12, rig_commands_credit(now.tick));
    rig_put32(at + 16, device->commands.late);
    rig_put32(at + 20, now.overflow);
}

static void send_status(struct rig_device *device) {
    pack_status(device, payload(device));
    if (send(device, RIG_STATUS, device->session, device->sequence, RIG_STATUS_SIZE, 0u)) {
        device->sequence++;
    }
}

static void send_answer(struct rig_device *device, const struct rig_frame *request,
                        const uint8_t answer[RIG_REPLY_SIZE]) {
    (void)memcpy(payload(device), answer, RIG_REPLY_SIZE);
    (void)send(device, RIG_REPLY, request->session, request->number, RIG_REPLY_SIZE, 0u);
}

static void pack_answer(const struct rig_device *device, uint8_t type, enum rig_result result,
                        uint8_t answer[RIG_REPLY_SIZE]) {
    answer[0] = type;
    answer[1] = (uint8_t)result;
    rig_put16(answer + 2, 0u);
    pack_status(device, answer + 4);
}

static void put_text(uint8_t *at, const char *text, uint32_t size) {
    bool ended = false;
    for (uint32_t i = 0u; i < size; i++) {
        ended = ended || (text[i] == '\0') || (i + 1u == size);
        at[i] = ended ? 0u : (uint8_t)text[i];
    }
}

static void send_welcome(struct rig_device *device, const struct rig_frame *hello) {
    const struct rig_identity *identity = device->identity;
    uint8_t *at = payload(device);
    (void)memset(at, 0, RIG_WELCOME_SIZE);
    (void)memcpy(at, MAGIC, sizeof MAGIC);
    rig_put16(at + 4, RIG_VERSION);
    at[6] = (uint8_t)RIG_CHANNELS;
    at[7] = (uint8_t)look(device).latch;
    rig_put32(at + 8, identity->clock);
    rig_put32(at + 12, rig_float_bits((float)identity->clock / (float)identity->shortest_period));
    rig_put32(at + 16, RIG_QUEUE);
    rig_put16(at + 20, (uint16_t)RIG_PAYLOAD);
    rig_put16(at + 22, identity->watchdog_default);
    rig_put16(at + 24, identity->watchdog_longest);
    put_text(at + 28, identity->device, TEXT);
    put_text(at + 60, identity->firmware, TEXT);
    put_text(at + 92, identity->serial, TEXT);
    for (uint32_t i = 0u; i < RIG_CHANNELS; i++) {
        const struct rig_channel *channel = &identity->channels[i];
        uint8_t *row = at + RIG_WELCOME_HEAD + i * RIG_CHANNEL_SIZE;
        put_text(row, channel->name, 16u);
        put_text(row + 16, channel->unit, 8u);
        rig_put64(row + 24, rig_double_bits(channel->scale));
        rig_put64(row + 32, rig_double_bits(channel->offset));
        rig_put64(row + 40, rig_double_bits(channel->low));
        rig_put64(row + 48, rig_double_bits(channel->high));
    }
    (void)send(device, RIG_WELCOME, hello->session, hello->number, RIG_WELCOME_SIZE, 0u);
}

/* Consecutive samples of those that wait, in one frame; how many were sent. */
static uint32_t send_block(struct rig_device *device, uint32_t waiting) {
    const struct rig_samples *samples = &device->samples;
    const uint32_t first = rig_samples_at(samples, 0u)->tick;
    uint8_t *at = payload(device);
    uint32_t n = 0u;
    for (; (n < waiting) && (n < RIG_BLOCK); n++) {
        const struct rig_sample *sample = rig_samples_at(samples, n);
        if (sample->tick != first + n) {
            break; /* there was no room for those between */
        }
        rig_sample_pack(sample, at + RIG_SAMPLES_HEAD + n * RIG_SAMPLE_SIZE);
    }
    pack_status(device, at);
    rig_put32(at + 24, first);
    rig_put16(at + 28, (uint16_t)n);
    rig_put16(at + 30, 0u);
    rig_put64(at + 32, device->run.origin + (uint64_t)first * device->run.period);
    const uint32_t length = RIG_SAMPLES_HEAD + n * RIG_SAMPLE_SIZE;
    if (!send(device, RIG_SAMPLES_TYPE, device->session, device->sequence, length, RESERVE)) {
        return 0u;
    }
    device->sequence++;
    rig_samples_drop(&device->samples, n);
    return n;
}

/* How many samples make a block: one where the host may be waiting to answer it. */
static uint32_t wanted(const struct rig_device *device) {
    const struct moment now = look(device);
    const uint32_t until = device->commands.until;
    const uint32_t ahead = (until > now.tick) ? until - now.tick : 0u;
    const bool hurry = device->commands.closed && (now.latch == RIG_LATCH_NONE);
    return (hurry && (ahead < device->block)) ? 1u : device->block;
}

static void send_samples(struct rig_device *device) {
    const uint32_t token = board_lock();
    device->flushing = device->flushing || device->run.urgent;
    device->run.urgent = false;
    board_unlock(token);
    for (uint32_t i = 0u; i < POLL_FRAMES; i++) {
        const uint32_t waiting = rig_samples_waiting(&device->samples);
        if (waiting == 0u) {
            device->flushing = false;
        }
        if ((waiting == 0u) || (!device->flushing && (waiting < wanted(device))) ||
            (send_block(device, waiting) == 0u)) {
            return;
        }
    }
}

/* --- the state machine ---------------------------------------------------------------------- */

static void end_run(struct rig_device *device) {
    const uint32_t token = board_lock();
    board_timer_stop();
    board_zero();
    device->run.state = RIG_IDLE;
    device->run.urgent = false;
    board_unlock(token);
    device->flushing = false;
    rig_samples_clear(&device->samples);
}

static void set_latch(struct rig_device *device, enum rig_latch latch) {
    const uint32_t token = board_lock();
    device->run.latch = latch;
    board_unlock(token);
}

static void feed(struct rig_device *device) {
    const uint32_t token = board_lock();
    rig_watchdog_feed(&device->run.watchdog, board_clock());
    board_unlock(token);
}

/* No run, no counts. */
static void forget_run(struct rig_device *device) {
    rig_commands_restart(&device->commands, true);
    device->number = 0u;
    device->run.tick = 0u;
    device->run.overflow = 0u;
#if RIG_HAS_LAW
    rig_law_clear(&device->run.law);
    for (uint32_t i = 0u; i < RIG_OUTPUTS; i++) {
        device->run.law.per_volt[i] = (float)(1.0 / device->identity->channels[RIG_INPUTS + i].scale);
    }
#endif
}

static enum rig_result on_start(struct rig_device *device, const struct rig_frame *frame) {
    const struct rig_identity *identity = device->identity;
    struct rig_run *run = &device->run;
    if (frame->length != RIG_START_SIZE) {
        return RIG_BAD_VALUE;
    }
    const uint8_t *at = frame->payload;
    const uint8_t mode = at[2];
    const uint32_t period = rig_get32(at + 4);
    const uint16_t watchdog = rig_get16(at + 8);
    struct rig_guard guard;
    const bool legal = rig_guard_read(&guard, at, identity->lowest, identity->highest);
    if (!legal || (mode > 1u) || (period == 0u) || (period < identity->shortest_period) ||
        (watchdog > identity->watchdog_longest)) {
        return RIG_BAD_VALUE;
    }
    if (look(device).latch == RIG_LATCH_WATCHDOG) {
        return RIG_LATCHED;
    }
    end_run(device);
    forget_run(device);
    device->commands.closed = mode == 1u;
    device->number = rig_get16(at);
    const uint32_t block = (identity->clock / BLOCKS + period / 2u) / period;
    device->block = (block < 1u) ? 1u : ((block > RIG_BLOCK) ? RIG_BLOCK : block);
    run->period = period;
    run->last[0] = 0;
    run->last[1] = 0;
    run->guard = guard;
    rig_watchdog_set(&run->watchdog, (watchdog != 0u) ? watchdog : identity->watchdog_default,
                     identity->clock);
    const uint32_t token = board_lock();
    run->latch = RIG_LATCH_NONE;
    run->state = RIG_ARMED;
    board_unlock(token);
    return RIG_OK;
}

static enum rig_result on_go(struct rig_device *device, const struct rig_frame *frame) {
    struct rig_run *run = &device->run;
    if (frame->length != RIG_RUN_SIZE) {
        return RIG_BAD_VALUE;
    }
    const enum rig_state state = look(device).state;
    if ((state == RIG_IDLE) || (rig_get16(frame->payload) != device->number)) {
        return RIG_WRONG_STATE;
    }
    if (state == RIG_ARMED) {
        const uint32_t token = board_lock();
        run->origin = board_timer_start(run->period);
        rig_watchdog_feed(&run->watchdog, run->origin);
        run->state = RIG_RUNNING;
        board_unlock(token);
    }
    return RIG_OK;
}

static enum rig_result on_stop(struct rig_device *device, const struct rig_frame *frame) {
    if (frame->length != RIG_RUN_SIZE) {
        return RIG_BAD_VALUE;
    }
    if (rig_get16(frame->payload) == device->number) {
        end_run(device);
    }
    return RIG_OK;
}

static enum rig_result on_safe(struct rig_device *device, const struct rig_frame *frame) {
    if (frame->length != 0u) {
        return RIG_BAD_VALUE;
    }
    const uint32_t token = board_lock();
    board_zero();
    if (device->run.latch == RIG_LATCH_NONE) {
        device->run.latch = RIG_LATCH_SAFE;
    }
    device->run.urgent = true;
    board_unlock(token);
    return RIG_OK;
}

static enum rig_result on_clear(struct rig_device *device, const struct rig_frame *frame) {
    if (frame->length != 0u) {
        return RIG_BAD_VALUE;
    }
    end_run(device);
    set_latch(device, RIG_LATCH_NONE);
    return RIG_OK;
}

static enum rig_result on_announce(const struct rig_frame *frame) {
    if (frame->length != RIG_ANNOUNCE_SIZE) {
        return RIG_BAD_VALUE;
    }
    board_announce(frame->payload[0], rig_float(rig_get32(frame->payload + 4)));
    return RIG_OK;
}

#if RIG_HAS_LAW
/* Nothing is switched in a tick that has passed: commands would be taken for references. */
static enum rig_result on_law(struct rig_device *device, const struct rig_frame *frame) {
    struct rig_run *run = &device->run;
    struct rig_law_order order;
    if (frame->length != RIG_LAW_SIZE) {
        return RIG_BAD_VALUE;
    }
    if ((look(device).state == RIG_IDLE) || (rig_get16(frame->payload) != device->number)) {
        return RIG_WRONG_STATE;
    }
    if (!rig_law_read(&order, frame->payload, run->period, device->identity->clock)) {
        return RIG_BAD_VALUE;
    }
    const uint32_t token = board_lock();
    const bool ahead = order.first >= run->tick;
    if (ahead) {
        run->law.order = order;
        run->law.waits = true;
    }
    board_unlock(token);
    return ahead ? RIG_OK : RIG_WRONG_STATE;
}
#endif

static enum rig_result carry_out(struct rig_device *device, const struct rig_frame *frame) {
    enum rig_result result = RIG_UNKNOWN;
    switch (frame->type) {
    case RIG_START:
        result = on_start(device, frame);
        break;
    case RIG_GO:
        result = on_go(device, frame);
        break;
    case RIG_STOP:
        result = on_stop(device, frame);
        break;
    case RIG_SAFE:
        result = on_safe(device, frame);
        break;
    case RIG_CLEAR:
        result = on_clear(device, frame);
        break;
    case RIG_ANNOUNCE:
        result = on_announce(frame);
        break;
#if RIG_HAS_LAW
    case RIG_LAW:
        result = on_law(device, frame);
        break;
#endif
    default:
        break;
    }
    return result;
}

/* Once, however often it comes. */
static void on_request(struct rig_device *device, const struct rig_frame *frame) {
    const uint16_t ahead = (uint16_t)(frame->number - device->answered);
    if (device->has_answered && (ahead >= NEWER)) {
        return; /* overtaken */
    }
    if (!device->has_answered || (ahead != 0u)) {
        const enum rig_result result = carry_out(device, frame);
        pack_answer(device, frame->type, result, device->answer);
        device->answered = frame->number;
        device->has_answered = true;
    }
    send_answer(device, frame, device->answer);
}

static void on_hello(struct rig_device *device, const struct rig_frame *frame) {
    if ((frame->session == 0u) || (frame->length < RIG_HELLO_HEAD) ||
        (memcmp(frame->payload, MAGIC, sizeof MAGIC) != 0)) {
        return;
    }
    if (rig_get16(frame->payload + 4) == RIG_VERSION) {
        if (frame->session != device->session) {
            end_run(device);
            forget_run(device);
            const uint32_t token = board_lock();
            if (device->run.latch != RIG_LATCH_WATCHDOG) {
                device->run.latch = RIG_LATCH_NONE;
            }
            rig_bytes_clear(&device->waiting);
            board_unlock(token);
            device->session = frame->session;
            device->has_answered = false;
        }
        feed(device);
    }
    send_welcome(device, frame);
}

static void on_commands(struct rig_device *device, const struct rig_frame *frame) {
    if (frame->length < RIG_COMMANDS_HEAD + RIG_COMMAND_SIZE) {
        return;
    }
    const uint8_t *at = frame->payload;
    const uint32_t n = rig_get16(at + 2);
    const struct moment now = look(device);
    if ((frame->length != RIG_COMMANDS_HEAD + n * RIG_COMMAND_SIZE) || (now.state == RIG_IDLE) ||
        (rig_get16(at) != device->number)) {
        return;
    }
    const bool in_order = rig_commands_put(&device->commands, now.tick, rig_get32(at + 4), n,
                                           at + RIG_COMMANDS_HEAD);
    if (!in_order || (now.state == RIG_ARMED)) {
        send_status(device);
    }
}

static void on_ping(struct rig_device *device, const struct rig_frame *frame, uint64_t heard) {
    if (frame->length != RIG_PING_SIZE) {
        return;
    }
    uint8_t *at = payload(device);
    (void)memcpy(at, frame->payload, 8);
    rig_put64(at + 8, heard);
    pack_status(device, at + 24);
    rig_put64(at + 16, board_clock());
    (void)send(device, RIG_PONG, frame->session, frame->number, RIG_PONG_SIZE, 0u);
}

static void on_frame(struct rig_device *device, const struct rig_frame *frame) {
    const uint64_t now = board_clock();
    if (frame->type == (uint8_t)RIG_HELLO) {
        on_hello(device, frame);
    } else if ((device->session == 0u) || (frame->session != device->session)) {
        uint8_t answer[RIG_REPLY_SIZE];
        pack_answer(device, frame->type, RIG_NO_SESSION, answer);
        send_answer(device, frame, answer);
    } else {
        feed(device);
        if (frame->type == (uint8_t)RIG_COMMANDS) {
            on_commands(device, frame);
        } else if (frame->type == (uint8_t)RIG_PING) {
            on_ping(device, frame, now);
        } else {
            on_request(device, frame);
        }
    }
}

/* --- the main loop -------------------------------------------------------------------------- */

static void leave_orphan(struct rig_device *device) {
    const uint32_t token = board_lock();
    const struct rig_run *run = &device->run;
    const bool orphaned =
        (run->state == RIG_RUNNING) &&
        rig_watchdog_silent(&run->watchdog, board_clock(),
                            (uint64_t)LINGER * device->identity->clock);
    board_unlock(token);
    if (orphaned) {
        end_run(device);
    }
}

/* A timer that has stopped, like a main loop that has, ends in a reset. */
static void feed_board(const struct rig_device *device) {
    const struct rig_run *run = &device->run;
    const uint32_t token = board_lock();
    const uint64_t due = run->origin + (uint64_t)run->tick * run->period;
    const uint64_t patience = (uint64_t)device->identity->clock * LATE / 1000u;
    const bool ticks = (run->state != RIG_RUNNING) || (board_clock() <= due + patience);
    board_unlock(token);
    if (ticks) {
        board_feed();
    }
}

void rig_init(struct rig_device *device, const struct rig_identity *identity) {
    (void)memset(device, 0, sizeof *device);
    device->identity = identity;
    device->block = 1u;
    rig_bytes_init(&device->received, device->received_bytes, RIG_RECEIVE);
    rig_bytes_init(&device->waiting, device->waiting_bytes, RIG_TRANSMIT);
    rig_decoder_reset(&device->decoder);
    rig_samples_clear(&device->samples);
    forget_run(device);
}

void rig_poll(struct rig_device *device) {
    struct rig_frame frame;
    uint8_t byte = 0u;
    for (uint32_t i = 0u; (i < POLL_BYTES) && rig_bytes_get(&device->received, &byte); i++) {
        if (rig_decode(&device->decoder, byte, &frame)) {
            on_frame(device, &frame);
        }
    }
    leave_orphan(device);
    device->seen = rig_samples_taken(&device->samples);
    send_samples(device);
    feed_board(device);
}

bool rig_is_busy(const struct rig_device *device) {
    return rig_bytes_any(&device->received) || device->run.urgent ||
           (rig_samples_taken(&device->samples) != device->seen);
}
