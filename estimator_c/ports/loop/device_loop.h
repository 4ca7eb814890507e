/// device_loop: the loop that every port runs: bytes in, device, bytes out, sleep. And what a port must give for it.
///
/// A port is four functions and a main() that calls device_loop(). estimator_c/README.md has an example.
/// Distributed under the terms of the MIT License.

#ifndef DEVICE_LOOP_H_INCLUDED
#define DEVICE_LOOP_H_INCLUDED

#include "device_line.h"

#ifdef __cplusplus
extern "C" {
#endif

/// The least that each of the two buffers must have: a CAN frame.
#define DEVICE_LOOP_LEAST 72U

/// Bytes that can wait between the port and the device. The port may hold more, of which the device knows nothing: it tells
/// the harness that so many blocks can wait as DEVICE_LOOP_INPUT_SIZE has room for, 255 at most.
#ifndef DEVICE_LOOP_INPUT_SIZE
#define DEVICE_LOOP_INPUT_SIZE 4096U
#endif

/// A burst of answers; when it is full the line waits. When it is nearly full, no answers are made.
#ifndef DEVICE_LOOP_OUTPUT_SIZE
#define DEVICE_LOOP_OUTPUT_SIZE 4096U
#endif

// ---- what the port gives

/// Another number after every boot: by it the harness notices a reset. A true random number, a counter in memory that
/// outlives a reset, or, if there is neither, the time since power-on when the first byte came.
uint32_t port_boot_nonce(void);

/// Takes at most n of the bytes that have come, and never waits: 0 if there are none. Adds to *lost how many came that it
/// had to drop.
size_t port_receive(uint8_t* bytes, size_t n, uint32_t* lost);

/// Sends what can be sent without waiting; returns how many bytes that were.
size_t port_transmit(const uint8_t* bytes, size_t n);

/// Sleeps until there is a byte to receive, if wants_input, or room to transmit, if has_output. May return early, but must not
/// miss a byte that came just before. False ends the loop: the line is gone.
bool port_idle(bool wants_input, bool has_output);

// ---- what it gets

/// Serves a line of that kind until port_idle() says that it is over. `state` is the shell's: a serial_device_t for serial_line,
/// and so on. `firmware_id` is one of ANALOGRIG_FIRMWARE_FIRMWARE_ID_..._CHOICE, `catalogue_hash` is
/// ANALOGRIG_CATALOGUE_HASH. One line at a time: the buffers are static.
void device_loop(const device_line_t* line, void* state, uint8_t firmware_id, uint32_t catalogue_hash);

#ifdef __cplusplus
}
#endif

#endif  // DEVICE_LOOP_H_INCLUDED
