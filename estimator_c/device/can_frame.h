/// can_frame: a frame of CAN or CAN FD, whatever controller, adapter or socket it comes from.
///
/// Distributed under the terms of the MIT License.

#ifndef CAN_FRAME_H_INCLUDED
#define CAN_FRAME_H_INCLUDED

#include <stdint.h>

/// Bytes that a frame can carry.
#define CAN_FRAME_CLASSIC_MAX 8U
#define CAN_FRAME_MAX 64U

// Flags of a frame.
#define CAN_FRAME_EXTENDED 1U  ///< its identifier has 29 bits
#define CAN_FRAME_REMOTE 2U    ///< it asks for a frame, and carries nothing
#define CAN_FRAME_FD 4U
#define CAN_FRAME_ERROR 8U  ///< the controller tells of an error; it was never on the bus

typedef struct {
    uint32_t id;
    uint8_t  flags;
    uint8_t  length;  ///< bytes of data
    uint8_t  data[CAN_FRAME_MAX];
} can_frame_t;

#endif  // CAN_FRAME_H_INCLUDED
