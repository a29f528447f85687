/* A hostile FMU of FMI 2.0 or 3.0 for co-simulation and model exchange: y is the integral of u. One fault, at one place, from one
   time on, stands in a text of the library that the test writes over: "place fault time". */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <fenv.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#define API __attribute__((visibility("default")))
#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#if FMI == 2
#define F(name) API int JOIN(fmi2, name)
#define STATE(verb) API int fmi2##verb##FMUstate
typedef void (*logger)(void *, const char *, int, const char *, const char *, ...);
typedef struct { logger log; void *allocate, *release, *finished, *environment; } callbacks;
#define LOG(c, status, text) (c)->log((c)->environment, "zoo", status, "logAll", text)
#else
#define F(name) API int JOIN(fmi3, name)
#define STATE(verb) API int fmi3##verb##FMUState
typedef void (*logger)(void *, int, const char *, const char *);
#define LOG(c, status, text) (c)->log((c)->environment, status, "logAll", text)
#endif

typedef struct { double u, y, p, t, slope, seen; bool running; logger log; void *environment; } instance;
static volatile char setting[128] = "@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@@";
static instance *last;
static void *volatile sink; /* else the compiler leaves allocations out */

static void nap(double s) { struct timespec w = {(time_t)s, (long)(fmod(s, 1.0) * 1e9)}; nanosleep(&w, NULL); }
static int deeper(volatile char *above) { volatile char frame[4096]; frame[0] = above[0]; return deeper(frame) + frame[0]; }
static void *log_a_little(void *c) { for (int i = 0; i < 20; i++) LOG((instance *)c, 1, "from a thread"); return NULL; }
static void *log_for_ever(void *c) { for (;;) { LOG((instance *)c, 1, "from a thread"); nap(1e-3); } return NULL; }
static void *crash_later(void *c) { nap(0.05); *(volatile int *)8 = 1; return c; }

/* Count a call in the file that the test shares by ZOO_MEETING; where it meets, wait for the other call of its pair. */
static int count_in(bool meets) {
    static atomic_int *calls;
    const char *name = getenv("ZOO_MEETING");
    if (!name) return 0;
    if (!calls) {
        int file = open(name, O_RDWR);
        void *at = file < 0 ? MAP_FAILED : mmap(NULL, sizeof *calls, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
        if (file >= 0) close(file);
        if (at == MAP_FAILED) return 3;
        calls = at;
    }
    int number = atomic_fetch_add(calls, 1) + 1, pair = (number + 1) / 2 * 2;
    for (int i = 0; meets && atomic_load(calls) < pair; i++) { if (i > 60000) return 3; nap(1e-3); }
    return 0;
}

static bool match(const char *here, double t, char fault[64]) {
    char text[128], place[64] = ""; double from = 0.0; fault[0] = 0;
    for (size_t i = 0; i < sizeof text; i++) text[i] = setting[i];
    sscanf(text, "%63s %63s %lf", place, fault, &from);
    return !strcmp(place, here) && t >= from - 1e-9;
}

/* Do the fault of a place; return the status of the function there. */
static int act(const char *here, instance *c, double t) {
    char f[64]; pthread_t thread;
    if (!match(here, t, f)) return 0;
#define IS(name) (!strcmp(f, name))
    if (IS("segfault")) *(volatile int *)8 = 1;
    if (IS("bus")) raise(SIGBUS);
    if (IS("illegal")) raise(SIGILL);
    if (IS("divide")) raise(SIGFPE);
    if (IS("abort")) abort();
    if (IS("exit")) exit(3);
    if (IS("exit0")) exit(0);
    if (IS("quick_exit")) _exit(0);
    if (IS("kill")) raise(SIGKILL);
    if (IS("stop")) raise(SIGSTOP);
    if (IS("stack")) deeper("");
    if (IS("scribble")) memset(c, 0x41, 1 << 28);
    if (IS("hang")) for (;;) pause();
    if (IS("spin")) for (volatile int i = 0;; i++) {}
    if (IS("deaf_hang")) { signal(SIGTERM, SIG_IGN); signal(SIGINT, SIG_IGN); count_in(false); for (;;) pause(); }
    if (IS("slow")) { nap(0.02); return count_in(false); }
    if (IS("count")) return count_in(false);
    if (IS("meet")) return count_in(true);
    if (IS("print")) puts("step by 0.01");
    if (IS("log_hang")) { log_a_little(c); for (;;) pause(); }
    if (IS("memory")) for (;;) sink = memset(malloc(1 << 24), 1, 1 << 24);
    if (IS("no_memory")) for (;;) { void *m = malloc(1 << 20); if (!m) return 3; sink = m; }
    if (IS("leak")) sink = memset(malloc(1 << 20), 1, 1 << 20);
    if (IS("handles")) open("/dev/null", O_RDONLY);
    if (IS("fork") && !fork()) { for (;;) pause(); }
    if (IS("fork_on")) fork();
    if (IS("fork_exit") && !fork()) exit(0);
    if (IS("thread")) { pthread_create(&thread, NULL, log_a_little, c); pthread_join(thread, NULL); }
    if (IS("thread_on")) { pthread_create(&thread, NULL, log_for_ever, c); nap(5e-3); }
    if (IS("thread_crash")) { pthread_create(&thread, NULL, crash_later, c); nap(0.1); }
    if (IS("flood_log")) for (int i = 0; i < 200000; i++) LOG(c, 1, "again and again and again and again and again");
    if (IS("huge_log")) { char *s = malloc(1 << 24); memset(s, 'x', 1 << 24); s[(1 << 24) - 1] = 0; LOG(c, 1, s); free(s); }
    if (IS("odd_log")) LOG(c, 3, "\xff\xfe 100 %s%n%n%s%d \x1b[2J");
    if (IS("flood_stdout")) for (int i = 0; i < 500000; i++) { puts("out out out out out out out out out out"); fputs("err\n", stderr); }
    if (IS("close_stdout")) { close(1); close(2); }
    if (IS("close_all")) for (int i = 0; i < 256; i++) close(i);
    if (IS("chdir") && chdir("/")) return 3;
    if (IS("rounding")) fesetround(FE_UPWARD);
    if (IS("traps")) { feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW); }
    if (IS("divide_trapped")) { feenableexcept(FE_DIVBYZERO); volatile double z = 0.0; c->y += 1.0 / z; }
    if (IS("sigmask")) { sigset_t all; sigfillset(&all); sigprocmask(SIG_BLOCK, &all, NULL); }
    if (IS("sigint")) { signal(SIGINT, SIG_IGN); signal(SIGTERM, SIG_IGN); signal(SIGCHLD, SIG_IGN); }
    if (IS("umask")) umask(0777);
    if (IS("environment")) clearenv();
    if (IS("limits")) { struct rlimit r = {3, 3}; setrlimit(RLIMIT_NOFILE, &r); }
    if (IS("alarm")) { ualarm(20000, 0); nap(0.2); nap(0.2); }
    if (IS("file")) { FILE *o = fopen("droppings.txt", "w"); if (o) { fputs("zoo", o); fclose(o); } }
    if (IS("chance")) c->y += rand() + random() + drand48();
    if (IS("stays")) { static double left; Dl_info me; c->y += left++; if (dladdr(&left, &me)) dlopen(me.dli_fname, RTLD_NOW | RTLD_NODELETE); }
    if (IS("warning")) { LOG(c, 1, "this is a warning"); return 1; }
    if (IS("discard")) { LOG(c, 2, "no solution here"); return 2; }
    if (IS("error")) { LOG(c, 3, "this is an error"); return 3; }
    if (IS("fatal")) { LOG(c, 4, "this is fatal"); return 4; }
    if (IS("pending")) return 5;
    if (IS("status17")) return 17;
    if (IS("minus")) return -1;
    return 0;
}

__attribute__((constructor)) static void loaded(void) { static instance none; act("load", &none, 0.0); }
__attribute__((destructor)) static void unloaded(void) { static instance none; act("unload", &none, 0.0); }

static instance *make(logger log, void *environment) {
    instance *c = calloc(1, sizeof *c); char f[64];
    c->log = log; c->environment = environment; c->p = 1.0; last = c;
    if (match("instantiate", 0.0, f) && !strcmp(f, "null")) return NULL;
    if (match("instantiate", 0.0, f) && !strcmp(f, "licence")) { LOG(c, 3, "Licence checkout failed: no seat is free"); return NULL; }
    return act("instantiate", c, 0.0) > 1 ? NULL : c;
}
static void step(instance *c, double t, double h) { c->y += h * c->u; c->t = t + h; }
static void spoil(instance *c, double v[], size_t n) {
    char f[64];
    if (!c->running || !match("value", c->t, f)) return;
    for (size_t i = 0; i < n; i++) v[i] = !strcmp(f, "nan") ? NAN : !strcmp(f, "inf") ? INFINITY : -INFINITY;
}
static double *at(instance *c, unsigned reference) {
    static double none; char f[64];
    return reference == 1 ? &c->u : reference == 2 ? &c->y : reference == 3 ? &c->p : reference == 4 ? (c->slope = c->u, &c->slope)
        : reference == 5 ? (match("lazy", 0.0, f) ? &c->seen : &c->y) : &none;
}
static const char *version(const char *right) {
    static char text[64];
    act("version", last, 0.0);
    if (match("version_is", 0.0, text)) return strcmp(text, "null") ? text : NULL;
    return right;
}

F(EnterInitializationMode)(void *c) { return act("enter", c, 0.0); }
F(ExitInitializationMode)(void *c) { ((instance *)c)->running = true; return act("exit", c, 0.0); }
F(Terminate)(void *c) { return act("terminate", c, 0.0); }
F(Reset)(void *c) { ((instance *)c)->running = false; ((instance *)c)->y = 0.0; return act("reset", c, 0.0); }
F(SetDebugLogging)(void) { return 0; }

/* Saved states. With the fault "states owned" the FMU ends its process where one is used that is not there, or of another instance,
   and where it frees an instance with states. */
static struct { void *state; instance *of; } kept[32];
static bool owned(void) { char f[64]; return match("states", 0.0, f) && IS("owned"); }
static void check_state(void *s, instance *c) {
    for (int i = 0; i < 32; i++) if (owned() && kept[i].state == s && kept[i].of == c) return;
    if (owned()) abort();
}
static void keep(void *s, void *t, instance *c) { /* t in the place of s */
    for (int i = 0; i < 32; i++) if (kept[i].state == s) { kept[i].state = t; kept[i].of = t ? c : NULL; return; }
    if (owned()) abort();
}
API void JOIN(JOIN(fmi, FMI), FreeInstance)(void *c) {
    for (int i = 0; owned() && i < 32; i++) if (kept[i].of == c) abort();
    if (act("free", c, 0.0) < 2 && c) free(c);
}
STATE(Get)(void *c, void **s) {
    if (*s) check_state(*s, c); else { *s = malloc(sizeof(instance)); keep(NULL, *s, c); }
    memcpy(*s, c, sizeof(instance));
    return act("save", c, 0.0); }
STATE(Set)(void *c, void *s) { check_state(s, c); memcpy(c, s, sizeof(instance)); return act("restore", c, 0.0); }
STATE(Free)(void *c, void **s) { if (*s) { check_state(*s, c); keep(*s, NULL, c); free(*s); *s = NULL; } return act("free_state", c, 0.0); }

/* model exchange: der(y) = u, one indicator that never crosses zero */
F(SetTime)(void *c, double t) { ((instance *)c)->t = t; return act("time", c, t); }
F(SetContinuousStates)(void *c, const double x[], size_t n) {
    ((instance *)c)->y = x[0]; return act("states", c, ((instance *)c)->t); }
F(GetContinuousStates)(void *c, double x[], size_t n) { x[0] = ((instance *)c)->y; return 0; }
F(GetNominalsOfContinuousStates)(void *c, double x[], size_t n) {
    char f[64]; x[0] = match("nominal", 0.0, f) ? IS("nan") ? NAN : 0.0 : 1.0; return act("nominals", c, 0.0); }
F(GetEventIndicators)(void *c, double z[], size_t n) { z[0] = 1.0; return act("indicators", c, ((instance *)c)->t); }
F(EnterEventMode)(void *c) { return act("event_mode", c, ((instance *)c)->t); }
F(EnterContinuousTimeMode)(void *c) { return act("continuous_mode", c, 0.0); }
static int derivative(instance *c, double d[]) {
    char f[64]; d[0] = c->u; c->seen = c->y;
    if (match("slope", c->t, f)) d[0] = IS("nan") ? NAN : INFINITY;
    return act("derivative", c, c->t); }
static bool updates(instance *c, const char *fault) { char f[64]; return match("update", c->t, f) && IS(fault); }

#if FMI == 2
F(GetDerivatives)(void *c, double d[], size_t n) { return derivative(c, d); }
F(CompletedIntegratorStep)(void *c, int final, int *event, int *terminate) {
    *event = 0; *terminate = updates(c, "terminate"); return act("completed", c, ((instance *)c)->t); }
typedef struct { int again, terminate, nominals, values, next; double time; } event_info;
F(NewDiscreteStates)(void *c, event_info *e) {
    memset(e, 0, sizeof *e); e->again = updates(c, "endless"); return act("update", c, ((instance *)c)->t); }
API const char *fmi2GetVersion(void) { return version("2.0"); }
API const char *fmi2GetTypesPlatform(void) { return "default"; }
API void *fmi2Instantiate(const char *name, int kind, const char *token, const char *resources, const callbacks *with) {
    return make(with->log, with->environment); }
F(SetupExperiment)(void *c) { return act("setup", c, 0.0); }
F(GetReal)(void *c, const unsigned vr[], size_t n, double v[]) {
    for (size_t i = 0; i < n; i++) v[i] = *at(c, vr[i]);
    spoil(c, v, n);
    return act("get", c, ((instance *)c)->t); }
F(SetReal)(void *c, const unsigned vr[], size_t n, const double v[]) {
    for (size_t i = 0; i < n; i++) *at(c, vr[i]) = v[i];
    return act("set", c, ((instance *)c)->t); }
F(DoStep)(void *c, double t, double h, int final) {
    char f[64];
    if (match("flags", t, f) && IS("terminate")) return 2; /* discarded, and GetBooleanStatus says that it is the end */
    int status = act("step", c, t); if (status < 2) step(c, t, h);
    return status; }
F(GetStatus)(void *c, int kind, int *value) { *value = 5; return act("status", c, 0.0); }
F(GetBooleanStatus)(void *c, int kind, int *value) { char f[64]; *value = match("flags", 1e9, f); return 0; }
F(GetRealStatus)(void *c, int kind, double *value) { *value = ((instance *)c)->t; return 0; }
#else
F(GetContinuousStateDerivatives)(void *c, double d[], size_t n) { return derivative(c, d); }
F(CompletedIntegratorStep)(void *c, bool final, bool *event, bool *terminate) {
    *event = false; *terminate = updates(c, "terminate"); return act("completed", c, ((instance *)c)->t); }
F(UpdateDiscreteStates)(void *c, bool *again, bool *terminate, bool *nominals, bool *values, bool *next, double *t) {
    *again = updates(c, "endless"); *terminate = *nominals = *values = *next = false;
    return act("update", c, ((instance *)c)->t); }
API void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources, bool visible,
        bool logging, void *environment, logger log) { return make(log, environment); }
API const char *fmi3GetVersion(void) { return version("3.0"); }
API void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible, bool logging,
        bool events, bool early, const unsigned required[], size_t n, void *environment, logger log, void *intermediate) {
    return make(log, environment); }
F(GetFloat64)(void *c, const unsigned vr[], size_t n, double v[], size_t nv) {
    for (size_t i = 0; i < n; i++) v[i] = *at(c, vr[i]);
    spoil(c, v, n);
    return act("get", c, ((instance *)c)->t); }
F(SetFloat64)(void *c, const unsigned vr[], size_t n, const double v[], size_t nv) {
    for (size_t i = 0; i < n; i++) *at(c, vr[i]) = v[i];
    return act("set", c, ((instance *)c)->t); }
F(DoStep)(void *c, double t, double h, bool final, bool *event, bool *terminate, bool *early, double *reached) {
    char f[64];
    bool odd = match("flags", t, f);
    *event = odd && IS("event"); *terminate = odd && IS("terminate"); *early = odd && IS("early");
    *reached = !odd ? t + h : IS("negative") ? -1.0 : IS("nan") ? NAN : IS("beyond") ? t + 2 * h : IS("early") ? t + h / 2 : t + h;
    int status = act("step", c, t); if (status < 2) step(c, t, h);
    return status; }
#endif
