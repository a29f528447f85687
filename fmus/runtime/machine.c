/* A virtual machine for functions of scalar operations: it evaluates a diagram's functions without a compiler.

   A function is a list of runs. A run is one operation that is done on many values one after the other, so that the
   processor meets the same loop again and again; `machine.py` sorts the operations of a function in this way. Every
   value has a place in the memory `v` that nothing else is written to, so their order changes no bit. Constants are in
   `v` from the beginning. The machine comes after `newton.c`. */

/* The operations: name, as CasADi calls it without OP_; and the value that is made of a, or of a and b. */
#define UNARY_OPERATIONS(X) \
    X(ASSIGN, a) X(LIFT, a) X(NEG, -a) X(SQ, a *a) X(TWICE, 2.0 * a) X(INV, 1.0 / a) X(SQRT, sqrt(a)) \
    X(FABS, fabs(a)) X(SIGN, a < 0.0 ? -1.0 : a > 0.0 ? 1.0 : a) X(FLOOR, floor(a)) X(CEIL, ceil(a)) \
    X(NOT, a == 0.0 ? 1.0 : 0.0) X(EXP, exp(a)) X(EXPM1, expm1(a)) X(LOG, log(a)) X(LOG1P, log1p(a)) \
    X(SIN, sin(a)) X(COS, cos(a)) X(TAN, tan(a)) X(ASIN, asin(a)) X(ACOS, acos(a)) X(ATAN, atan(a)) \
    X(SINH, sinh(a)) X(COSH, cosh(a)) X(TANH, tanh(a)) X(ASINH, asinh(a)) X(ACOSH, acosh(a)) X(ATANH, atanh(a)) \
    X(ERF, erf(a))
#define BINARY_OPERATIONS(X) \
    X(ADD, a + b) X(SUB, a - b) X(MUL, a *b) X(DIV, a / b) X(POW, pow(a, b)) X(CONSTPOW, pow(a, b)) \
    X(LT, a < b ? 1.0 : 0.0) X(LE, a <= b ? 1.0 : 0.0) X(EQ, a == b ? 1.0 : 0.0) X(NE, a != b ? 1.0 : 0.0) \
    X(AND, a != 0.0 && b != 0.0 ? 1.0 : 0.0) X(OR, a != 0.0 || b != 0.0 ? 1.0 : 0.0) \
    X(IF_ELSE_ZERO, a != 0.0 ? b : 0.0) X(FMIN, fmin(a, b)) X(FMAX, fmax(a, b)) X(FMOD, fmod(a, b)) \
    X(REMAINDER, remainder(a, b)) X(COPYSIGN, copysign(a, b)) X(ATAN2, atan2(a, b)) X(HYPOT, hypot(a, b))

#define CODE_OF(name, value) CODE_##name,
enum { CODE_INPUT, CODE_OUTPUT, UNARY_OPERATIONS(CODE_OF) BINARY_OPERATIONS(CODE_OF) CODES };

#define TEXT_OF(name, value) #name " "
/* Names of the operations in the order of their codes. */
VISIBLE const char *loopwright_operations(void) {
    return "INPUT OUTPUT " UNARY_OPERATIONS(TEXT_OF) BINARY_OPERATIONS(TEXT_OF);
}

/* A function: each run is its code, the number of its operations, and a row for each: INPUT and OUTPUT begin with the
   number of the vector, and have rows of a place in v and an entry of it; others have rows of the place of the result
   and of one or two operands. */
typedef struct {
    int64_t runs;
    const int32_t *code;
    tick_function generated; /* generated code of the same function, which is called instead; NULL: there is none yet */
    long long *iw;           /* its memory */
    double *w;
} program;

#define UNARY_RUN(name, value)             \
    case CODE_##name:                      \
        for (; n > 0; n--, c += 2) {       \
            const double a = v[c[1]];      \
            v[c[0]] = (value);             \
        }                                  \
        break;
#define BINARY_RUN(name, value)                            \
    case CODE_##name:                                      \
        for (; n > 0; n--, c += 3) {                       \
            const double a = v[c[1]], b = v[c[2]];         \
            v[c[0]] = (value);                             \
        }                                                  \
        break;

/* A function as `tick.evaluate`: its program is in the place of iw, its values in that of w. */
VISIBLE int loopwright_machine(const double **arguments, double **results, long long *iw, double *v, int memory) {
    const program *of = (const program *)iw;
    const int32_t *c = of->code;
    if (of->generated) return of->generated(arguments, results, of->iw, of->w, memory);
    for (int64_t run = 0; run < of->runs; run++) {
        const int32_t code = c[0];
        int32_t n = c[1];
        c += 2;
        switch (code) {
        case CODE_INPUT: {
            const double *from = arguments[*c++];
            for (; n > 0; n--, c += 2) v[c[0]] = from[c[1]];
            break;
        }
        case CODE_OUTPUT: {
            double *to = results[*c++];
            for (; n > 0; n--, c += 2) to[c[1]] = v[c[0]];
            break;
        }
            UNARY_OPERATIONS(UNARY_RUN)
            BINARY_OPERATIONS(BINARY_RUN)
        default: return 1;
        }
    }
    return 0;
}

/* --- one function for many blocks ---

   Equal blocks share a program. Its operations are done for several of them at a time: each value has as many places in
   the memory of the program as there are blocks at a time, one after the other. */

/* A block's function (t, further arguments, p): as `program`, with places that are multiples of `width`. */
typedef struct {
    int64_t runs;
    const int32_t *code;
    double *values;         /* memory, with its constants */
    int32_t width;          /* blocks at a time */
    int32_t row;            /* entries of a block's row in the table: where an argument or a result begins in v or p */
    const int32_t *columns; /* of each argument, then of each result: its entry of the row; -1: it begins where v does */
    int32_t arguments;      /* the last one is in p */
} block_program;

#define UNARY_LANES(name, value)                                           \
    case CODE_##name:                                                      \
        for (; n > 0; n--, c += 2) {                                       \
            const double *x = values + c[1];                               \
            double *restrict made = values + c[0];                         \
            for (int32_t k = 0; k < width; k++) {                          \
                const double a = x[k];                                     \
                made[k] = (value);                                         \
            }                                                              \
        }                                                                  \
        break;
#define BINARY_LANES(name, value)                                          \
    case CODE_##name:                                                      \
        for (; n > 0; n--, c += 3) {                                       \
            const double *x = values + c[1], *y = values + c[2];           \
            double *restrict made = values + c[0];                         \
            for (int32_t k = 0; k < width; k++) {                          \
                const double a = x[k], b = y[k];                           \
                made[k] = (value);                                         \
            }                                                              \
        }                                                                  \
        break;

/* Evaluate one block. */
static void run_block(const block_program *of, const int32_t *row, double *vectors, const double *p) {
    const int32_t *c = of->code, *columns = of->columns;
    double *v = of->values;
    for (int64_t run = 0; run < of->runs; run++) {
        const int32_t code = c[0];
        int32_t n = c[1];
        c += 2;
        switch (code) {
        case CODE_INPUT: {
            const int32_t argument = *c++, column = columns[argument];
            const double *from = (argument == of->arguments - 1 ? p : vectors) + (column < 0 ? 0 : row[column]);
            for (; n > 0; n--, c += 2) v[c[0]] = from[c[1]];
            break;
        }
        case CODE_OUTPUT: {
            double *to = vectors + row[columns[of->arguments + *c++]];
            for (; n > 0; n--, c += 2) to[c[1]] = v[c[0]];
            break;
        }
            UNARY_OPERATIONS(UNARY_RUN)
            BINARY_OPERATIONS(BINARY_RUN)
        }
    }
}

/* Evaluate `width` blocks together. */
static void run_together(const block_program *of, int32_t width, const int32_t *rows, double *vectors, const double *p) {
    const int32_t *c = of->code, *columns = of->columns;
    double *values = of->values;
    for (int64_t run = 0; run < of->runs; run++) {
        const int32_t code = c[0];
        int32_t n = c[1];
        c += 2;
        switch (code) {
        case CODE_INPUT: {
            const int32_t argument = *c++, column = columns[argument];
            const double *from = argument == of->arguments - 1 ? p : vectors;
            for (; n > 0; n--, c += 2)
                for (int32_t k = 0; k < width; k++)
                    values[c[0] + k] = from[c[1] + (column < 0 ? 0 : rows[k * of->row + column])];
            break;
        }
        case CODE_OUTPUT: {
            const int32_t *column = rows + columns[of->arguments + *c++];
            for (; n > 0; n--, c += 2)
                for (int32_t k = 0; k < width; k++) vectors[c[1] + column[k * of->row]] = values[c[0] + k];
            break;
        }
            UNARY_OPERATIONS(UNARY_LANES)
            BINARY_OPERATIONS(BINARY_LANES)
        }
    }
}

/* Evaluate n blocks, each of which has a row in a table. None of them reads what another one writes. */
static void run_blocks(const block_program *of, int32_t n, const int32_t *rows, double *vectors, const double *p) {
    while (n > 1 && of->width > 1) {
        const int32_t width = n < of->width ? n : of->width;
        run_together(of, width, rows, vectors, p);
        rows += width * of->row;
        n -= width;
    }
    for (; n > 0; n--, rows += of->row) run_block(of, rows, vectors, p);
}
