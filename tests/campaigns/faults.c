/* Preloaded into a process, this makes one of its changes to the files below a folder go wrong.
 *
 * FAULTS_BELOW  the folder; calls on files elsewhere pass untouched
 * FAULTS_AT     the number of the call that goes wrong, from 1; 0 for none
 * FAULTS_ERRNO  what it fails with; 0 kills the process there by SIGKILL instead
 * FAULTS_STICKY 1: every later call that could run out of space fails too, as on a full disk
 * FAULTS_COUNT  a file that receives the number of calls seen, and the name of the one that failed
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
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static const char *below, *count_file;
static long at, number, sticky;
static int code;
static pid_t owner;

/* Read the settings anew: a forked process calls it to be the one that fails. */
__attribute__((constructor)) void faults_start(void) {
    number = 0;
    below = getenv("FAULTS_BELOW");
    count_file = getenv("FAULTS_COUNT");
    at = getenv("FAULTS_AT") ? atol(getenv("FAULTS_AT")) : 0;
    code = getenv("FAULTS_ERRNO") ? atoi(getenv("FAULTS_ERRNO")) : 0;
    sticky = getenv("FAULTS_STICKY") ? atol(getenv("FAULTS_STICKY")) : 0;
    owner = getpid();
}

static void report(const char *name, const char *path) {
    if (!count_file) return;
    int fd = (int)((int (*)(const char *, int, ...))dlsym(RTLD_NEXT, "open"))(count_file, O_WRONLY | O_CREAT | O_TRUNC, 0644);
    if (fd >= 0) {
        dprintf(fd, "%ld %s %s\n", number, name, path);
        ((int (*)(int))dlsym(RTLD_NEXT, "close"))(fd);
    }
}

/* Returns 1 when the call is to fail, with errno set. */
static int fails(const char *name, const char *path, int needs_space) {
    if (!below || getpid() != owner || strncmp(path, below, strlen(below))) return 0;
    number++;
    int now = at && (number == at || (sticky && number > at && needs_space));
    if (number == at || !at) report(name, path);
    if (!now) return 0;
    if (!code) {
        kill(getpid(), SIGKILL);
        pause();
    }
    errno = code;
    return 1;
}

static const char *path_of(int fd, char *buffer) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, buffer, PATH_MAX - 1);
    buffer[length < 0 ? 0 : length] = 0;
    return buffer;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

#define OPEN(name)                                                                       \
    int name(const char *path, int flags, ...) {                                         \
        va_list list;                                                                    \
        va_start(list, flags);                                                           \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(list, mode_t) : 0;          \
        va_end(list);                                                                    \
        if (fails(#name, path, flags & O_CREAT)) return -1;                              \
        return REAL(name)(path, flags, mode);                                            \
    }
OPEN(open)
OPEN(open64)

#define ON_PATH(type, name, space, parameters, arguments)                                \
    type name parameters {                                                               \
        if (fails(#name, path, space)) return -1;                                        \
        return REAL(name) arguments;                                                     \
    }
ON_PATH(int, mkdir, 1, (const char *path, mode_t mode), (path, mode))
ON_PATH(int, rmdir, 0, (const char *path), (path))
ON_PATH(int, unlink, 0, (const char *path), (path))
ON_PATH(int, rename, 1, (const char *path, const char *to), (path, to))
ON_PATH(int, link, 1, (const char *path, const char *to), (path, to))
ON_PATH(int, chmod, 0, (const char *path, mode_t mode), (path, mode))
ON_PATH(int, truncate, 0, (const char *path, off_t length), (path, length))
ON_PATH(int, renameat2, 1, (int from, const char *path, int into, const char *to, unsigned flags), (from, path, into, to, flags))

#define ON_FILE(type, name, space, parameters, arguments)                                \
    type name parameters {                                                               \
        char buffer[PATH_MAX];                                                           \
        int kept = errno;                                                                \
        const char *path = below ? path_of(fd, buffer) : "";                             \
        errno = kept;                                                                    \
        if (fails(#name, path, space)) return -1;                                        \
        return REAL(name) arguments;                                                     \
    }
ON_FILE(ssize_t, write, 1, (int fd, const void *data, size_t size), (fd, data, size))
ON_FILE(ssize_t, pwrite, 1, (int fd, const void *data, size_t size, off_t place), (fd, data, size, place))
ON_FILE(ssize_t, pwrite64, 1, (int fd, const void *data, size_t size, off64_t place), (fd, data, size, place))
ON_FILE(int, fsync, 1, (int fd), (fd))
ON_FILE(int, ftruncate, 1, (int fd, off_t length), (fd, length))
ON_FILE(int, ftruncate64, 1, (int fd, off64_t length), (fd, length))
ON_FILE(int, flock, 0, (int fd, int operation), (fd, operation))

/* Removal of trees: Python's rmtree goes by descriptors. */
int unlinkat(int fd, const char *name, int flags) {
    char buffer[PATH_MAX];
    const char *path = name[0] == '/' ? name : below ? path_of(fd, buffer) : "";
    if (fails("unlinkat", path, 0)) return -1;
    return REAL(unlinkat)(fd, name, flags);
}
