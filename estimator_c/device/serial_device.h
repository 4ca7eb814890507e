// SPDX-License-Identifier: MIT
/// serial_device: the device on a serial line. Messages are framed as in frame.h.
///
/// No heap, no globals, no recursion. The caller owns the state, which belongs to one context.
/// Distributed under the terms of the MIT License.

#ifndef SERIAL_DEVICE_H_INCLUDED
#define SERIAL_DEVICE_H_INCLUDED

#include "device.h"
#include "frame.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// Size of an answer in bytes.
#define SERIAL_DEVICE_ANSWER FRAME_SIZE(DEVICE_ANSWER_LENGTH)

/// State of a device on a serial line. The fields are private, except device.
typedef struct {
    device_t        device;  ///< first member: a pointer to the state is one to the device
    frame_decoder_t decoder;
    uint32_t        dropped;  ///< dropped frames already reported to the device
} serial_device_t;

/// Prepare the device: default configuration, stopped, at the beginning of a frame. The state may hold anything before.
void serial_device_init(serial_device_t* self, const device_identity_t* identity);

/// Run the device as device_progress_t describes, on bytes. An answer takes SERIAL_DEVICE_ANSWER bytes.
device_progress_t serial_device_run(serial_device_t* self, const uint8_t* in, size_t in_n, uint8_t* out, size_t out_n);

/// sizeof(serial_device_t), for callers in other languages.
size_t serial_device_size(void);

#ifdef __cplusplus
}
#endif

#endif  // SERIAL_DEVICE_H_INCLUDED
