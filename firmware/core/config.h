/* Sizes of a device, in static memory. A board overrides them on the compiler's command line. */
#ifndef RIG_CONFIG_H
#define RIG_CONFIG_H

#ifndef RIG_QUEUE
#define RIG_QUEUE 2048u /* commands held ahead [ticks], a power of two */
#endif

#ifndef RIG_SAMPLES
#define RIG_SAMPLES 512u /* samples that wait for the line, a power of two */
#endif

#ifndef RIG_RECEIVE
#define RIG_RECEIVE 2048u /* bytes received and not looked at yet, a power of two */
#endif

#ifndef RIG_TRANSMIT
#define RIG_TRANSMIT 8192u /* bytes encoded and not sent yet, a power of two */
#endif

#ifndef RIG_PAYLOAD
#define RIG_PAYLOAD 264u /* longest payload that is taken: 64 commands */
#endif

#ifndef RIG_BLOCK
#define RIG_BLOCK 80u /* samples in a frame at most: 20 ms at 4 kHz */
#endif

#endif
