// SPDX-License-Identifier: MIT
/// slcan_device: the device on a CAN bus of its own, behind an slcan adapter. To its user it is an adapter with a bus
/// on which the device is the only other node.
///
/// No heap, no globals, no recursion. The caller owns the state, which belongs to one context.
/// Distributed under the terms of the MIT License.

#ifndef SLCAN_DEVICE_H_INCLUDED
#define SLCAN_DEVICE_H_INCLUDED

#include "can_device.h"
#include "slcan.h"

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// Maximum size in bytes of an answer or a reply.
#define SLCAN_DEVICE_ANSWER SLCAN_STANDARD_LINE(DEVICE_ANSWER_LENGTH)

/// State of the device and its adapter. The fields are private, except can.device.
typedef struct {
    can_device_t can;  ///< first member: a pointer to the state is one to the device
    slcan_t      adapter;
} slcan_device_t;

/// Prepare the device: default configuration, stopped, CAN FD supported, the channel of the adapter closed.
void slcan_device_init(slcan_device_t* self, const device_identity_t* identity);

/// Run the device as device_progress_t describes, on bytes. An answer or a reply takes at most SLCAN_DEVICE_ANSWER
/// bytes.
device_progress_t slcan_device_run(slcan_device_t* self, const uint8_t* in, size_t in_n, uint8_t* out, size_t out_n);

/// sizeof(slcan_device_t), for callers in other languages.
size_t slcan_device_size(void);

#ifdef __cplusplus
}
#endif

#endif  // SLCAN_DEVICE_H_INCLUDED
