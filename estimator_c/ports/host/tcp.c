// SPDX-License-Identifier: MIT

#include "tcp.h"

#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>
#include <sys/socket.h>
#include <unistd.h>

#define SCHEME "tcp://"
#define WAITING_MAX 128  ///< clients that wait for the one before them
#define PORT_MAX 65535U

/// Parse a port of at most five digits.
static bool parse_port(const char* const text, char out[6]) {
    const size_t n     = strspn(text, "0123456789");
    unsigned     value = 0U;
    if ((n == 0U) || (n > 5U) || (text[n] != '\0')) {
        return false;
    }
    for (size_t i = 0U; i < n; i++) {
        value = (10U * value) + (unsigned)(text[i] - '0');
    }
    (void)strcpy(out, text);
    return value <= PORT_MAX;
}

bool tcp_parse(const char* const text, tcp_address_t* const out) {
    const char* host = text + strlen(SCHEME);
    if (strncmp(text, SCHEME, strlen(SCHEME)) != 0) {
        return false;
    }
    const char* colon        = strrchr(host, ':');
    const bool  has_brackets = host[0] == '[';
    if ((colon == NULL) || !parse_port(colon + 1, out->port)) {
        return false;
    }
    size_t n = (size_t)(colon - host);
    if (has_brackets) {
        if ((n < 2U) || (host[n - 1U] != ']')) {
            return false;
        }
        host++;
        n -= 2U;
    }
    if ((n >= TCP_HOST_MAX) || (!has_brackets && (memchr(host, ':', n) != NULL)) || (memchr(host, '/', n) != NULL)) {
        return false;
    }
    (void)memcpy(out->host, host, n);
    out->host[n] = '\0';
    return true;
}

static bool make_nonblocking(const int fd) {
    const int flags = fcntl(fd, F_GETFL);
    return (flags >= 0) && (fcntl(fd, F_SETFL, flags | O_NONBLOCK) == 0);
}

/// Close a socket that cannot be used, keep errno, and return -1.
static int discard(const int fd) {
    const int reason = errno;
    (void)close(fd);
    errno = reason;
    return -1;
}

static int listen_on(const struct addrinfo* const candidate) {
    const int on = 1;
    const int fd = socket(candidate->ai_family, candidate->ai_socktype, candidate->ai_protocol);
    if (fd < 0) {
        return -1;
    }
    const bool is_ready = (setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on)) == 0) &&
                          (bind(fd, candidate->ai_addr, candidate->ai_addrlen) == 0) &&
                          (listen(fd, WAITING_MAX) == 0) && make_nonblocking(fd);
    return is_ready ? fd : discard(fd);
}

int tcp_listen(const tcp_address_t* const address, const char** const reason) {
    const bool            has_host = address->host[0] != '\0';
    const struct addrinfo wanted   = { .ai_family = has_host ? AF_UNSPEC : AF_INET, .ai_socktype = SOCK_STREAM };
    struct addrinfo*      found    = NULL;
    const int             status = getaddrinfo(has_host ? address->host : "127.0.0.1", address->port, &wanted, &found);
    if (status != 0) {
        *reason = (status == EAI_SYSTEM) ? strerror(errno) : gai_strerror(status);
        return -1;
    }
    int fd = -1;
    for (const struct addrinfo* candidate = found; (candidate != NULL) && (fd < 0); candidate = candidate->ai_next) {
        fd = listen_on(candidate);
    }
    *reason = strerror(errno);
    freeaddrinfo(found);
    return fd;
}

bool tcp_print(const int listener, char text[TCP_TEXT_MAX]) {
    struct sockaddr_storage address;
    socklen_t               size = sizeof(address);
    char                    host[TCP_TEXT_MAX - 16U];
    char                    port[6];
    if ((getsockname(listener, (struct sockaddr*)&address, &size) != 0) ||
        (getnameinfo((struct sockaddr*)&address, size, host, sizeof(host), port, sizeof(port),
                     NI_NUMERICHOST | NI_NUMERICSERV) != 0)) {
        return false;
    }
    const bool is_ipv6 = address.ss_family == AF_INET6;
    return snprintf(text, TCP_TEXT_MAX, SCHEME "%s%s%s:%s", is_ipv6 ? "[" : "", host, is_ipv6 ? "]" : "", port) > 0;
}

int tcp_accept(const int listener) {
    const int on = 1;
    const int fd = accept(listener, NULL, NULL);
    if (fd < 0) {
        return -1;
    }
    // Otherwise the kernel holds an answer back until the one before it is acknowledged, which takes up to 40 ms.
    const bool is_ready = (setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on)) == 0) && make_nonblocking(fd);
    return is_ready ? fd : discard(fd);
}

/// Answer of one line to a client of HTTP.
static const char http_answer[] =
    "HTTP/1.0 400 this port is analogrig-device, a device of binary frames, not a web server\r\n";

static const char* const http_methods[] = { "GET ",     "POST ",  "HEAD ",    "PUT ",   "DELETE ",
                                            "OPTIONS ", "PATCH ", "CONNECT ", "TRACE ", "PRI " };

#define METHOD_MAX 8U

/// Number of bytes after which it is known whether the first n ones begin a request of HTTP; 0 if they do, n if they do
/// not.
static size_t http_undecided(const char* const bytes, const size_t n) {
    size_t wanted = n;
    for (size_t i = 0U; i < (sizeof(http_methods) / sizeof(http_methods[0])); i++) {
        const size_t length = strlen(http_methods[i]);
        if (strncasecmp(bytes, http_methods[i], (n < length) ? n : length) == 0) {
            wanted = (n < length) ? (n + 1U) : 0U;
            break;
        }
    }
    return wanted;
}

/// Tell a client of HTTP what the port is. What it has sent so far is read: unread, it would reset the connection.
static void refuse_http(const int fd) {
    char ignored[4096];
    (void)send(fd, http_answer, sizeof(http_answer) - 1U, MSG_NOSIGNAL);
    (void)shutdown(fd, SHUT_WR);
    for (int i = 0; (i < 64) && (recv(fd, ignored, sizeof(ignored), 0) > 0); i++) {
    }
}

tcp_peer_t tcp_look(const int fd) {
    char          bytes[METHOD_MAX];
    const ssize_t n = recv(fd, bytes, sizeof(bytes), MSG_PEEK);
    if ((n < 0) && ((errno == EAGAIN) || (errno == EWOULDBLOCK) || (errno == EINTR))) {
        return TCP_SILENT;
    }
    const size_t wanted = (n > 0) ? http_undecided(bytes, (size_t)n) : 0U;
    if (wanted == 0U) {
        if (n > 0) {
            refuse_http(fd);
        }
        (void)close(fd);
        return TCP_GONE;
    }
    // The socket becomes readable only once there is more to look at.
    const int least = (wanted > (size_t)n) ? (int)wanted : 1;
    (void)setsockopt(fd, SOL_SOCKET, SO_RCVLOWAT, &least, sizeof(least));
    return (wanted > (size_t)n) ? TCP_SILENT : TCP_SPEAKS;
}
