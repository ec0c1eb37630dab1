# Text 24 kB, RAM 96 kB at most: board.ld refuses more.
SIZES := -DRIG_QUEUE=4096u -DRIG_SAMPLES=512u -DRIG_PAYLOAD=1032u
SHARED := $(addprefix boards/cortex_m/,reset.c sleep.c)
