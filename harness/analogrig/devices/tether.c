/// analogrig-tether [--stdio IN OUT] COMMAND [ARGUMENT...]: runs COMMAND and ends it when the parent process ends.
///
/// With --stdio, the inherited descriptors IN and OUT are the command's standard input and output.
/// The end of standard input ends the command, by SIGTERM and a second later by SIGKILL. If this program is killed, the
/// kernel kills the command. If the command ends by itself, this program writes the last part of the command's standard
/// error, and exits with the same status or signal. Processes that the command left behind are killed.

#include <errno.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/select.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

#define EXIT_USAGE 2
#define EXIT_CANNOT_START 127
#define GRACE_S 1U
#define DESCENDANTS_MAX 10000U
#define NO_STDIO (-1)

/// Bytes of the command's standard error that are kept. The command may write any amount.
#define TAIL_MAX 2048U

typedef struct {
    char   bytes[2U * TAIL_MAX];
    size_t n;
} tail_t;

static volatile sig_atomic_t command = 0;  ///< process id, for the signal handler

static int fail(const char* const what) {
    (void)fprintf(stderr, "analogrig-tether: %s: %s\n", what, strerror(errno));
    return EXIT_CANNOT_START;
}

static void on_child(const int signal_number) { (void)signal_number; }  // only has to interrupt pselect()

static void on_alarm(const int signal_number) {
    (void)signal_number;
    (void)kill((pid_t)command, SIGKILL);
}

static bool handle(const int signal_number, void (*const handler)(int)) {
    struct sigaction action;
    (void)memset(&action, 0, sizeof(action));
    action.sa_handler = handler;
    return sigaction(signal_number, &action, NULL) == 0;
}

/// Descriptors that become the standard input and output of the command; NO_STDIO leaves both.
typedef struct {
    int in;
    int out;
} stdio_t;

static void close_stdio(const stdio_t stdio) {
    if (stdio.in != NO_STDIO) {
        (void)close(stdio.in);
        (void)close(stdio.out);  // fails if it is the same
    }
}

static bool redirect(const stdio_t stdio) {
    const bool done =
        (stdio.in == NO_STDIO) || ((dup2(stdio.in, STDIN_FILENO) >= 0) && (dup2(stdio.out, STDOUT_FILENO) >= 0));
    close_stdio(stdio);
    return done;
}

/// Execute the command, in the child process. Returns the exit status only on failure.
static int
execute(char* const argv[], const stdio_t stdio, const int errors, const pid_t parent, const sigset_t* const mask) {
    if ((prctl(PR_SET_PDEATHSIG, SIGKILL) != 0) || (getppid() != parent) || (setpgid(0, 0) != 0)) {
        return fail("cannot tie the command to its parent");
    }
    if (!redirect(stdio)) {
        return fail("cannot redirect the command");
    }
    if ((dup2(errors, STDERR_FILENO) < 0) || (sigprocmask(SIG_SETMASK, mask, NULL) != 0) || !handle(SIGPIPE, SIG_DFL)) {
        return fail("cannot prepare the command");
    }
    (void)close(errors);
    (void)execvp(argv[0], argv);
    return fail(argv[0]);
}

static bool is_transient(void) { return (errno == EAGAIN) || (errno == EINTR); }

/// Read into the tail. False iff the pipe has ended.
static bool read_tail(const int fd, tail_t* const tail) {
    if (tail->n > TAIL_MAX) {
        const size_t excess = tail->n - TAIL_MAX;
        (void)memmove(tail->bytes, &tail->bytes[excess], TAIL_MAX);
        tail->n = TAIL_MAX;
    }
    const ssize_t n = read(fd, &tail->bytes[tail->n], TAIL_MAX);
    if (n > 0) {
        tail->n += (size_t)n;
    }
    return (n > 0) || ((n < 0) && is_transient());
}

/// Discard input. False iff standard input has ended.
static bool read_input(void) {
    char          ignored[256];
    const ssize_t n = read(STDIN_FILENO, ignored, sizeof(ignored));
    return (n > 0) || ((n < 0) && is_transient());
}

/// Wait for the end of the command; return its wait status.
static int watch(const int errors, tail_t* const tail, const sigset_t* const mask) {
    bool input_open = true;
    bool error_open = true;
    int  status     = 0;
    while (waitpid((pid_t)command, &status, WNOHANG) == 0) {
        fd_set readable;
        FD_ZERO(&readable);
        if (input_open) {
            FD_SET(STDIN_FILENO, &readable);
        }
        if (error_open) {
            FD_SET(errors, &readable);
        }
        if (pselect(errors + 1, &readable, NULL, NULL, NULL, mask) < 0) {
            continue;  // interrupted by a signal: check the command
        }
        if (error_open && FD_ISSET(errors, &readable)) {
            error_open = read_tail(errors, tail);
        }
        if (input_open && FD_ISSET(STDIN_FILENO, &readable)) {
            input_open = read_input();
            if (!input_open) {
                (void)kill((pid_t)command, SIGTERM);
                (void)alarm(GRACE_S);
            }
        }
    }
    return status;
}

/// Read the rest of the pipe, without waiting for other processes that hold its write end.
static void drain(const int errors, tail_t* const tail) {
    fd_set               readable;
    const struct timeval no_wait = { 0 };
    for (;;) {
        struct timeval timeout = no_wait;
        FD_ZERO(&readable);
        FD_SET(errors, &readable);
        if ((select(errors + 1, &readable, NULL, NULL, &timeout) != 1) || !read_tail(errors, tail)) {
            return;
        }
    }
}

/// Kill what the command left behind: its process group, and the processes that have left the group. The kernel gives
/// those to this process as soon as their parents end.
static void end_descendants(const pid_t pid) {
    char path[64];
    long child = 0;
    (void)kill(-pid, SIGKILL);  // ESRCH if there are none
    (void)snprintf(path, sizeof(path), "/proc/self/task/%ld/children", (long)getpid());
    for (unsigned i = 0U; i < DESCENDANTS_MAX; i++) {
        FILE* const children = fopen(path, "re");
        const bool  is_found = (children != NULL) && (fscanf(children, "%ld", &child) == 1);
        if (children != NULL) {
            (void)fclose(children);
        }
        if (!is_found) {
            return;
        }
        (void)kill((pid_t)child, SIGKILL);
        (void)waitpid((pid_t)child, NULL, 0);
    }
}

static int exit_like(const int status, const sigset_t* const mask) {
    if (!WIFSIGNALED(status)) {
        return WEXITSTATUS(status);
    }
    const struct rlimit no_core = { 0 };
    (void)setrlimit(RLIMIT_CORE, &no_core);
    (void)handle(WTERMSIG(status), SIG_DFL);
    (void)sigprocmask(SIG_SETMASK, mask, NULL);
    (void)raise(WTERMSIG(status));
    return EXIT_FAILURE;
}

int main(const int argc, char* argv[]) {
    static tail_t tail;
    const pid_t   self = getpid();
    int           errors[2];
    sigset_t      child;
    sigset_t      mask;
    const bool    redirects = (argc > 3) && (strcmp(argv[1], "--stdio") == 0);
    const stdio_t stdio     = { redirects ? atoi(argv[2]) : NO_STDIO, redirects ? atoi(argv[3]) : NO_STDIO };
    char** const  arguments = &argv[redirects ? 4 : 1];
    if (*arguments == NULL) {
        (void)fputs("usage: analogrig-tether [--stdio IN OUT] COMMAND [ARGUMENT...]\n", stderr);
        return EXIT_USAGE;
    }
    (void)sigemptyset(&child);
    (void)sigaddset(&child, SIGCHLD);
    if ((pipe(errors) != 0) || (sigprocmask(SIG_BLOCK, &child, &mask) != 0) || !handle(SIGCHLD, on_child) ||
        !handle(SIGALRM, on_alarm) || !handle(SIGPIPE, SIG_IGN)) {
        return fail("cannot prepare");
    }
    (void)prctl(PR_SET_CHILD_SUBREAPER, 1);
    const pid_t pid = fork();
    if (pid < 0) {
        return fail("cannot fork");
    }
    if (pid == 0) {
        (void)close(errors[0]);
        return execute(arguments, stdio, errors[1], self, &mask);
    }
    command = (sig_atomic_t)pid;
    (void)close(errors[1]);
    close_stdio(stdio);
    const int status = watch(errors[0], &tail, &mask);
    end_descendants(pid);  // which hold its descriptors
    drain(errors[0], &tail);
    (void)!write(STDERR_FILENO, tail.bytes, tail.n);
    return exit_like(status, &mask);
}
