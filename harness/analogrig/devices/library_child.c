// SPDX-License-Identifier: MIT
/// analogrig-library LIBRARY SOCKET MEMORY SLOTS SAMPLES_BYTES RECORDS_BYTES: calls a library of analogrig_estimator.h,
/// whose crash ends this process only.
///
/// SOCKET is a descriptor of a SOCK_SEQPACKET socket, MEMORY that of the memory shared with the parent process. It holds
/// SLOTS times SAMPLES_BYTES of samples, and then SLOTS times RECORDS_BYTES of records. The first message is the
/// library's hello_t, or the text of an error. Each request has one reply, in order.
///
/// This process loads the library and never calls it. Each record runs in a child forked from it, so no memory of an
/// earlier record is left. The child that finds the request for the next record leaves it in the socket and ends.

#include "analogrig_estimator.h"

#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <fenv.h>
#include <signal.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#define EXIT_USAGE 2
#define EXIT_CANNOT_PREPARE 3
#define EXIT_NO_SOCKET 4
#define EXIT_FORKED 5

#define SLOTS_MAX 8U
#define TEXT_MAX 1024U
#define STATE_ALIGNMENT 64U
#define CANARY 0xA5U

#define SETTINGS_MAX 256U
#define WORDS_MAX 65536U

/// Samples for analogrig_step(); n = 0 stands for analogrig_init() of a new record.
typedef struct {
    uint64_t n;
    uint32_t slot;
    uint32_t stride;
    char     words[WORDS_MAX];  ///< NAME=VALUE of each setting, for analogrig_init() only; each ends with a zero
} request_t;

#define REQUEST_SIZE offsetof(request_t, words)

typedef struct {
    int64_t result;      ///< of analogrig_init()
    int64_t is_overrun;  ///< 1: the library wrote beyond the end of its state
} reply_t;

/// analogrig_about_t with its name in place.
typedef struct {
    uint32_t abi;
    uint32_t theta_n;
    uint64_t state_bytes;
    uint32_t reports;
    char     name[TEXT_MAX];  ///< which makes it longer than any text of an error
    uint32_t is_single;       ///< 1: the process can serve one record only
} hello_t;

typedef struct {
    const analogrig_about_t* (*about)(void);
    int (*init)(void*, const analogrig_setting_t*, size_t);
    void (*step)(void*, size_t, const analogrig_in_t*, void*, size_t);
} library_t;

typedef struct {
    size_t      slots_n;
    const void* samples[SLOTS_MAX];
    void*       records[SLOTS_MAX];
} memory_t;

/// Things of a process that its forked children share with it, in place of a copy, or lack.
typedef struct {
    size_t threads;
    size_t descriptors;
    size_t shared_mappings;
} shared_t;

static int fail(const char* const what) {
    (void)fprintf(stderr, "analogrig-library: %s: %s\n", what, strerror(errno));
    exit(EXIT_CANNOT_PREPARE);
}

/// Send a message. If that fails, the parent has gone or the library has closed the socket, and perhaps standard error.
static void send_to_parent(const int fd, const void* const message, const size_t size) {
    if (send(fd, message, size, MSG_NOSIGNAL) < 0) {
        exit(EXIT_NO_SOCKET);
    }
}

/// End with a text for the parent.
static void refuse(const int fd, const char* const text) {
    send_to_parent(fd, text, strnlen(text, TEXT_MAX));
    exit(EXIT_SUCCESS);
}

/// Memory between two pages whose access ends this process. A negative `fd` stands for memory that is not shared.
static void* map_guarded(const int fd, const size_t offset, const size_t size, const int protection) {
    const size_t page  = (size_t)sysconf(_SC_PAGESIZE);
    const int    kind  = (fd < 0) ? (MAP_PRIVATE | MAP_ANONYMOUS) : MAP_SHARED;
    char* const  guard = (char*)mmap(NULL, size + (2U * page), PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if ((guard == MAP_FAILED) ||
        (mmap(guard + page, size, protection, kind | MAP_FIXED, fd, (off_t)offset) == MAP_FAILED)) {
        (void)fail("cannot map memory");
    }
    return guard + page;
}

static size_t round_up(const size_t size, const size_t unit) { return ((size + unit - 1U) / unit) * unit; }

/// Size of a state with the canary that fills it to its alignment.
static size_t padded(const size_t state_bytes) {
    return round_up((state_bytes > 0U) ? state_bytes : 1U, STATE_ALIGNMENT);
}

/// State that ends at a guard page, but for its canary.
static unsigned char* map_state(const size_t state_bytes) {
    const size_t pages = round_up(padded(state_bytes), (size_t)sysconf(_SC_PAGESIZE));
    return (unsigned char*)map_guarded(-1, 0U, pages, PROT_READ | PROT_WRITE) + (pages - padded(state_bytes));
}

/// All zeros, with the canary behind them.
static void clear(unsigned char* const state, const size_t state_bytes) {
    (void)memset(state, 0, state_bytes);
    (void)memset(state + state_bytes, (int)CANARY, padded(state_bytes) - state_bytes);
}

static bool is_overrun(const unsigned char* const state, const size_t state_bytes) {
    for (size_t i = state_bytes; i < padded(state_bytes); i++) {
        if (state[i] != CANARY) {
            return true;
        }
    }
    return false;
}

static memory_t map_slots(const int fd, const size_t slots_n, const size_t samples_bytes, const size_t records_bytes) {
    memory_t memory = { .slots_n = slots_n };
    for (size_t i = 0U; i < slots_n; i++) {
        const size_t records = (slots_n * samples_bytes) + (i * records_bytes);
        memory.samples[i]    = map_guarded(fd, i * samples_bytes, samples_bytes, PROT_READ);
        memory.records[i]    = map_guarded(fd, records, records_bytes, PROT_READ | PROT_WRITE);
    }
    return memory;
}

/// The function `name` of a library. ISO C cannot convert an object pointer to a function pointer.
static bool find(void* const handle, const char* const name, void* const function) {
    void* const found = dlsym(handle, name);
    (void)memcpy(function, &found, sizeof(found));
    return found != NULL;
}

static library_t load(const char* const path, const int fd) {
    library_t   library = { 0 };
    char        text[TEXT_MAX];
    void* const handle = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (handle == NULL) {
        refuse(fd, dlerror());
    }
    const char* const missing = !find(handle, "analogrig_about", &library.about) ? "analogrig_about"
                                : !find(handle, "analogrig_init", &library.init) ? "analogrig_init"
                                : !find(handle, "analogrig_step", &library.step) ? "analogrig_step"
                                                                                 : NULL;
    if (missing != NULL) {
        (void)snprintf(text, sizeof(text), "lacks the function %s of analogrig_estimator.h", missing);
        refuse(fd, text);
    }
    return library;
}

static size_t count_entries(const char* const path) {
    size_t     n      = 0U;
    DIR* const folder = opendir(path);
    while ((folder != NULL) && (readdir(folder) != NULL)) {
        n++;
    }
    if (folder != NULL) {
        (void)closedir(folder);
    }
    return n;
}

/// Mappings whose fourth permission is `s`, such as the second line of: 7f00-7f01 rw-p ..., 7f02-7f03 rw-s ...
static size_t count_shared_mappings(void) {
    size_t      n = 0U;
    char        line[4096];
    char        permissions[5];
    FILE* const maps = fopen("/proc/self/maps", "re");
    while ((maps != NULL) && (fgets(line, sizeof(line), maps) != NULL)) {
        n += ((sscanf(line, "%*s %4s", permissions) == 1) && (permissions[3] == 's')) ? 1U : 0U;
    }
    if (maps != NULL) {
        (void)fclose(maps);
    }
    return n;
}

static shared_t count_shared(void) {
    return (shared_t){ .threads         = count_entries("/proc/self/task"),
                       .descriptors     = count_entries("/proc/self/fd"),
                       .shared_mappings = count_shared_mappings() };
}

/// Greet the parent. Of another ABI nothing but its number is known.
static uint64_t greet(const library_t* const library, const int fd, const bool is_single) {
    const analogrig_about_t* const about = library->about();
    hello_t                        hello = { .is_single = is_single ? 1U : 0U };
    if (about == NULL) {
        refuse(fd, "analogrig_about returned a null pointer");
    }
    hello.abi = about->abi;
    if (about->abi == ANALOGRIG_ABI) {
        hello.theta_n     = about->theta_n;
        hello.state_bytes = about->state_bytes;
        hello.reports     = about->reports;
        if (about->name != NULL) {
            (void)strncpy(hello.name, about->name, sizeof(hello.name) - 1U);
        }
    }
    send_to_parent(fd, &hello, sizeof(hello));
    return hello.state_bytes;
}

/// Settings from the words of a request of `size` bytes, which are cut at their equals signs; returns their number.
static size_t parse(request_t* const request, const size_t size, analogrig_setting_t* const settings) {
    size_t n   = 0U;
    char*  end = (char*)request + size;
    for (char* word = request->words; (word < end) && (n < SETTINGS_MAX); n++) {
        char* const next   = word + strnlen(word, (size_t)(end - word)) + 1;
        char* const equals = strchr(word, '=');
        if (equals == NULL) {
            break;
        }
        *equals     = '\0';
        settings[n] = (analogrig_setting_t){ .name = word, .value = strtod(equals + 1, NULL) };
        word        = next;
    }
    return n;
}

/// Standard input is empty. Standard output goes to standard error, whose end the parent quotes.
static void redirect(void) {
    const int nothing = open("/dev/null", O_RDWR | O_CLOEXEC);
    if ((nothing < 0) || (dup2(nothing, STDIN_FILENO) < 0) || (dup2(STDERR_FILENO, STDOUT_FILENO) < 0)) {
        (void)fail("cannot redirect standard streams");
    }
}

/// Serve one record; returns at the end of the socket, or if the next record was requested.
static void serve_record(const library_t* const library,
                         const int              fd,
                         const memory_t* const  memory,
                         const size_t           state_bytes,
                         volatile bool* const   is_next) {
    static request_t           request;
    static analogrig_setting_t settings[SETTINGS_MAX];
    const pid_t                self  = getpid();
    unsigned char* const       state = map_state(state_bytes);
    for (bool is_begun = false;; is_begun = true) {
        reply_t reply = { 0 };
        (void)recv(fd, &request, REQUEST_SIZE, MSG_PEEK);
        if (is_begun && (request.n == 0U)) {
            *is_next = true;
            return;
        }
        const ssize_t size = recv(fd, &request, sizeof(request) - 1U, 0);
        if (size < (ssize_t)REQUEST_SIZE) {
            return;
        }
        (void)fesetenv(FE_DFL_ENV);  // a library built with -ffast-math turns off denormals when it is loaded
        if (request.n == 0U) {
            clear(state, state_bytes);
            const size_t settings_n = parse(&request, (size_t)size, settings);
            reply.result            = library->init(state, settings, settings_n);
        } else if (is_begun && (request.slot < memory->slots_n)) {
            library->step(state, (size_t)request.n, memory->samples[request.slot], memory->records[request.slot],
                          request.stride);
        } else {
            _exit(EXIT_USAGE);
        }
        if (getpid() != self) {
            _exit(EXIT_FORKED);  // a child of the library would take requests from it
        }
        reply.is_overrun = is_overrun(state, state_bytes) ? 1 : 0;
        send_to_parent(fd, &reply, sizeof(reply));
    }
}

/// Serve one record in a child. Its end by itself ends this process in the same way.
static void fork_record(const library_t* const library,
                        const int              fd,
                        const memory_t* const  memory,
                        const size_t           state_bytes,
                        volatile bool* const   is_next) {
    const pid_t            self    = getpid();
    const struct sigaction on_wait = { .sa_handler = SIG_DFL };  // the library may ignore SIGCHLD: waitpid would fail
    struct sigaction       theirs;
    int                    status = 0;
    *is_next                      = false;
    (void)sigaction(SIGCHLD, &on_wait, &theirs);
    const pid_t pid = fork();
    if (pid < 0) {
        (void)fail("cannot fork");
    }
    if (pid == 0) {
        (void)sigaction(SIGCHLD, &theirs, NULL);
        if ((prctl(PR_SET_PDEATHSIG, SIGKILL) == 0) && (getppid() == self)) {
            serve_record(library, fd, memory, state_bytes, is_next);
        }
        _exit(EXIT_SUCCESS);  // without the library's handlers of exit(): this is the end of a record
    }
    while ((waitpid(pid, &status, 0) < 0) && (errno == EINTR)) {
    }
    (void)sigaction(SIGCHLD, &theirs, NULL);
    if (*is_next) {
        return;
    }
    if (WIFSIGNALED(status)) {
        (void)signal(WTERMSIG(status), SIG_DFL);
        (void)raise(WTERMSIG(status));
    }
    _exit(WEXITSTATUS(status));
}

int main(const int argc, char* argv[]) {
    const struct rlimit no_core = { 0 };
    if (argc != 7) {
        (void)fputs("usage: analogrig-library LIBRARY SOCKET MEMORY SLOTS SAMPLES_BYTES RECORDS_BYTES\n", stderr);
        return EXIT_USAGE;
    }
    const int    fd            = atoi(argv[2]);
    const int    shared        = atoi(argv[3]);
    const size_t slots_n       = (size_t)strtoul(argv[4], NULL, 10);
    const size_t samples_bytes = (size_t)strtoul(argv[5], NULL, 10);
    const size_t records_bytes = (size_t)strtoul(argv[6], NULL, 10);
    if (slots_n > SLOTS_MAX) {
        return EXIT_USAGE;
    }
    redirect();
    (void)setrlimit(RLIMIT_CORE, &no_core);  // to write one takes longer than all else
    const memory_t memory = map_slots(shared, slots_n, samples_bytes, records_bytes);
    volatile bool* is_next =
        (volatile bool*)mmap(NULL, sizeof(bool), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    const shared_t  before  = count_shared();
    const pid_t     self    = getpid();
    const library_t library = load(argv[1], fd);
    if (getpid() != self) {
        _exit(EXIT_FORKED);
    }
    const shared_t after     = count_shared();
    const bool     is_single = memcmp(&before, &after, sizeof(before)) != 0;
    if (is_next == MAP_FAILED) {
        return fail("cannot map memory");
    }
    const size_t state_bytes = (size_t)greet(&library, fd, is_single);
    char         first;
    while (recv(fd, &first, sizeof(first), MSG_PEEK) > 0) {
        if (is_single) {
            serve_record(&library, fd, &memory, state_bytes, is_next);
            return EXIT_SUCCESS;
        }
        fork_record(&library, fd, &memory, state_bytes, is_next);
    }
    return EXIT_SUCCESS;
}
