# QEMU hands over a byte an interrupt, some ten thousand a second: a short queue is filled in time.
SIZES := -DRIG_QUEUE=512u -DRIG_SAMPLES=512u
SHARED := $(addprefix boards/cortex_m/,reset.c lock.c sleep.c)
