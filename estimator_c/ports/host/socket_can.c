// SPDX-License-Identifier: MIT

#define _DEFAULT_SOURCE  // for SO_RXQ_OVFL, which is specific to Linux

#include "socket_can.h"

#include "can_frame.h"

#include <errno.h>
#include <fcntl.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

/// Delay before the next attempt if the queue of the driver is full: poll() does not report room in it.
#define FULL_QUEUE_NS 200000L

static bool set_up(const int fd, const char* const interface, const bool is_fd) {
    const int                 on      = 1;
    const unsigned int        index   = if_nametoindex(interface);
    const struct sockaddr_can address = { .can_family = AF_CAN, .can_ifindex = (int)index };
    const int                 flags   = fcntl(fd, F_GETFL);
    return (index != 0U) && (!is_fd || (setsockopt(fd, SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &on, sizeof(on)) == 0)) &&
           (setsockopt(fd, SOL_SOCKET, SO_RXQ_OVFL, &on, sizeof(on)) == 0) && (flags >= 0) &&
           (fcntl(fd, F_SETFL, flags | O_NONBLOCK) == 0) &&
           (bind(fd, (const struct sockaddr*)&address, sizeof(address)) == 0);
}

int socket_can_open(const char* const interface, const bool is_fd) {
    const int fd = socket(AF_CAN, SOCK_RAW, CAN_RAW);
    if (fd < 0) {
        return -1;
    }
    if (!set_up(fd, interface, is_fd)) {
        const int reason = errno;
        (void)close(fd);
        errno = reason;
        return -1;
    }
    return fd;
}

/// Read the system's count of frames lost since the socket was opened. Return false if the message has none.
static bool overflows(struct msghdr* const message, uint32_t* const count) {
    for (struct cmsghdr* part = CMSG_FIRSTHDR(message); part != NULL; part = CMSG_NXTHDR(message, part)) {
        if ((part->cmsg_level == SOL_SOCKET) && (part->cmsg_type == SO_RXQ_OVFL)) {
            (void)memcpy(count, CMSG_DATA(part), sizeof(*count));
            return true;
        }
    }
    return false;
}

/// Receive one frame. Return false with errno if there is none.
static bool receive(const int fd, can_frame_t* const frame, uint32_t* const lost) {
    static uint32_t    lost_before = 0U;
    struct canfd_frame raw         = { 0 };
    union {
        struct cmsghdr header;
        uint8_t        bytes[CMSG_SPACE(sizeof(uint32_t))];
    } control;
    struct iovec  vector  = { .iov_base = &raw, .iov_len = sizeof(raw) };
    struct msghdr message = {
        .msg_iov = &vector, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof(control)
    };
    const ssize_t n     = recvmsg(fd, &message, 0);
    uint32_t      count = 0U;
    if (n <= 0) {
        return false;
    }
    if (overflows(&message, &count)) {
        *lost += count - lost_before;
        lost_before = count;
    }
    const bool is_extended = (raw.can_id & CAN_EFF_FLAG) != 0U;
    *frame                 = (can_frame_t){ .id     = raw.can_id & (is_extended ? CAN_EFF_MASK : CAN_SFF_MASK),
                                            .length = (raw.len <= CAN_FRAME_MAX) ? raw.len : CAN_FRAME_MAX };
    frame->flags |= is_extended ? CAN_FRAME_EXTENDED : 0U;
    frame->flags |= ((raw.can_id & CAN_RTR_FLAG) != 0U) ? CAN_FRAME_REMOTE : 0U;
    frame->flags |= ((raw.can_id & CAN_ERR_FLAG) != 0U) ? CAN_FRAME_ERROR : 0U;
    frame->flags |= (n == (ssize_t)CANFD_MTU) ? CAN_FRAME_FD : 0U;
    (void)memcpy(frame->data, raw.data, frame->length);
    return true;
}

ssize_t socket_can_receive(const int fd, uint8_t* const bytes, const size_t n, uint32_t* const lost) {
    size_t      taken = 0U;
    can_frame_t frame;
    while (((n - taken) >= sizeof(frame)) && receive(fd, &frame, lost)) {
        (void)memcpy(&bytes[taken], &frame, sizeof(frame));
        taken += sizeof(frame);
    }
    return (taken > 0U) ? (ssize_t)taken : -1;
}

/// Transmit one frame as classic CAN, which all answers fit. Return false with errno if it is not accepted.
static bool transmit(const int fd, const can_frame_t* const frame) {
    struct can_frame raw = { .can_id = frame->id, .can_dlc = frame->length };
    (void)memcpy(raw.data, frame->data, frame->length);
    if (write(fd, &raw, sizeof(raw)) == (ssize_t)sizeof(raw)) {
        return true;
    }
    if (errno == ENOBUFS) {
        const struct timespec pause = { .tv_nsec = FULL_QUEUE_NS };
        (void)nanosleep(&pause, NULL);
        errno = EAGAIN;
    }
    return false;
}

ssize_t socket_can_transmit(const int fd, const uint8_t* const bytes, const size_t n) {
    size_t      sent = 0U;
    can_frame_t frame;
    while ((n - sent) >= sizeof(frame)) {
        (void)memcpy(&frame, &bytes[sent], sizeof(frame));
        if (!transmit(fd, &frame)) {
            break;
        }
        sent += sizeof(frame);
    }
    return (sent > 0U) ? (ssize_t)sent : -1;
}

int socket_can_error(const int fd) {
    int       reason = 0;
    socklen_t size   = sizeof(reason);
    return ((getsockopt(fd, SOL_SOCKET, SO_ERROR, &reason, &size) == 0) && (reason != 0)) ? reason : EIO;
}
