/// socket_can: the frames of a CAN interface of this computer, as objects of can_frame_t one after the other.

#ifndef SOCKET_CAN_H_INCLUDED
#define SOCKET_CAN_H_INCLUDED

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>

/// A raw socket on an interface; is_fd: one that carries CAN FD. -1 if there is none, and errno says why.
int socket_can_open(const char* interface, bool is_fd);

/// Takes as many frames as have come and n bytes hold, and never waits; returns bytes, -1 with errno if there are none. Adds to
/// *lost how many the system had to drop.
ssize_t socket_can_receive(int fd, uint8_t* bytes, size_t n, uint32_t* lost);

/// Sends what frames the interface takes, in their order; returns bytes, -1 with errno if it takes none.
ssize_t socket_can_transmit(int fd, const uint8_t* bytes, size_t n);

/// What the system has against the socket: an interface that went down, for one.
int socket_can_error(int fd);

#endif  // SOCKET_CAN_H_INCLUDED
