/// slcan: CAN frames as lines of text, the protocol of LAWICEL's adapters (CAN232 version 3, CANUSB version 1.0D), which
/// python-can, Linux's slcand and many tools speak. CAN FD as in the CANable's extension of it (d, D, b, B).
///
///     tIIIN..  TIIIIIIIIN..    a frame with 11 or 29 bits of identifier     rIIIN RIIIIIIIIN    a remote frame
///     dIIIN..  DIIIIIIIIN..    a frame of CAN FD; b, B: its data at the higher rate
///     O L C                    open the channel, open it to listen only, close it
///     S s Y                    bit rates, noted by whoever has a bus     V N F    version, serial number, status
///
/// Every line ends with CR, and is answered by CR (after a frame that goes out: z CR or Z CR), or by BEL if it is refused.
///
/// No heap, no globals that change, no recursion. The caller owns the state. Distributed under the terms of the MIT License.

#ifndef SLCAN_H_INCLUDED
#define SLCAN_H_INCLUDED

#include "can_frame.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// Characters of the longest line: kind, 29 bits of identifier, length, data, CR.
#define SLCAN_LINE(data_n) (1U + 8U + 1U + (2U * (data_n)) + 1U)
#define SLCAN_LINE_MAX SLCAN_LINE(CAN_FRAME_MAX)

/// The same with 11 bits of identifier.
#define SLCAN_STANDARD_LINE(data_n) (SLCAN_LINE(data_n) - 5U)

/// Bytes of the longest reply.
#define SLCAN_REPLY_MAX 6U

/// An adapter as its user sees it. The fields are private.
typedef struct {
    bool    is_fd;
    bool    is_open;
    bool    only_listens;
    bool    overlong;
    uint8_t fill;
    uint8_t line[SLCAN_LINE_MAX];
} slcan_t;

/// What a byte has led to.
typedef struct {
    bool        has_frame;  ///< a frame is to go out on the bus
    can_frame_t frame;
    uint8_t     reply_n;  ///< bytes to go back
    uint8_t     reply[SLCAN_REPLY_MAX];
} slcan_event_t;

/// Makes the adapter ready, its channel closed. is_fd: frames of CAN FD are taken.
void slcan_init(slcan_t* self, bool is_fd);

/// Takes one byte; true iff it completed a line, of which *event tells. Cost: constant, but for a CR after n bytes: O(n).
bool slcan_enter(slcan_t* self, uint8_t byte, slcan_event_t* event);

/// Writes a frame that came from the bus as a line; returns its length, at most SLCAN_LINE_MAX. 0 while the channel is closed:
/// there is nobody to tell.
size_t slcan_encode(const slcan_t* self, const can_frame_t* frame, uint8_t* out);

#ifdef __cplusplus
}
#endif

#endif  // SLCAN_H_INCLUDED
