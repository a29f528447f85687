/* stdio.h of a WebAssembly module, which has no C library: nobody reads messages there. */
#ifndef LW_STDIO_H
#define LW_STDIO_H

#include <stdarg.h>
#include <stddef.h>

#define snprintf(...) 0
#define vsnprintf(...) 0
#endif
