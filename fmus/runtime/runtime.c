/* The runtime library: the loops over ticks and time, their methods and events, the virtual machine, and the other side
   of FMUs in their own processes.

   It knows no diagram. It is compiled when the package is installed, else by the first run that needs it. */
#include "newton.c"
#include "machine.c"
#include "grouped.c"
#include "remote.c"
#include "child.c"
#include "loop_over_ticks.c"
#include "model_exchange.c"
#include "problem.c"
#include "delays.c"
#include "methods.c"
#include "radau.c"
#include "event_search.c"
#include "instants.c"
#include "loop_over_time.c"
