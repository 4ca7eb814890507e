// SPDX-License-Identifier: MIT
/// tcp: a TCP port for one client after the other, and what a client speaks.

#ifndef TCP_H_INCLUDED
#define TCP_H_INCLUDED

#include <stdbool.h>

/// Length of a host name (RFC 1035), and of an address as tcp_print() prints it.
#define TCP_HOST_MAX 256U
#define TCP_TEXT_MAX 80U

/// Host and port of an address tcp://HOST:PORT. An empty host means 127.0.0.1.
typedef struct {
    char host[TCP_HOST_MAX];
    char port[6];
} tcp_address_t;

/// Parse tcp://HOST:PORT; an IPv6 address stands in brackets. Return false if the text is not of this form.
bool tcp_parse(const char* text, tcp_address_t* out);

/// Return a listening, non-blocking socket. On failure return -1 with the cause in *reason.
int tcp_listen(const tcp_address_t* address, const char** reason);

/// Write the address of a listening socket, with the port that the system has chosen for 0, as tcp://HOST:PORT.
bool tcp_print(int listener, char text[TCP_TEXT_MAX]);

/// Accept the next client: a non-blocking socket that sends every answer at once. Return -1 with errno if there is none.
int tcp_accept(int listener);

typedef enum {
    TCP_SILENT = 0,  ///< it has sent nothing, or too little to tell
    TCP_SPEAKS,      ///< it has sent something that is no request of HTTP
    TCP_GONE,        ///< it has gone, or speaks HTTP: it has been told what the port is, and the socket is closed
} tcp_peer_t;

/// Look at the first bytes of a client, which stay in the socket. Any web page can make a browser send a request of
/// HTTP with any body.
tcp_peer_t tcp_look(int fd);

#endif  // TCP_H_INCLUDED
