// SPDX-License-Identifier: MIT
/// socket_can: frames of a CAN interface of Linux, as consecutive objects of can_frame_t.

#ifndef SOCKET_CAN_H_INCLUDED
#define SOCKET_CAN_H_INCLUDED

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>

/// Open a raw socket on an interface. `is_fd`: enable CAN FD. Return -1 with errno on failure.
int socket_can_open(const char* interface, bool is_fd);

/// Receive as many frames as have arrived and fit n bytes, without waiting. Return the number of bytes, -1 with errno
/// if there are none. Add the number of frames that the system has dropped to *lost.
ssize_t socket_can_receive(int fd, uint8_t* bytes, size_t n, uint32_t* lost);

/// Transmit frames in order until the interface refuses one. Return the number of bytes, -1 with errno if there are
/// none.
ssize_t socket_can_transmit(int fd, const uint8_t* bytes, size_t n);

/// Return and clear the pending error of the socket, such as an interface that went down.
int socket_can_error(int fd);

#endif  // SOCKET_CAN_H_INCLUDED
