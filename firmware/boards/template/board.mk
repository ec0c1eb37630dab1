# Sizes of the rings (core/config.h), for a microcontroller with more or less memory: the queue takes
# 8 bytes a command, the samples 32 each.
SIZES := -DRIG_QUEUE=1024u -DRIG_SAMPLES=256u

# Of any Cortex-M: what comes before main, board_lock by PRIMASK, and the main loop's sleep. Without
# reset.c where your vendor's startup code has a reset_handler, without lock.c where board.c locks.
SHARED := $(addprefix boards/cortex_m/,reset.c lock.c sleep.c)

# Another processor than a Cortex-M4 with floating point:
# TARGET := -mcpu=cortex-m0plus -mthumb
