// SPDX-License-Identifier: MIT
/// slcan: CAN frames as lines of text, in the protocol of LAWICEL's adapters (CAN232 version 3, CANUSB version 1.0D).
/// python-can, Linux's slcand and many tools support it. CAN FD uses the extension of the CANable (d, D, b, B).
///
///     tIIIN..  TIIIIIIIIN..    a frame with 11 or 29 bits of identifier     rIIIN RIIIIIIIIN    a remote frame
///     dIIIN..  DIIIIIIIIN..    a frame of CAN FD; b, B: its data at the higher rate
///     O L C                    open the channel, open it to listen only, close it
///     S s Y                    bit rates; accepted and ignored              V N F    version, serial number, status
///
/// A line ends with CR. The reply is CR (after a transmitted frame z CR or Z CR), or BEL if the line is refused.
///
/// No heap, no mutable globals, no recursion. The caller owns the state.
/// Distributed under the terms of the MIT License.

#ifndef SLCAN_H_INCLUDED
#define SLCAN_H_INCLUDED

#include "can_frame.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// Length of the longest line: kind, 29 bits of identifier, length, data, CR.
#define SLCAN_LINE(data_n) (1U + 8U + 1U + (2U * (data_n)) + 1U)
#define SLCAN_LINE_MAX SLCAN_LINE(CAN_FRAME_MAX)

/// The same with an 11-bit identifier.
#define SLCAN_STANDARD_LINE(data_n) (SLCAN_LINE(data_n) - 5U)

/// Length of the longest reply in bytes.
#define SLCAN_REPLY_MAX 6U

/// State of the adapter. The fields are private.
typedef struct {
    bool    is_fd;
    bool    is_open;
    bool    only_listens;
    bool    overlong;
    uint8_t fill;
    uint8_t line[SLCAN_LINE_MAX];
} slcan_t;

/// Result of a complete line.
typedef struct {
    bool        has_frame;  ///< transmit the frame on the bus
    can_frame_t frame;
    uint8_t     reply_n;  ///< length of the reply
    uint8_t     reply[SLCAN_REPLY_MAX];
} slcan_event_t;

/// Prepare the adapter with its channel closed. `is_fd`: accept frames of CAN FD.
void slcan_init(slcan_t* self, bool is_fd);

/// Enter one byte. Return true iff it completes a line, whose result is *event. Cost: constant; for a CR after n
/// bytes O(n).
bool slcan_enter(slcan_t* self, uint8_t byte, slcan_event_t* event);

/// Write a frame received from the bus as a line. Return its length, at most SLCAN_LINE_MAX; 0 while the channel is
/// closed.
size_t slcan_encode(const slcan_t* self, const can_frame_t* frame, uint8_t* out);

#ifdef __cplusplus
}
#endif

#endif  // SLCAN_H_INCLUDED
