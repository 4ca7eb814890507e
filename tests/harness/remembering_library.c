// SPDX-License-Identifier: MIT
/// An estimator that counts samples in the place that its setting `place` selects. The count is its statistic, and a
/// record that finds anything but zero there is one that knows of an earlier record.
#include "analogrig_estimator.h"

#include <errno.h>
#include <fcntl.h>
#include <fenv.h>
#include <locale.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <unistd.h>

enum { GLOBAL, LOCAL, HEAP, ERRNO, LOCALE, OFFSET, EXIT, THREAD, PRNG, LINKED, ENVIRONMENT, FOLDER, SIGNAL, ROUNDING };
enum { LIMIT = ROUNDING + 1, MAPPING, INITS, TLS, STREAM };

typedef struct {
    int place;
} remembering_t;

unsigned other_library_count(void);  ///< of a second library, which this one links to

#ifdef OTHER_LIBRARY
unsigned other_library_count(void) {
    static unsigned n = 0U;
    return n++;
}
#else

static unsigned          global = 0U;
static __thread unsigned local  = 0U;
static unsigned*         heap   = NULL;
static unsigned*         shared = NULL;
static unsigned          inits  = 0U;
static unsigned          exits  = 0U;
static int               file   = -1;
static volatile unsigned ticks  = 0U;

#ifdef AT_LOAD
/// What a constructor opens is shared by all forks of a process.
__attribute__((constructor)) static void open_all(void) {
    char name[] = "/tmp/analogrig-test-XXXXXX";
    file        = mkstemp(name);
    (void)unlink(name);
    shared = (unsigned*)mmap(NULL, sizeof(*shared), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
}
#endif

static void* work(void* const unused) {
    ticks++;
    return unused;
}

static unsigned count_static(void) {
    static unsigned n = 0U;
    return n++;
}

static void at_exit(void) {}

static unsigned count_exits(void) {
    const unsigned before = exits++;
    (void)atexit(at_exit);
    return before;
}

static unsigned count_thread(void) {
    const unsigned before = ticks;
    pthread_t      thread;
    (void)pthread_create(&thread, NULL, work, NULL);
    (void)pthread_join(thread, NULL);
    return before;
}

static unsigned count_heap(void) {
    heap = (heap == NULL) ? (unsigned*)calloc(1U, sizeof(*heap)) : heap;
    return (*heap)++;
}

static unsigned count_errno(void) {
    const int before = errno;
    errno            = before + 1;
    return (unsigned)before;
}

static unsigned count_offset(void) {
    char one = 1;
    if (file < 0) {
        char name[] = "/tmp/analogrig-test-XXXXXX";
        file        = mkstemp(name);
        (void)unlink(name);
    }
    (void)!write(file, &one, 1U);
    return (unsigned)lseek(file, 0, SEEK_CUR) - 1U;
}

static unsigned count_mapping(void) {
    if (shared == NULL) {
        shared = (unsigned*)mmap(NULL, sizeof(*shared), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    }
    return (*shared)++;
}

static unsigned count_environment(void) {
    const char* const before = getenv("ANALOGRIG_TEST_COUNT");
    char              text[16];
    const unsigned    n = (before == NULL) ? 0U : (unsigned)atoi(before);
    (void)snprintf(text, sizeof(text), "%u", n + 1U);
    (void)setenv("ANALOGRIG_TEST_COUNT", text, 1);
    return n;
}

static unsigned was_in_root(void) {
    char           name[4096];
    const unsigned is_root = (getcwd(name, sizeof(name)) != NULL) && (strcmp(name, "/") == 0);
    (void)!chdir("/");
    return is_root;
}

static unsigned count_limit(void) {
    struct rlimit limit;
    (void)getrlimit(RLIMIT_NOFILE, &limit);
    const rlim_t before = limit.rlim_cur;
    limit.rlim_cur      = before - 1U;
    (void)setrlimit(RLIMIT_NOFILE, &limit);
    return (unsigned)(limit.rlim_max - before);
}

static unsigned count_stream(void) {
    static char buffer[4096];
    if (global++ == 0U) {
        (void)setvbuf(stderr, buffer, _IOFBF, sizeof(buffer));
    }
    (void)fputc('.', stderr);
    return global - 1U;
}

static unsigned count(const int place) {
    switch (place) {
    case GLOBAL:
        return global++;
    case LOCAL:
        return count_static();
    case HEAP:
        return count_heap();
    case ERRNO:
        return count_errno();
    case LOCALE: {
        const unsigned is_set = setlocale(LC_ALL, NULL)[1] == '.';  // "C.UTF-8" in place of "C"
        (void)setlocale(LC_ALL, "C.UTF-8");
        return is_set;
    }
    case OFFSET:
        return count_offset();
    case EXIT:
        return count_exits();
    case THREAD:
        return count_thread();
    case PRNG:
        return (unsigned)rand() % 1000003U;
    case LINKED:
        return other_library_count();
    case ENVIRONMENT:
        return count_environment();
    case FOLDER:
        return was_in_root();
    case SIGNAL:
        return (unsigned)(signal(SIGUSR1, SIG_IGN) == SIG_IGN);
    case ROUNDING: {
        const unsigned is_up = (unsigned)(fegetround() == FE_UPWARD);
        (void)fesetround(FE_UPWARD);
        return is_up;
    }
    case LIMIT:
        return count_limit();
    case MAPPING:
        return count_mapping();
    case INITS:
        return inits;
    case TLS:
        return local++;
    default:
        return count_stream();
    }
}

static int init(remembering_t* const self) {
    inits++;
    self->place = GLOBAL;
    return 0;
}

static int set(remembering_t* const self, const char* const name, const double value) {
    self->place = (int)value;
    return (strcmp(name, "place") == 0) ? 0 : 1;
}

static void step(remembering_t* const self, const analogrig_in_t* const in, analogrig_out_t* const out) {
    out->statistic = (float)count(self->place) + in->y;
}

ANALOGRIG_ESTIMATOR_WITH_SETTINGS(remembering_t, init, set, step, "remembering 1.0", 0, ANALOGRIG_STATISTIC);
#endif
