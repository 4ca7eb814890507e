/// slcan_device: the device on a CAN bus of its own, behind an adapter that speaks slcan.h: bytes in, bytes out. To whoever
/// opens it, it is an adapter of LAWICEL's kind with a bus on which the device is the only other node.
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

/// Bytes that one step of work may write: an answer, or a reply.
#define SLCAN_DEVICE_ANSWER SLCAN_STANDARD_LINE(DEVICE_ANSWER_LENGTH)

/// The state. The fields are private, but for the device.
typedef struct {
    can_device_t can;  ///< first
    slcan_t      adapter;
} slcan_device_t;

/// Makes the device ready: default configuration, stopped, the adapter's channel closed. It takes CAN FD.
void slcan_device_init(slcan_device_t* self, const device_identity_t* identity);

/// Works as device_progress_t says, on bytes; an answer, or a reply of the adapter, needs SLCAN_DEVICE_ANSWER of them.
device_progress_t slcan_device_run(slcan_device_t* self, const uint8_t* in, size_t in_n, uint8_t* out, size_t out_n);

/// sizeof(slcan_device_t), for callers in other languages.
size_t slcan_device_size(void);

#ifdef __cplusplus
}
#endif

#endif  // SLCAN_DEVICE_H_INCLUDED
