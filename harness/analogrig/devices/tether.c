/// analogrig-tether COMMAND [ARGUMENT...]: runs COMMAND, which cannot outlive whoever started this.
///
/// When standard input ends, for whatever reason, the command is ended: SIGTERM, and SIGKILL after a second. When this
/// program itself is killed, the kernel kills the command. When the command ends by itself, this program ends in the same
/// way, after passing on the last of what the command has said on standard error.

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

/// Of what the command says on standard error, the last so many bytes are kept: it may say any amount.
#define LAST_WORDS_MAX 2048U

typedef struct {
    char   bytes[2U * LAST_WORDS_MAX];
    size_t n;
} last_words_t;

static volatile sig_atomic_t command = 0;  ///< process number, for the handler

static int fail(const char* const what) {
    (void)fprintf(stderr, "analogrig-tether: %s: %s\n", what, strerror(errno));
    return EXIT_CANNOT_START;
}

static void on_child(const int signal_number) { (void)signal_number; }  // it is enough that pselect() returns

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

/// In the new process: becomes the command.
static int become(char* const argv[], const int said, const pid_t parent, const sigset_t* const mask) {
    if ((prctl(PR_SET_PDEATHSIG, SIGKILL) != 0) || (getppid() != parent)) {
        return fail("cannot tie the command to its parent");
    }
    if ((dup2(said, STDERR_FILENO) < 0) || (sigprocmask(SIG_SETMASK, mask, NULL) != 0) || !handle(SIGPIPE, SIG_DFL)) {
        return fail("cannot prepare the command");
    }
    (void)close(said);
    (void)execvp(argv[0], argv);
    return fail(argv[0]);
}

static bool is_transient(void) { return (errno == EAGAIN) || (errno == EINTR); }

/// False iff nothing more will come.
static bool listen_to(const int fd, last_words_t* const words) {
    if (words->n > LAST_WORDS_MAX) {
        const size_t excess = words->n - LAST_WORDS_MAX;
        (void)memmove(words->bytes, &words->bytes[excess], LAST_WORDS_MAX);
        words->n = LAST_WORDS_MAX;
    }
    const ssize_t n = read(fd, &words->bytes[words->n], LAST_WORDS_MAX);
    if (n > 0) {
        words->n += (size_t)n;
    }
    return (n > 0) || ((n < 0) && is_transient());
}

/// What it says there does not matter. False iff it has ended.
static bool is_held(void) {
    char          ignored[256];
    const ssize_t n = read(STDIN_FILENO, ignored, sizeof(ignored));
    return (n > 0) || ((n < 0) && is_transient());
}

/// Until the command has ended; returns how.
static int watch(const int said, last_words_t* const words, const sigset_t* const mask) {
    bool held      = true;
    bool listening = true;
    int  status    = 0;
    while (waitpid((pid_t)command, &status, WNOHANG) == 0) {
        fd_set readable;
        FD_ZERO(&readable);
        if (held) {
            FD_SET(STDIN_FILENO, &readable);
        }
        if (listening) {
            FD_SET(said, &readable);
        }
        if (pselect(said + 1, &readable, NULL, NULL, NULL, mask) < 0) {
            continue;  // the command has ended, or was killed
        }
        if (listening && FD_ISSET(said, &readable)) {
            listening = listen_to(said, words);
        }
        if (held && FD_ISSET(STDIN_FILENO, &readable)) {
            held = is_held();
            if (!held) {
                (void)kill((pid_t)command, SIGTERM);
                (void)alarm(GRACE_S);
            }
        }
    }
    return status;
}

/// What is left in the pipe; whoever else still holds its other end is not waited for.
static void listen_to_the_rest(const int said, last_words_t* const words) {
    fd_set               readable;
    const struct timeval at_once = { 0 };
    for (;;) {
        struct timeval timeout = at_once;
        FD_ZERO(&readable);
        FD_SET(said, &readable);
        if ((select(said + 1, &readable, NULL, NULL, &timeout) != 1) || !listen_to(said, words)) {
            return;
        }
    }
}

static int end_as(const int status, const sigset_t* const mask) {
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
    static last_words_t words;
    const pid_t         self = getpid();
    int                 said[2];
    sigset_t            child;
    sigset_t            mask;
    if (argc < 2) {
        (void)fputs("usage: analogrig-tether COMMAND [ARGUMENT...]\n", stderr);
        return EXIT_USAGE;
    }
    (void)sigemptyset(&child);
    (void)sigaddset(&child, SIGCHLD);
    if ((pipe(said) != 0) || (sigprocmask(SIG_BLOCK, &child, &mask) != 0) || !handle(SIGCHLD, on_child) ||
        !handle(SIGALRM, on_alarm) || !handle(SIGPIPE, SIG_IGN)) {
        return fail("cannot prepare");
    }
    const pid_t pid = fork();
    if (pid < 0) {
        return fail("cannot fork");
    }
    if (pid == 0) {
        (void)close(said[0]);
        return become(&argv[1], said[1], self, &mask);
    }
    command = (sig_atomic_t)pid;
    (void)close(said[1]);
    const int status = watch(said[0], &words, &mask);
    listen_to_the_rest(said[0], &words);
    (void)!write(STDERR_FILENO, words.bytes, words.n);
    return end_as(status, &mask);
}
