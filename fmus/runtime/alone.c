/* No FMUs: what the loop asks of those in other processes and of those in model exchange, where there are none of them.

   It takes the place of `remote.c` and `model_exchange.c` in the unit of an exported diagram, where `loop.plants` is 0 and
   `hybrid.o` is NULL: nothing here is ever called, and a compiler leaves it out. It comes after `newton.c`. */

enum { IDLE };
typedef struct {
    int32_t state;
} remote;
typedef struct {
    int64_t late;
} apart;
typedef struct {
    int64_t none;
} quiet;

static inline void post(remote *r) { (void)r; }
static inline bool fill_all(const remote *r) { return (void)r, true; }
static inline bool is_quiet(const quiet *q, double now, double width) { return (void)q, (void)now, (void)width, false; }
static inline double begin_step(const quiet *q, double now, double width) { return (void)q, (void)width, now; }
static inline void tell_slopes(const quiet *q, double now) { (void)q, (void)now; }
static inline bool has_ended_loud(const quiet *q) { return (void)q, false; }
static inline bool take_reply(remote *r, apart *a) { return (void)r, (void)a, false; }
static inline bool spread_all(remote *r) { return (void)r, false; }
static inline void look_at_clock(apart *a) { (void)a; }

enum { TO_STEP, TO_EVENTS };
enum { FIRED = -1, INPUT };
typedef struct {
    int64_t states, first, event, acted, asks, ended;
} exchanged;
typedef struct {
    int64_t count, look, failed, logged, capacity;
    exchanged *each;
    apart *apart;
    double *log;
    tick jump;
} outside;

static inline double next_outside(const outside *o, double t) { return (void)o, (void)t, INFINITY; }
static inline bool has_ended(const outside *o) { return (void)o, false; }
static inline bool has_other_nominals(const outside *o) { return (void)o, false; }
