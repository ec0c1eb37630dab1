/* What every Cortex-M does before main; a board's startup.c has the vectors. */
#ifndef CORTEX_M_RESET_H
#define CORTEX_M_RESET_H

#include <stdint.h>

typedef void (*vector)(void);

extern uint32_t stack_top; /* of board.ld */

/* The vector of reset: memory as C wants it, then main. */
void reset_handler(void);

/* The board's own, the vector of whatever nobody asked for: outputs at zero, and no return. */
void fault_handler(void);

#endif
