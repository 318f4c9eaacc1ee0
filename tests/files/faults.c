/* Has the n-th access to a folder fail, of those that begin with a call of the system: preloaded before the C library,
 * so that writes of compiled libraries count as those of Python do. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { OPEN = 1, WRITE = 2, RENAME = 4, MKDIR = 8, FSYNC = 16, FOLDER = 32, READ = 64 };

static char folder[PATH_MAX], failed_path[PATH_MAX];
static int which, code, failed_kind, lasting, after_kinds;
static long last;
static atomic_long count;

/* Fails the access number `n`, from 1, of these kinds to what lies in `path`; 0 = counts alone.
 * `later`: kinds that fail from then on, as on a disk that stays full. */
void faults_arm(const char* path, int kinds, long n, int error, int later) {
  snprintf(folder, sizeof folder, "%s", path);
  failed_path[0] = 0;
  which = kinds, last = n, code = error, after_kinds = later, failed_kind = 0, lasting = 0;
  count = 0;
}

long faults_count(void) { return count; }
int faults_kind(void) { return failed_kind; }
const char* faults_path(void) { return failed_path; }

static int inside(const char* path) {
  size_t length = strlen(folder);
  return length && path && !strncmp(path, folder, length);
}

static const char* name_of(int file, char* to) {
  char link[64];
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, to, PATH_MAX - 1);
  to[length < 0 ? 0 : length] = 0;
  return to;
}

static int fails(int kind, const char* path) {
  if (!inside(path)) return 0;
  if (lasting && (kind & after_kinds)) return errno = code, 1;
  if (!(kind & which)) return 0;
  if (++count != last) return 0;
  failed_kind = kind, lasting = 1;
  snprintf(failed_path, sizeof failed_path, "%s", path);
  errno = code;
  return 1;
}

static const char* whole(int at, const char* path, char* to) {
  if (!path || path[0] == '/') return path;
  if (at == AT_FDCWD) {
    if (!getcwd(to, PATH_MAX / 2)) return path;
  } else
    name_of(at, to);
  size_t length = strlen(to);
  snprintf(to + length, PATH_MAX - length, "/%s", path);
  return to;
}

#define REAL(name)               \
  static __typeof__(name)* real; \
  if (!real) real = (__typeof__(name)*)dlsym(RTLD_NEXT, #name)

static int kind_of(const char* path, int flags) {
  struct stat found;
  if (flags & (O_CREAT | O_WRONLY | O_RDWR)) return OPEN;
  return !stat(path, &found) && S_ISDIR(found.st_mode) ? FOLDER : READ;
}

#define MODE                             \
  mode_t mode = 0;                       \
  if (flags & (O_CREAT | __O_TMPFILE)) { \
    va_list more;                        \
    va_start(more, flags);               \
    mode = va_arg(more, mode_t);         \
    va_end(more);                        \
  }

#define OPENS(name)                                                            \
  int name(const char* path, int flags, ...) {                                 \
    MODE REAL(name);                                                           \
    char to[PATH_MAX];                                                         \
    const char* name_ = whole(AT_FDCWD, path, to);                             \
    return fails(kind_of(name_, flags), name_) ? -1 : real(path, flags, mode); \
  }
OPENS(open)
OPENS(open64)

#define OPENS_AT(name)                                                             \
  int name(int at, const char* path, int flags, ...) {                             \
    MODE REAL(name);                                                               \
    char to[PATH_MAX];                                                             \
    const char* name_ = whole(at, path, to);                                       \
    return fails(kind_of(name_, flags), name_) ? -1 : real(at, path, flags, mode); \
  }
OPENS_AT(openat)
OPENS_AT(openat64)

#define OPENS_FILE(name)                                                                           \
  FILE* name(const char* path, const char* mode) {                                                 \
    REAL(name);                                                                                    \
    char to[PATH_MAX];                                                                             \
    return fails(*mode == 'r' ? READ : OPEN, whole(AT_FDCWD, path, to)) ? NULL : real(path, mode); \
  }
OPENS_FILE(fopen)
OPENS_FILE(fopen64)

#define OF_FILE(kind, type, name, parameters, ...)                  \
  type name parameters {                                            \
    REAL(name);                                                     \
    char to[PATH_MAX];                                              \
    return fails(kind, name_of(file, to)) ? -1 : real(__VA_ARGS__); \
  }
OF_FILE(WRITE, ssize_t, write, (int file, const void* data, size_t size), file, data, size)
OF_FILE(WRITE, ssize_t, writev, (int file, const struct iovec* parts, int n), file, parts, n)
OF_FILE(WRITE, ssize_t, pwrite64, (int file, const void* data, size_t size, off64_t at), file, data, size, at)
OF_FILE(WRITE, ssize_t, sendfile, (int file, int from, off_t* at, size_t size), file, from, at, size)
OF_FILE(WRITE, ssize_t, sendfile64, (int file, int from, off64_t* at, size_t size), file, from, at, size)
OF_FILE(FSYNC, int, fsync, (int file), file)

int mkdir(const char* path, mode_t mode) {
  REAL(mkdir);
  char to[PATH_MAX];
  return fails(MKDIR, whole(AT_FDCWD, path, to)) ? -1 : real(path, mode);
}

int rename(const char* from, const char* path) {
  REAL(rename);
  char to[PATH_MAX];
  return fails(RENAME, whole(AT_FDCWD, path, to)) ? -1 : real(from, path);
}
