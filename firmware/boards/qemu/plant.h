/* The plant outside of the emulator, in lockstep: one exchange a tick, and some between runs. */
#ifndef QEMU_PLANT_H
#define QEMU_PLANT_H

#include <stdbool.h>

#include "device.h"

/* Open the pipes plant.out and plant.in of the emulator's folder, and make the first exchange. */
void plant_connect(struct rig_device *device);

/* Outputs as they have been for `ticks` of the clock go out, inputs as they are now come in. Where
 * the plant carries the line as well, so do its bytes. late: by how many ticks of the clock this
 * comes after its time. Interrupt (tick). Ends the emulator where
 * the plant has gone. */
void plant_exchange(struct rig_device *device, uint32_t ticks, uint64_t late);

/* Inputs of the last exchange. Interrupt (tick). */
void plant_inputs(struct rig_inputs *inputs);

/* Outputs from now on. Any context, interrupts locked or not. */
void plant_outputs(const int16_t codes[RIG_OUTPUTS]);

/* A phase begins. Main. */
void plant_announce(uint8_t phase, float turns);

/* What rig_on_tick took, in steps of SysTick. Interrupt (tick). */
void plant_cost(uint32_t steps);

/* A run begins. Main, interrupts locked. */
void plant_run(void);

/* Whether the plant carries the line, in place of the USART. Any context. */
bool plant_carries(void);

#endif
