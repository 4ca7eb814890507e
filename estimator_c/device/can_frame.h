// SPDX-License-Identifier: MIT
/// can_frame: a frame of CAN or CAN FD, independent of controller, adapter or socket.
///
/// Distributed under the terms of the MIT License.

#ifndef CAN_FRAME_H_INCLUDED
#define CAN_FRAME_H_INCLUDED

#include <stdint.h>

/// Maximum bytes of data in a frame.
#define CAN_FRAME_CLASSIC_MAX 8U
#define CAN_FRAME_MAX 64U

/// Flags of a frame.
#define CAN_FRAME_EXTENDED 1U  ///< 29-bit identifier
#define CAN_FRAME_REMOTE 2U    ///< remote frame: requests a frame, and carries no data
#define CAN_FRAME_FD 4U        ///< CAN FD
#define CAN_FRAME_ERROR 8U     ///< error report of the controller; was not on the bus

typedef struct {
    uint32_t id;
    uint8_t  flags;
    uint8_t  length;  ///< bytes of data
    uint8_t  data[CAN_FRAME_MAX];
} can_frame_t;

#endif  // CAN_FRAME_H_INCLUDED
