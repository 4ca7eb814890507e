/// can_device: the device on a CAN bus. The identifier of a frame is that of the message in estimator_c/catalogue.
///
/// Others may speak on the bus too: what is not one of the harness's messages in a data frame with eleven bits of identifier
/// is passed over and counted. A message that has not its length, or that CAN FD carries to a device without it, is
/// dropped and counted.
///
/// The answers must go out in the order in which they are given. Their identifiers differ, so a controller with several
/// mailboxes that sends the lowest identifier first must be told to send in order, or be given one frame at a time.
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

/// The state of a device on a bus. The fields are private, but for the device.
typedef struct {
    device_t device;  ///< first
    bool     is_fd;
    uint8_t  payload[ANALOGRIG_LENGTH_MAX];  ///< of the message that is being answered
} can_device_t;

/// Makes the device ready: default configuration, stopped. is_fd: its controller can send and receive CAN FD.
void can_device_init(can_device_t* self, const device_identity_t* identity, bool is_fd);

/// Takes a frame, when the last message has all its answers (asserted: the device is not busy). Cost: as device_enter().
void can_device_enter(can_device_t* self, const can_frame_t* frame);

/// The next answer to the last message; false if there is none. Cost: as device_answer().
bool can_device_answer(can_device_t* self, can_frame_t* answer);

/// Works as device_progress_t says, on frames; an answer needs one.
device_progress_t
can_device_run(can_device_t* self, const can_frame_t* in, size_t in_n, can_frame_t* out, size_t out_n);

/// sizeof(can_device_t), for callers in other languages.
size_t can_device_size(void);

#ifdef __cplusplus
}
#endif

#endif  // CAN_DEVICE_H_INCLUDED
