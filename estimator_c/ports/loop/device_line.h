/// device_line: what the loop of a port must know about the shell that it runs.
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

/// A kind of line. `state` is the shell's, which begins with its device_t.
typedef struct {
    void (*init)(void* state, const device_identity_t* identity);
    device_progress_t (*run)(void* state, const uint8_t* in, size_t in_n, uint8_t* out, size_t out_n);
    size_t block_size;  ///< bytes that a SampleBlock takes in the input; of a frame, where there are none
} device_line_t;

/// Of a serial_device_t: frames of bytes.
extern const device_line_t serial_line;

/// Of a slcan_device_t: CAN frames as text.
extern const device_line_t slcan_line;

/// Of a can_device_t: whole objects of can_frame_t, one after the other, as a controller or a socket gives them.
extern const device_line_t can_line;     ///< classic CAN
extern const device_line_t can_fd_line;  ///< CAN FD

#ifdef __cplusplus
}
#endif

#endif  // DEVICE_LINE_H_INCLUDED
