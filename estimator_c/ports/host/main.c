/// analogrig-device: the device as a process of this computer, behind a pseudo-terminal or a serial device.
///
/// It ends when its standard input does, so that it cannot outlive the process that started it and holds the other end.

#include "analogrig_catalogue.h"
#include "analogrig_codec.h"
#include "device.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

#define EXIT_USAGE 2

/// A burst of blocks and all their answers; when either is full the line waits.
#define INPUT_SIZE 4096U
#define OUTPUT_SIZE 16384U

static const char usage_text[] =
    "usage: analogrig-device [--catalogue-hash HEX] [PATH]\n"
    "\n"
    "The analogrig estimator as a device on the serial device PATH (115200 8N1), or, without PATH, on a new\n"
    "pseudo-terminal whose name is printed. Ends when standard input ends.\n"
    "\n"
    "  --catalogue-hash HEX  pretend to be built from another message catalogue (for tests)\n"
    "  --version             print the version and the hash of the catalogue\n"
    "  --help                print this\n";

typedef struct {
    const char* path;
    uint32_t    catalogue_hash;
} options_t;

/// The line, and what is on its way from and to it.
typedef struct {
    int     fd;
    uint8_t input[INPUT_SIZE];
    size_t  input_from;
    size_t  input_to;
    uint8_t output[OUTPUT_SIZE];
    size_t  output_from;
    size_t  output_to;
} line_t;

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

/// Returns true if the device is to be served; otherwise all is done and *status says how it went.
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
        } else if ((argv[i][0] == '-') || (options->path != NULL)) {
            *status = refuse("unexpected argument", argv[i]);
            return false;
        } else {
            options->path = argv[i];
        }
    }
    return true;
}

// ---------------------------------------------        THE LINE        ---------------------------------------------

/// Every byte as it is: no echo, no signals, no translation.
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

/// The master of a new pseudo-terminal; prints the path of its slave. The slave stays open for ever: without it a read
/// of the master would fail whenever the harness lets go of the line.
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

/// False iff the line is gone.
static bool receive(line_t* const line) {
    const ssize_t n = read(line->fd, line->input, sizeof(line->input));
    if (n > 0) {
        line->input_from = 0U;
        line->input_to   = (size_t)n;
        return true;
    }
    if (n == 0) {
        errno = EIO;  // the end of a serial device is no success
        return false;
    }
    return is_transient();
}

/// False iff the line is gone.
static bool transmit(line_t* const line) {
    const ssize_t n = write(line->fd, &line->output[line->output_from], line->output_to - line->output_from);
    if (n >= 0) {
        line->output_from += (size_t)n;
        return true;
    }
    return is_transient();
}

#define WAIT_FOR_EVER (-1)

// ---------------------------------------------        THE LOOP        ---------------------------------------------

/// Lets the device work on what has come, as far as its answers have room.
static void work(device_t* const device, line_t* const line) {
    if (line->output_from == line->output_to) {
        line->output_from = 0U;
        line->output_to   = 0U;
    }
    const device_progress_t progress =
        device_run(device, &line->input[line->input_from], line->input_to - line->input_from,
                   &line->output[line->output_to], sizeof(line->output) - line->output_to);
    line->input_from += progress.taken;
    line->output_to += progress.given;
}

static bool has_output(const line_t* const line) { return line->output_from != line->output_to; }

/// New input is read only when the old is done with: until then it waits in the line, and its sender with it.
static bool wants_input(const device_t* const device, const line_t* const line) {
    return (line->input_from == line->input_to) && !device_is_busy(device);
}

/// True iff standard input has ended. What it says before does not matter.
static bool parent_is_gone(const short events) {
    char ignored[256];
    if ((events & (POLLIN | POLLHUP | POLLERR | POLLNVAL)) == 0) {
        return false;
    }
    const ssize_t n = read(STDIN_FILENO, ignored, sizeof(ignored));
    return (n == 0) || ((n < 0) && !is_transient());
}

/// Hung up, and nothing left to read.
static bool is_lost(const short events) {
    return ((events & (POLLHUP | POLLERR | POLLNVAL)) != 0) && ((events & POLLIN) == 0);
}

/// One turn: wait, move bytes, work. Returns false when it is over, with *ok telling whether that is well.
static bool turn(device_t* const device, line_t* const line, bool* const ok) {
    const short   in     = wants_input(device, line) ? POLLIN : 0;
    const short   out    = has_output(line) ? POLLOUT : 0;
    struct pollfd fds[2] = {
        { .fd = STDIN_FILENO, .events = POLLIN },
        { .fd = line->fd, .events = (short)(in | out) },
    };
    // Work that is left over while the output is empty waits for nobody.
    const int timeout_ms = ((in == 0) && (out == 0)) ? 0 : WAIT_FOR_EVER;
    if (poll(fds, 2, timeout_ms) < 0) {
        *ok = errno == EINTR;
        return *ok;
    }
    if (parent_is_gone(fds[0].revents)) {
        return false;
    }
    if (is_lost(fds[1].revents)) {
        errno = EIO;
        *ok   = false;
        return false;
    }
    if ((fds[1].revents & POLLOUT) != 0) {
        *ok = transmit(line);
    }
    if (*ok && (in != 0) && ((fds[1].revents & POLLIN) != 0)) {
        *ok = receive(line);
    }
    work(device, line);
    if (*ok && has_output(line) && (out == 0)) {
        *ok = transmit(line);  // at once, without another poll: the line is nearly always ready
    }
    return *ok;
}

static bool draw_nonce(uint32_t* const nonce) {
    const int     fd = open("/dev/urandom", O_RDONLY);
    const ssize_t n  = (fd >= 0) ? read(fd, nonce, sizeof(*nonce)) : -1;
    if (fd >= 0) {
        (void)close(fd);
    }
    return n == (ssize_t)sizeof(*nonce);
}

static int serve(const options_t* const options) {
    static device_t   device;
    static line_t     line;
    const char*       name     = (options->path != NULL) ? options->path : "a pseudo-terminal";
    device_identity_t identity = { .catalogue_hash = options->catalogue_hash,
                                   .input_blocks   = INPUT_SIZE / FRAME_SIZE(ANALOGRIG_SAMPLE_BLOCK_LENGTH),
                                   .firmware_id    = ANALOGRIG_FIRMWARE_FIRMWARE_ID_HOST_CHOICE };
    if (!draw_nonce(&identity.boot_nonce)) {
        return fail("cannot read", "/dev/urandom");
    }
    line.fd = (options->path != NULL) ? open_serial(options->path) : open_terminal();
    if (line.fd < 0) {
        return fail("cannot open", name);
    }
    device_init(&device, &identity);
    bool ok = true;
    while (turn(&device, &line, &ok)) {
    }
    return ok ? EXIT_SUCCESS : fail("lost", name);
}

int main(int argc, char* argv[]) {
    options_t options = { .path = NULL, .catalogue_hash = (uint32_t)ANALOGRIG_CATALOGUE_HASH };
    int       status  = EXIT_SUCCESS;
    return parse(argc, argv, &options, &status) ? serve(&options) : status;
}
