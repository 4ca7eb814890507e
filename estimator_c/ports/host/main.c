// SPDX-License-Identifier: MIT
/// analogrig-device: the device as a process of this computer, on a pseudo-terminal, a serial device, a TCP port or a CAN
/// interface.
///
/// The process ends with its standard input, so that it cannot outlive the process that started it.

#include "analogrig_catalogue.h"
#include "analogrig_codec.h"
#include "can_device.h"
#include "device_loop.h"
#include "serial_device.h"
#include "slcan_device.h"
#include "socket_can.h"
#include "tcp.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

#define EXIT_USAGE 2

static const char usage_text[] =
    "usage: analogrig-device [--slcan] [--catalogue-hash HEX] [PATH]\n"
    "       analogrig-device --listen tcp://[HOST]:PORT [--slcan] [--catalogue-hash HEX]\n"
    "       analogrig-device --can INTERFACE [--fd] [--catalogue-hash HEX]\n"
    "\n"
    "The analogrig estimator as a device on the serial device PATH (115200 8N1), or, without PATH, on a new\n"
    "pseudo-terminal whose name is printed; on a TCP port; or on a CAN interface of this computer. Ends when standard\n"
    "input ends.\n"
    "\n"
    "  --slcan               speak CAN as LAWICEL's adapters do, as if such a one were between it and the line\n"
    "  --listen ADDRESS      serve one client after the other, each with a device that has just booted. A client's "
    "turn\n"
    "                        comes once it has sent something. Without HOST on the loopback interface only; port 0 "
    "takes\n"
    "                        a free one. Prints the address when ready\n"
    "  --can INTERFACE       a SocketCAN interface, such as can0; --fd: it carries CAN FD. Prints its name when ready\n"
    "  --catalogue-hash HEX  pretend to be built from another message catalogue (for tests)\n"
    "  --version             print the version and the hash of the catalogue\n"
    "  --help                print this\n";

typedef struct {
    const char*   path;
    const char*   interface;
    const char*   listen;  ///< as given
    tcp_address_t address;
    bool          is_slcan;
    bool          is_fd;
    uint32_t      catalogue_hash;
} options_t;

/// Line to the harness.
static struct {
    int  fd;
    bool is_bus;     ///< carries CAN frames; otherwise bytes
    bool is_tcp;     ///< its client may go at any time
    bool has_ended;  ///< the client sends nothing more, but may still receive
    bool lost;       ///< errno holds the cause
} line;

static int fail(const char* const what, const char* const name) {
    (void)fprintf(stderr, "analogrig-device: %s %s: %s\n", what, name, strerror(errno));
    return EXIT_FAILURE;
}

// ---------------------------------------------      COMMAND LINE      ---------------------------------------------

static int refuse(const char* const what, const char* const argument) {
    (void)fprintf(stderr, "analogrig-device: %s: %s (see --help)\n", what, argument);
    return EXIT_USAGE;
}

static bool parse_hash(const char* const text, uint32_t* const out) {
    char* end                      = NULL;
    errno                          = 0;
    const unsigned long long value = strtoull(text, &end, 16);
    *out                           = (uint32_t)value;
    return (errno == 0) && (end != text) && (*end == '\0') && (value <= UINT32_MAX);
}

/// Parse the command line. Return false if the process must exit with *status instead of serving the device.
static bool parse(const int argc, char* const argv[], options_t* const options, int* const status) {
    *status = EXIT_SUCCESS;
    for (int i = 1; i < argc; i++) {
        if (strcmp(argv[i], "--help") == 0) {
            (void)fputs(usage_text, stdout);
            return false;
        }
        if (strcmp(argv[i], "--version") == 0) {
            (void)printf("analogrig-device %d.%d, catalogue %08" PRIx32 "\n", EST_VERSION_MAJOR, EST_VERSION_MINOR,
                         (uint32_t)ANALOGRIG_CATALOGUE_HASH);
            return false;
        }
        if (strcmp(argv[i], "--catalogue-hash") == 0) {
            i++;
            if ((i == argc) || !parse_hash(argv[i], &options->catalogue_hash)) {
                *status = refuse("not a hash of 32 bits", (i == argc) ? "nothing" : argv[i]);
                return false;
            }
        } else if (strcmp(argv[i], "--slcan") == 0) {
            options->is_slcan = true;
        } else if (strcmp(argv[i], "--fd") == 0) {
            options->is_fd = true;
        } else if ((strcmp(argv[i], "--can") == 0) && ((i + 1) < argc)) {
            i++;
            options->interface = argv[i];
        } else if (strcmp(argv[i], "--listen") == 0) {
            i++;
            options->listen = (i < argc) ? argv[i] : "nothing";
            if (!tcp_parse(options->listen, &options->address)) {
                *status = refuse("not an address like tcp://127.0.0.1:4000", options->listen);
                return false;
            }
        } else if ((argv[i][0] == '-') || (options->path != NULL)) {
            *status = refuse("unexpected argument", argv[i]);
            return false;
        } else {
            options->path = argv[i];
        }
    }
    const bool has_terminal = options->is_slcan || (options->path != NULL);
    if ((has_terminal || (options->listen != NULL)) && (options->interface != NULL)) {
        *status = refuse("goes with no terminal and no port", "--can");
    } else if ((options->path != NULL) && (options->listen != NULL)) {
        *status = refuse("goes with no terminal", "--listen");
    } else if (options->is_fd && (options->interface == NULL)) {
        *status = refuse("goes with --can", "--fd");
    } else {
        return true;
    }
    return false;
}

// ---------------------------------------------        THE LINE        ---------------------------------------------

/// Set the terminal to raw bytes: no echo, no signals, no translation.
static bool make_raw(const int fd) {
    struct termios settings;
    if (tcgetattr(fd, &settings) != 0) {
        return false;
    }
    settings.c_iflag     = 0;
    settings.c_oflag     = 0;
    settings.c_lflag     = 0;
    settings.c_cflag     = CS8 | CREAD | CLOCAL;
    settings.c_cc[VMIN]  = 1;
    settings.c_cc[VTIME] = 0;
    return (cfsetispeed(&settings, B115200) == 0) && (cfsetospeed(&settings, B115200) == 0) &&
           (tcsetattr(fd, TCSANOW, &settings) == 0);
}

static bool make_nonblocking(const int fd) {
    const int flags = fcntl(fd, F_GETFL);
    return (flags >= 0) && (fcntl(fd, F_SETFL, flags | O_NONBLOCK) == 0);
}

static int open_serial(const char* const path) {
    const int fd = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK);
    return ((fd >= 0) && make_raw(fd)) ? fd : -1;
}

/// Open a pseudo-terminal, print the path of its slave, and return its master. The slave stays open: otherwise a read
/// of the master would fail whenever the harness closes the line.
static int open_terminal(void) {
    const int master = posix_openpt(O_RDWR | O_NOCTTY);
    if ((master < 0) || (grantpt(master) != 0) || (unlockpt(master) != 0)) {
        return -1;
    }
    const char* const path  = ptsname(master);
    const int         slave = (path != NULL) ? open(path, O_RDWR | O_NOCTTY) : -1;
    if ((slave < 0) || !make_raw(slave) || !make_nonblocking(master)) {
        return -1;
    }
    return ((printf("%s\n", path) > 0) && (fflush(stdout) == 0)) ? master : -1;
}

static bool is_transient(void) { return (errno == EAGAIN) || (errno == EWOULDBLOCK) || (errno == EINTR); }

// ---------------------------------------------        THE PORT        ---------------------------------------------

static void lose(const int reason) {
    line.lost = true;
    errno     = reason;
}

uint32_t port_boot_nonce(void) {
    uint32_t      nonce = 0U;
    const int     fd    = open("/dev/urandom", O_RDONLY);
    const ssize_t n     = (fd >= 0) ? read(fd, &nonce, sizeof(nonce)) : -1;
    if (fd >= 0) {
        (void)close(fd);
    }
    if (n != (ssize_t)sizeof(nonce)) {
        (void)fail("cannot read", "/dev/urandom");
        exit(EXIT_FAILURE);
    }
    return nonce;
}

size_t port_receive(uint8_t* const bytes, const size_t n, uint32_t* const lost) {
    if (line.is_bus) {
        const ssize_t frames = socket_can_receive(line.fd, bytes, n, lost);
        if ((frames < 0) && !is_transient()) {
            lose(errno);
        }
        return (frames > 0) ? (size_t)frames : 0U;
    }
    const ssize_t received = read(line.fd, bytes, n);  // the rest stays in the line
    if (received > 0) {
        return (size_t)received;
    }
    if ((received == 0) && line.is_tcp) {
        line.has_ended = true;
    } else if (received == 0) {
        lose(EIO);  // end of file: the serial device is gone
    } else if (!is_transient()) {
        lose(errno);
    } else {
        // no data
    }
    return 0U;
}

size_t port_transmit(const uint8_t* const bytes, const size_t n) {
    const ssize_t sent = line.is_bus ? socket_can_transmit(line.fd, bytes, n) : write(line.fd, bytes, n);
    if ((sent < 0) && !is_transient()) {
        lose(errno);
    }
    return (sent > 0) ? (size_t)sent : 0U;
}

/// True iff standard input has ended. Its content is discarded.
static bool parent_is_gone(const short events) {
    char ignored[256];
    if ((events & (POLLIN | POLLHUP | POLLERR | POLLNVAL)) == 0) {
        return false;
    }
    const ssize_t n = read(STDIN_FILENO, ignored, sizeof(ignored));
    return (n == 0) || ((n < 0) && !is_transient());
}

/// True iff the other end has hung up and nothing is left to read.
static bool has_hung_up(const short events) {
    return ((events & (POLLHUP | POLLERR | POLLNVAL)) != 0) && ((events & POLLIN) == 0);
}

#define WAIT_FOR_EVER (-1)
#define SILENT_MAX 64U

bool port_idle(const bool wants_input, const bool has_output) {
    const short   in     = (wants_input && !line.has_ended) ? POLLIN : 0;
    const short   out    = has_output ? POLLOUT : 0;
    struct pollfd fds[2] = {
        { .fd = STDIN_FILENO, .events = POLLIN },
        { .fd = line.fd, .events = (short)(in | out) },
    };
    if (line.lost || (line.has_ended && !has_output)) {
        return false;
    }
    if (poll(fds, 2, WAIT_FOR_EVER) < 0) {
        if (errno != EINTR) {
            lose(errno);
        }
        return !line.lost;
    }
    if (parent_is_gone(fds[0].revents)) {
        return false;
    }
    if (has_hung_up(fds[1].revents)) {
        lose(line.is_bus ? socket_can_error(line.fd) : EIO);
    }
    return !line.lost;
}

/// Boot the device and run it on the line of bytes until that is gone or standard input ends.
static void serve_bytes(const options_t* const options) {
    static serial_device_t serial;
    static slcan_device_t  slcan;
    if (options->is_slcan) {
        device_loop(&slcan_line, &slcan, ANALOGRIG_FIRMWARE_FIRMWARE_ID_HOST_CHOICE, options->catalogue_hash);
    } else {
        device_loop(&serial_line, &serial, ANALOGRIG_FIRMWARE_FIRMWARE_ID_HOST_CHOICE, options->catalogue_hash);
    }
}

static int serve_terminal(const options_t* const options) {
    const char* const name = (options->path != NULL) ? options->path : "a pseudo-terminal";
    line.fd                = (options->path != NULL) ? open_serial(options->path) : open_terminal();
    if (line.fd < 0) {
        return fail("cannot open", name);
    }
    serve_bytes(options);
    return line.lost ? fail("lost", name) : EXIT_SUCCESS;
}

/// Clients that have not spoken yet, in order of their arrival. A newcomer replaces the first one.
static struct {
    int    fds[SILENT_MAX];
    size_t n;
} silent;

static void forget_silent(const size_t i) {
    silent.n--;
    (void)memmove(&silent.fds[i], &silent.fds[i + 1U], (silent.n - i) * sizeof(silent.fds[0]));
}

/// Accept all newcomers. Return false with line.lost if that failed.
static bool accept_newcomers(const int listener) {
    int fd = tcp_accept(listener);
    while (fd >= 0) {
        if (silent.n == SILENT_MAX) {
            (void)close(silent.fds[0]);
            forget_silent(0U);
        }
        silent.fds[silent.n] = fd;
        silent.n++;
        fd = tcp_accept(listener);
    }
    if (!is_transient() && (errno != ECONNABORTED)) {
        lose(errno);
    }
    return !line.lost;
}

/// Make the first client that speaks the line.
static void take_speaker(void) {
    size_t i = 0U;
    while ((i < silent.n) && (line.fd < 0)) {
        const int        fd   = silent.fds[i];
        const tcp_peer_t peer = tcp_look(fd);
        if (peer == TCP_SILENT) {
            i++;
        } else {
            forget_silent(i);
            line.fd = (peer == TCP_SPEAKS) ? fd : -1;
        }
    }
}

/// Wait for the next client that speaks and make it the line. Return false if standard input has ended, or with
/// line.lost.
static bool await_client(const int listener) {
    line.fd        = -1;
    line.has_ended = false;
    line.lost      = false;
    while (line.fd < 0) {
        struct pollfd fds[2U + SILENT_MAX] = {
            { .fd = STDIN_FILENO, .events = POLLIN },
            { .fd = listener, .events = POLLIN },
        };
        for (size_t i = 0U; i < silent.n; i++) {
            fds[2U + i] = (struct pollfd){ .fd = silent.fds[i], .events = POLLIN };
        }
        if ((poll(fds, (nfds_t)(2U + silent.n), WAIT_FOR_EVER) < 0) && !is_transient()) {
            lose(errno);
            return false;
        }
        if (parent_is_gone(fds[0].revents)) {
            return false;
        }
        take_speaker();
        if ((line.fd < 0) && (fds[1].revents != 0) && !accept_newcomers(listener)) {
            return false;
        }
    }
    return true;
}

static int serve_clients(const options_t* const options) {
    const char* reason = NULL;
    char        address[TCP_TEXT_MAX];
    const int   listener = tcp_listen(&options->address, &reason);
    if (listener < 0) {
        (void)fprintf(stderr, "analogrig-device: cannot listen on %s: %s\n", options->listen, reason);
        return EXIT_FAILURE;
    }
    if (!tcp_print(listener, address) || (printf("%s\n", address) < 0) || (fflush(stdout) != 0)) {
        return fail("cannot write", "standard output");
    }
    (void)signal(SIGPIPE, SIG_IGN);  // a client may go while it is answered
    line.is_tcp = true;
    while (await_client(listener)) {
        serve_bytes(options);
        (void)close(line.fd);
        if (!line.lost && !line.has_ended) {
            return EXIT_SUCCESS;  // standard input has ended
        }
    }
    return line.lost ? fail("cannot accept a client on", address) : EXIT_SUCCESS;
}

static int serve_bus(const options_t* const options) {
    static can_device_t device;
    line.fd     = socket_can_open(options->interface, options->is_fd);
    line.is_bus = true;
    if (line.fd < 0) {
        return fail("cannot open the CAN interface", options->interface);
    }
    if ((printf("%s\n", options->interface) < 0) || (fflush(stdout) != 0)) {
        return fail("cannot write", "standard output");
    }
    device_loop(options->is_fd ? &can_fd_line : &can_line, &device, ANALOGRIG_FIRMWARE_FIRMWARE_ID_HOST_CHOICE,
                options->catalogue_hash);
    return line.lost ? fail("lost", options->interface) : EXIT_SUCCESS;
}

int main(int argc, char* argv[]) {
    options_t options = { .catalogue_hash = (uint32_t)ANALOGRIG_CATALOGUE_HASH };
    int       status  = EXIT_SUCCESS;
    if (!parse(argc, argv, &options, &status)) {
        return status;
    }
    if (options.interface != NULL) {
        return serve_bus(&options);
    }
    return (options.listen != NULL) ? serve_clients(&options) : serve_terminal(&options);
}
