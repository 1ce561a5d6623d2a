/* Counts what a process and its children do to files below a folder, and stops or fails at the n-th.
 * At SIGKILL and SIGSTOP half of a write has been done; what is stopped goes on with the rest of it.
 *
 *     gcc -shared -fPIC -O2 -o faults.so benchmarks/faults.c
 *     FAULTS_STATE=state LD_PRELOAD=./faults.so command     (see faults.py, which writes the state)
 *
 * Libraries written in C, C++ and Rust write through the same functions of libc as Python does.
 * What stdio writes by itself (fwrite) is not seen; its files are, when they are opened.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

/* As faults.py packs it. */
struct state {
    long armed;      /* whether anything below is done */
    long count;      /* operations so far, of all processes */
    long at;         /* the operation that goes wrong, from 0 */
    long action;     /* 0: none; below: a signal to the group; above: an errno */
    long lasting;    /* whether all later operations go wrong too */
    long group;      /* process group that gets the signal; 0: the process itself alone */
    long stopped;    /* 1 + the operation that it was stopped at; 0: go on */
    char root[1024]; /* folder, ending in a slash */
    char log[1024];  /* file that gets a line per operation; none if empty */
    char what[1024]; /* the operation that went wrong */
};

static struct state *state;

__attribute__((constructor)) static void start(void) {
    const char *name = getenv("FAULTS_STATE");
    int fd = name ? syscall(SYS_openat, AT_FDCWD, name, O_RDWR | O_CLOEXEC, 0) : -1;
    if (fd < 0)
        return;
    void *map = mmap(NULL, sizeof *state, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    state = map == MAP_FAILED ? NULL : map;
    syscall(SYS_close, fd);
}

/* The whole path of what is named relative to an open folder; of the file itself without a name. */
static void place(int at, const char *path, char *found) {
    size_t n = 0;
    if (!path || path[0] != '/') {
        char link[64];
        if (at == AT_FDCWD)
            strcpy(link, "/proc/self/cwd");
        else
            snprintf(link, sizeof link, "/proc/self/fd/%d", at);
        ssize_t read = syscall(SYS_readlinkat, AT_FDCWD, link, found, PATH_MAX - 1);
        n = read > 0 ? read : 0;
        if (path)
            found[n++] = '/';
    }
    snprintf(found + n, 2 * PATH_MAX - n, "%s", path ? path : "");
}

static void note(const char *what, long n, const char *below) {
    char line[2 * PATH_MAX + 64];
    int length = snprintf(line, sizeof line, "%ld %s %s\n", n, what, below);
    int fd = syscall(SYS_openat, AT_FDCWD, state->log, O_WRONLY | O_APPEND | O_CREAT, 0644);
    syscall(SYS_write, fd, line, length);
    syscall(SYS_close, fd);
}

/* Logs that what a file holds is used: it is opened and not emptied, or gets another name. */
static void used(int at, const char *path) {
    if (!state || !state->armed || !state->log[0])
        return;
    int kept = errno;
    char where[2 * PATH_MAX];
    place(at, path, where);
    if (!strncmp(where, state->root, strlen(state->root)))
        note("use", -1, where + strlen(state->root));
    errno = kept;
}

/* Counts one operation; whether it is to fail, with errno set. `half` is called before a kill. */
static int goes_wrong(const char *name, int at, const char *path, int grows, void (*half)(void *),
                      void *argument) {
    if (!state || !state->armed)
        return 0;
    int kept = errno;
    char where[2 * PATH_MAX];
    place(at, path, where);
    errno = kept;
    if (strncmp(where, state->root, strlen(state->root)))
        return 0;
    long n = __atomic_fetch_add(&state->count, 1, __ATOMIC_SEQ_CST);
    const char *below = where + strlen(state->root);
    if (state->log[0])
        note(name, n, below);
    if (!state->action || (state->lasting ? n < state->at : n != state->at))
        return 0;
    /* On a full disk one may still remove and rename. */
    if (state->action == ENOSPC && !grows)
        return 0;
    if (!state->what[0])
        snprintf(state->what, sizeof state->what, "%s %s", name, below);
    if (state->action < 0) {
        if (half && (state->action == -SIGKILL || state->action == -SIGSTOP))
            half(argument);
        state->stopped = n + 1;
        syscall(SYS_kill, state->group ? -state->group : getpid(), -state->action);
        while (state->action == -SIGSTOP && *(volatile long *)&state->stopped == n + 1)
            usleep(100);
        return 0;
    }
    errno = state->action;
    return 1;
}

#define REAL(name) static __typeof__(&name) real; if (!real) real = dlsym(RTLD_NEXT, #name)
#define GROWS 1

static int opens_to_change(int flags) {
    return (flags & O_ACCMODE) != O_RDONLY || (flags & (O_CREAT | O_TRUNC));
}

static mode_t mode_of(int flags, va_list more) {
    return flags & (O_CREAT | O_TMPFILE) ? va_arg(more, mode_t) : 0;
}

#define OPEN(name)                                                                            \
    int name(const char *path, int flags, ...) {                                              \
        REAL(name);                                                                           \
        va_list more;                                                                         \
        va_start(more, flags);                                                                \
        mode_t mode = mode_of(flags, more);                                                   \
        va_end(more);                                                                         \
        if (!(flags & O_TRUNC))                                                               \
            used(AT_FDCWD, path);                                                             \
        if (opens_to_change(flags) && goes_wrong("open", AT_FDCWD, path, flags & O_CREAT, 0, 0)) \
            return -1;                                                                        \
        return real(path, flags, mode);                                                       \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                                          \
    int name(int at, const char *path, int flags, ...) {                                      \
        REAL(name);                                                                           \
        va_list more;                                                                         \
        va_start(more, flags);                                                                \
        mode_t mode = mode_of(flags, more);                                                   \
        va_end(more);                                                                         \
        if (!(flags & O_TRUNC))                                                               \
            used(at, path);                                                                   \
        if (opens_to_change(flags) && goes_wrong("open", at, path, flags & O_CREAT, 0, 0))    \
            return -1;                                                                        \
        return real(at, path, flags, mode);                                                   \
    }
OPENAT(openat)
OPENAT(openat64)

#define FOPEN(name)                                                                           \
    FILE *name(const char *path, const char *mode) {                                          \
        REAL(name);                                                                           \
        if (!strchr(mode, 'w'))                                                               \
            used(AT_FDCWD, path);                                                             \
        if (strpbrk(mode, "wa+") && goes_wrong("open", AT_FDCWD, path, GROWS, 0, 0))          \
            return NULL;                                                                      \
        return real(path, mode);                                                              \
    }
FOPEN(fopen)
FOPEN(fopen64)

struct part {
    int fd;
    const void *data;
    size_t size;
    off_t at;    /* -1: where the file stands */
    size_t done; /* of its size */
};

/* A kill in the middle of a write leaves its first half. */
static void write_half(void *argument) {
    struct part *part = argument;
    ssize_t done = part->at < 0
                       ? syscall(SYS_write, part->fd, part->data, part->size / 2)
                       : syscall(SYS_pwrite64, part->fd, part->data, part->size / 2, part->at);
    part->done = done > 0 ? done : 0;
}

/* What a whole write returns, of which the rest has been tried. */
static ssize_t both(struct part part, ssize_t rest) {
    return rest >= 0 ? rest + (ssize_t)part.done : part.done ? (ssize_t)part.done : rest;
}

ssize_t write(int fd, const void *data, size_t size) {
    REAL(write);
    struct part part = {fd, data, size, -1, 0};
    if (goes_wrong("write", fd, NULL, GROWS, write_half, &part))
        return -1;
    return both(part, real(fd, (const char *)data + part.done, size - part.done));
}

#define PWRITE(name)                                                                          \
    ssize_t name(int fd, const void *data, size_t size, off_t at) {                           \
        REAL(name);                                                                           \
        struct part part = {fd, data, size, at, 0};                                           \
        if (goes_wrong("write", fd, NULL, GROWS, write_half, &part))                          \
            return -1;                                                                        \
        const char *rest = (const char *)data + part.done;                                    \
        return both(part, real(fd, rest, size - part.done, at + part.done));                  \
    }
PWRITE(pwrite)
PWRITE(pwrite64)

ssize_t sendfile(int to, int from, off_t *at, size_t size) {
    REAL(sendfile);
    return goes_wrong("write", to, NULL, GROWS, 0, 0) ? -1 : real(to, from, at, size);
}

ssize_t copy_file_range(int from, off64_t *at, int to, off64_t *there, size_t size, unsigned flags) {
    REAL(copy_file_range);
    return goes_wrong("write", to, NULL, GROWS, 0, 0) ? -1
                                                      : real(from, at, to, there, size, flags);
}

ssize_t writev(int fd, const struct iovec *parts, int n) {
    REAL(writev);
    return goes_wrong("write", fd, NULL, GROWS, 0, 0) ? -1 : real(fd, parts, n);
}

#define ONE(returns, name, declared, passed, says, at, path, grows)                           \
    returns name declared {                                                                   \
        REAL(name);                                                                           \
        return goes_wrong(says, at, path, grows, 0, 0) ? (returns)-1 : real passed;           \
    }
/* The same, of what gives another name to what the first file holds. */
#define MOVE(returns, name, declared, passed, says, from, source, at, path, grows)            \
    returns name declared {                                                                   \
        REAL(name);                                                                           \
        used(from, source);                                                                   \
        return goes_wrong(says, at, path, grows, 0, 0) ? (returns)-1 : real passed;           \
    }
MOVE(int, rename, (const char *a, const char *b), (a, b), "rename", AT_FDCWD, a, AT_FDCWD, b, 0)
MOVE(int, renameat, (int x, const char *a, int y, const char *b), (x, a, y, b), "rename", x, a, y,
     b, 0)
MOVE(int, renameat2, (int x, const char *a, int y, const char *b, unsigned f), (x, a, y, b, f),
     "rename", x, a, y, b, 0)
MOVE(int, link, (const char *a, const char *b), (a, b), "link", AT_FDCWD, a, AT_FDCWD, b, GROWS)
MOVE(int, linkat, (int x, const char *a, int y, const char *b, int f), (x, a, y, b, f), "link", x,
     a, y, b, GROWS)
ONE(int, symlink, (const char *a, const char *b), (a, b), "symlink", AT_FDCWD, b, GROWS)
ONE(int, unlink, (const char *a), (a), "unlink", AT_FDCWD, a, 0)
ONE(int, unlinkat, (int x, const char *a, int f), (x, a, f), "unlink", x, a, 0)
ONE(int, rmdir, (const char *a), (a), "rmdir", AT_FDCWD, a, 0)
ONE(int, mkdir, (const char *a, mode_t m), (a, m), "mkdir", AT_FDCWD, a, GROWS)
ONE(int, mkdirat, (int x, const char *a, mode_t m), (x, a, m), "mkdir", x, a, GROWS)
ONE(int, chmod, (const char *a, mode_t m), (a, m), "chmod", AT_FDCWD, a, 0)
ONE(int, fsync, (int fd), (fd), "fsync", fd, NULL, 0)
ONE(int, fdatasync, (int fd), (fd), "fsync", fd, NULL, 0)
ONE(int, ftruncate, (int fd, off_t n), (fd, n), "truncate", fd, NULL, 0)
ONE(int, ftruncate64, (int fd, off_t n), (fd, n), "truncate", fd, NULL, 0)
