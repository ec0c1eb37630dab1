/* Commands by tick, in a ring with a slot per tick: written by the main loop, played by the tick.
 *
 * A slot belongs to its tick by its owner, which is written last and read first, so that neither
 * side waits for the other. */
#ifndef RIG_COMMANDS_H
#define RIG_COMMANDS_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "config.h"
#include "wire.h"

struct rig_slot {
    atomic_uint_least32_t codes; /* both, so that a reader never sees one old and one new */
    atomic_uint_least32_t owner;
};

struct rig_commands {
    struct rig_slot slots[RIG_QUEUE];
    uint32_t until; /* tick after the last command in order; after the latest in closed loop */
    uint32_t late;  /* commands that came after their tick, closed loop */
    bool closed;
};

/* Forget everything; the next tick is 0. Main, while no tick comes; RIG_QUEUE steps. */
void rig_commands_restart(struct rig_commands *commands, bool closed);

/* First tick for which there is no slot yet. Any context; constant time. */
uint32_t rig_commands_credit(uint32_t tick);

/* Keep n commands (i16 motor, i16 brake, as on the wire) for `first` on, while `tick` is the next
 * to be played; false for a gap before them in open loop. Main; n steps. */
bool rig_commands_put(struct rig_commands *commands, uint32_t tick, uint32_t first, uint32_t n,
                      const uint8_t *codes);

/* The command of a tick; false if there is none. Interrupt; constant time. */
bool rig_commands_take(struct rig_commands *commands, uint32_t tick, int16_t codes[RIG_OUTPUTS]);

#endif
