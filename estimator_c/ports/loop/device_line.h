// SPDX-License-Identifier: MIT
/// device_line: interface between the loop of a port and the shell that it runs.
///
/// Distributed under the terms of the MIT License.

#ifndef DEVICE_LINE_H_INCLUDED
#define DEVICE_LINE_H_INCLUDED

#include "device.h"

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// A kind of line. `state` is the state of its shell; a pointer to it is one to its device_t.
typedef struct {
    void (*init)(void* state, const device_identity_t* identity);
    device_progress_t (*run)(void* state, const uint8_t* in, size_t in_n, uint8_t* out, size_t out_n);
    size_t block_size;  ///< bytes of a SampleBlock in the input; without SampleBlocks, of a frame
} device_line_t;

/// Line of a serial_device_t: frames of bytes.
extern const device_line_t serial_line;

/// Line of an slcan_device_t: CAN frames as text.
extern const device_line_t slcan_line;

/// Lines of a can_device_t: consecutive objects of can_frame_t, as from a controller or a socket.
extern const device_line_t can_line;     ///< classic CAN
extern const device_line_t can_fd_line;  ///< CAN FD

#ifdef __cplusplus
}
#endif

#endif  // DEVICE_LINE_H_INCLUDED
