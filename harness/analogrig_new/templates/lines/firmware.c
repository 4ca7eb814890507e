/// A firmware that speaks lines of text, here as a program on a pseudo terminal. On a board, write the two functions
/// read_line and write_line for its UART.
///
///     line     answer
///     U,Y      ALARM,ARMED,STATISTIC,INNOVATION,A1,A2,B1,B2,D
///     -        the same: the sample is missing
///     R        OK: everything begins anew
#include "estimator.c"

#include <stdbool.h>
#include <stdio.h>

static rls_t estimator;

static bool read_line(char* const line, const size_t size) { return fgets(line, (int)size, stdin) != NULL; }

static void write_line(const char* const line) {
    (void)fputs(line, stdout);
    (void)fflush(stdout);  // the other end waits for each line
}

static void restart_all(void) {
    (void)memset(&estimator, 0, sizeof(estimator));
    (void)init(&estimator);
}

static void answer(const analogrig_in_t in) {
    analogrig_out_t out = { 0 };
    char            line[256];
    step(&estimator, &in, &out);
    int n = snprintf(line, sizeof(line), "%d,%d,%.9g,%.9g", out.alarm, out.armed, (double)out.statistic,
                     (double)out.innovation);
    for (int i = 0; i < N; i++) {
        n += snprintf(line + n, sizeof(line) - (size_t)n, ",%.9g", (double)out.theta[i]);
    }
    (void)snprintf(line + n, sizeof(line) - (size_t)n, "\n");
    write_line(line);
}

int main(void) {
    char line[64];
    restart_all();
    while (read_line(line, sizeof(line))) {
        int u = 0;
        int y = 0;
        if (sscanf(line, "%d,%d", &u, &y) == 2) {
            answer((analogrig_in_t){ .u = (float)u, .y = (float)y, .valid = 1U });
        } else if (line[0] == '-') {
            answer((analogrig_in_t){ .valid = 0U });
        } else if (line[0] == 'R') {
            restart_all();
            write_line("OK\n");
        } else {
            write_line("ERROR\n");
        }
    }
    return 0;
}
