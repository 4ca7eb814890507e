// SPDX-License-Identifier: MIT
/// device_loop: the loop of every port (receive, run the device, transmit, sleep), and the functions that a port
/// provides.
///
/// A port is four functions and a main() that calls device_loop(). Example:
/// harness/docs/howto/port-to-a-board.md.
/// Distributed under the terms of the MIT License.

#ifndef DEVICE_LOOP_H_INCLUDED
#define DEVICE_LOOP_H_INCLUDED

#include "device_line.h"

#ifdef __cplusplus
extern "C" {
#endif

/// Minimum size of each of the two buffers: a CAN frame.
#define DEVICE_LOOP_LEAST 72U

/// Size of the input buffer in bytes. Firmware reports to the harness how many SampleBlocks fit it, at most 255.
/// Additional buffers of the port do not count.
#ifndef DEVICE_LOOP_INPUT_SIZE
#define DEVICE_LOOP_INPUT_SIZE 4096U
#endif

/// Size of the output buffer in bytes: a burst of answers. Without room for an answer, the device pauses.
#ifndef DEVICE_LOOP_OUTPUT_SIZE
#define DEVICE_LOOP_OUTPUT_SIZE 4096U
#endif

// ---- functions that the port provides

/// Return a different number after every boot, by which the harness detects a reset: a random number, a counter in
/// memory that survives a reset, or at least the time from power-on to the first byte.
uint32_t port_boot_nonce(void);

/// Receive at most n bytes without waiting. Return their number, which may be 0. Add the number of bytes lost to *lost.
size_t port_receive(uint8_t* bytes, size_t n, uint32_t* lost);

/// Transmit as many bytes as possible without waiting. Return their number.
size_t port_transmit(const uint8_t* bytes, size_t n);

/// Sleep until there is a byte to receive, if wants_input, or room to transmit, if has_output. It may return early,
/// but must not miss a byte that arrived just before. Return false to end the loop because the line is gone.
bool port_idle(bool wants_input, bool has_output);

// ---- functions for the port

/// Serve a line until port_idle() returns false. `state` is the state of its shell: a serial_device_t for
/// serial_line, and so on. `firmware_id` is one of ANALOGRIG_FIRMWARE_FIRMWARE_ID_..._CHOICE, `catalogue_hash` is
/// ANALOGRIG_CATALOGUE_HASH. One line at a time: the buffers are static.
void device_loop(const device_line_t* line, void* state, uint8_t firmware_id, uint32_t catalogue_hash);

#ifdef __cplusplus
}
#endif

#endif  // DEVICE_LOOP_H_INCLUDED
