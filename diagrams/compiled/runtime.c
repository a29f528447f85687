/* The runtime library: the loops over ticks and time, their methods and events, and the virtual machine.

   It knows no diagram. It is compiled when the package is installed, else by the first run that needs it. */
#include "newton.c"
#include "machine.c"
#include "remote.c"
#include "master.c"
#include "exchange.c"
#include "problem.c"
#include "methods.c"
#include "radau.c"
#include "events.c"
#include "instants.c"
#include "hybrid.c"
