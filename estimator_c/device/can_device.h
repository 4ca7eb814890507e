// SPDX-License-Identifier: MIT
/// can_device: the device on a CAN bus. The identifier of a frame is that of its message in estimator_c/catalogue.
///
/// The bus may have other nodes. A frame is foreign unless it is a data frame with an 11-bit identifier of a message
/// of the harness; foreign frames are skipped and counted. A message with the wrong length, or in CAN FD to a device
/// without it, is dropped and counted.
///
/// The answers must be transmitted in order. Their identifiers differ, so a controller with several mailboxes that
/// transmits the lowest identifier first must be configured to transmit in order, or be given one frame at a time.
///
/// No heap, no globals, no recursion. The caller owns the state, which belongs to one context.
/// Distributed under the terms of the MIT License.

#ifndef CAN_DEVICE_H_INCLUDED
#define CAN_DEVICE_H_INCLUDED

#include "analogrig_catalogue.h"
#include "can_frame.h"
#include "device.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// State of a device on a CAN bus. The fields are private, except device.
typedef struct {
    device_t device;  ///< first member: a pointer to the state is one to the device
    bool     is_fd;
    uint8_t  payload[ANALOGRIG_LENGTH_MAX];  ///< payload of the message that is being answered
} can_device_t;

/// Prepare the device: default configuration, stopped. The state may hold anything before. `is_fd`: its controller
/// supports CAN FD.
void can_device_init(can_device_t* self, const device_identity_t* identity, bool is_fd);

/// Enter a frame. The device must not be busy (asserted). Cost: as device_enter().
void can_device_enter(can_device_t* self, const can_frame_t* frame);

/// Write the next answer to the last message. Return false if there is none. Cost: as device_answer().
bool can_device_answer(can_device_t* self, can_frame_t* answer);

/// Run the device as device_progress_t describes, on frames. An answer takes one frame.
device_progress_t
can_device_run(can_device_t* self, const can_frame_t* in, size_t in_n, can_frame_t* out, size_t out_n);

/// sizeof(can_device_t), for callers in other languages.
size_t can_device_size(void);

#ifdef __cplusplus
}
#endif

#endif  // CAN_DEVICE_H_INCLUDED
