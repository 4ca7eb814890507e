// SPDX-License-Identifier: MIT
/// Guard of the exit status: a library in this process that calls exit() ends it with a status that is no success.

#include <stdbool.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define EXIT_INCONCLUSIVE 3

static volatile pid_t guarded = 0;  ///< process whose end by exit() is not in order; 0: none
static char           text[512];

static void write_text(const char* const part) { (void)!write(STDERR_FILENO, part, strlen(part)); }

static void on_exit_called(void) {
    if (guarded == getpid()) {  // and not a child of the library
        write_text("analogrig: INCONCLUSIVE: ");
        write_text(text);
        write_text(": called exit() in this process: run it in a process of its own, or correct it\n");
        _exit(EXIT_INCONCLUSIVE);
    }
}

/// Guard this process from now on. `library` is named in the message.
void exit_guard_arm(const char* const library) {
    static bool is_registered = false;
    (void)strncpy(text, library, sizeof(text) - 1U);
    guarded = getpid();
    if (!is_registered) {
        is_registered = (atexit(on_exit_called) == 0);
    }
}

/// Let this process end.
void exit_guard_disarm(void) { guarded = 0; }
