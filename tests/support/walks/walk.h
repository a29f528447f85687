/* What both walks share: states of an instance, rows of a table of calls, and the loop over both.
 *
 * A row has a call, the states in which the standard allows it with these arguments (it must succeed there), and those in
 * which this FMU may do either. Everywhere else it must return an error. The sanitizers watch. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { I = 1, N = 2, E = 4, S = 8, C = 16, T = 32, ALL = 63, NONE = 0 }; /* Instantiated, Initialization Mode, Event Mode,
    Step Mode, Continuous-Time Mode, Terminated */
static const char *const state_names[] = {"Instantiated", "Initialization Mode", "Event Mode", "Step Mode",
                                          "Continuous-Time Mode", "Terminated"};

typedef enum { STEPPED, EVENTFUL, EXCHANGED } interface; /* Co-Simulation, with Event Mode, Model Exchange */
static const char *const interface_names[] = {"Co-Simulation", "Co-Simulation with Event Mode", "Model Exchange"};

typedef struct {
    const char *name;
    int (*call)(void *instance);
    int stepped, exchanged, either; /* states in which it succeeds: in Co-Simulation, in Model Exchange; where it may */
} row;

static int failures, calls, messages;

static void expect(bool holds, const char *what, const char *name, interface kind, int state) {
    calls++;
    if (holds) return;
    failures++;
    int i = 0;
    while (state >> (i + 1)) i++;
    printf("%s: %s in %s, %s\n", name, what, state_names[i], interface_names[kind]);
}
