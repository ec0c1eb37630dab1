#include "commands.h"

#define NOBODY 0xFFFFFFFFu /* no run gets to this tick */

void rig_commands_restart(struct rig_commands *commands, bool closed) {
    for (uint32_t i = 0u; i < RIG_QUEUE; i++) {
        atomic_store_explicit(&commands->slots[i].owner, NOBODY, memory_order_relaxed);
    }
    commands->until = 0u;
    commands->late = 0u;
    commands->closed = closed;
}

uint32_t rig_commands_credit(uint32_t tick) {
    return (tick > NOBODY - RIG_QUEUE) ? NOBODY : tick + RIG_QUEUE;
}

bool rig_commands_put(struct rig_commands *commands, uint32_t tick, uint32_t first, uint32_t n,
                      const uint8_t *codes) {
    const uint32_t credit = rig_commands_credit(tick);
    if (!commands->closed && (first > commands->until)) {
        return false;
    }
    for (uint32_t i = 0u; (i < n) && (first < credit) && (i < credit - first); i++) {
        const uint32_t owner = first + i;
        if (owner >= tick) {
            struct rig_slot *slot = &commands->slots[owner % RIG_QUEUE];
            const uint32_t pair = rig_get32(codes + i * RIG_COMMAND_SIZE);
            atomic_store_explicit(&slot->codes, pair, memory_order_relaxed);
            atomic_store_explicit(&slot->owner, owner, memory_order_release);
        } else if (commands->closed) {
            commands->late++;
        } else {
            /* Played already; it came a second time. */
        }
        if (owner >= commands->until) {
            commands->until = owner + 1u;
        }
    }
    return true;
}

bool rig_commands_take(struct rig_commands *commands, uint32_t tick, int16_t codes[RIG_OUTPUTS]) {
    struct rig_slot *slot = &commands->slots[tick % RIG_QUEUE];
    if (atomic_load_explicit(&slot->owner, memory_order_acquire) != tick) {
        return false;
    }
    const uint32_t pair = (uint32_t)atomic_load_explicit(&slot->codes, memory_order_relaxed);
    codes[0] = rig_signed16((uint16_t)(pair & 0xFFFFu));
    codes[1] = rig_signed16((uint16_t)(pair >> 16));
    return true;
}
