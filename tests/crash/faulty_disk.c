/* A disk that forgets what was not synced, and whose n-th call fails; preloaded with LD_PRELOAD into a process.

   Only files below `root` are on this disk. A successful fsync, fdatasync or msync copies the file to `shadow`, under a
   name made of its inode and its birth; that of a folder copies the list of its names. The copies are therefore all that
   a power cut leaves: pages that a mapping dirtied, names of a folder and deletions count only once they were synced.
   `disk_cut_at` kills the process before a sync, `disk_lie` lets syncs do nothing, and `disk_fail_at` lets one call fail.
   Calls are counted in the order in which the threads make them. */

#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#undef stat64
#undef fstat64
#undef lstat64
#undef fstatat64

static char root[4096], shadow[4096];
static size_t root_size;
static int error_number, only_space;
static long cut_at, fail_at, syncs, calls;
static char failed[256];
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

#define REAL(name) ((__typeof__(name) *)dlsym(RTLD_NEXT, #name))

static int below(const char *path) {
    return root_size && !strncmp(path, root, root_size) && (path[root_size] == '/' || !path[root_size]);
}

static int path_of(int descriptor, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    long size = syscall(SYS_readlink, link, path, 4095);
    path[size > 0 ? size : 0] = 0;
    return size > 0 && below(path);
}

static int below_at(int folder, const char *path) {
    char resolved[4096];
    return path[0] == '/' || folder == AT_FDCWD ? below(path) : path_of(folder, resolved);
}

/* --- the n-th call fails ------------------------------------------------------------------------------------- */

static int fails(const char *name, const char *path, int takes_space) {
    int hit = 0;
    pthread_mutex_lock(&lock);
    if (!only_space || takes_space) {
        hit = ++calls == fail_at;
        if (hit) snprintf(failed, sizeof failed, "%s %s", name, path);
    }
    pthread_mutex_unlock(&lock);
    if (hit) errno = error_number;
    return hit;
}

static int fails_on(const char *name, int descriptor, int takes_space) {
    char path[4096];
    return root_size && path_of(descriptor, path) && fails(name, path, takes_space);
}

static int fails_at(const char *name, int folder, const char *path, int takes_space) {
    return root_size && below_at(folder, path) && fails(name, path, takes_space);
}

/* --- what is durable ----------------------------------------------------------------------------------------- */

static void identity(int folder, const char *name, int flags, char *text) {
    struct statx now;
    text[0] = 0;
    if (syscall(SYS_statx, folder, name, flags | AT_SYMLINK_NOFOLLOW, STATX_INO | STATX_BTIME, &now) == 0)
        snprintf(text, 100, "%c-%llu-%lld.%u", S_ISDIR(now.stx_mode) ? 'd' : 'f', (unsigned long long)now.stx_ino,
                 (long long)now.stx_btime.tv_sec, now.stx_btime.tv_nsec);
}

static void put(int target, const void *bytes, long size) {
    if (syscall(SYS_write, target, bytes, size) != size) _exit(97);
}

static void keep(int descriptor) {
    char name[100], path[4300], unfinished[4310], block[65536];
    identity(descriptor, "", AT_EMPTY_PATH, name);
    snprintf(path, sizeof path, "%s/%s", shadow, name);
    snprintf(unfinished, sizeof unfinished, "%s.new", path);
    int target = syscall(SYS_openat, AT_FDCWD, unfinished, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
    snprintf(block, sizeof block, "/proc/self/fd/%d", descriptor);
    int source = syscall(SYS_openat, AT_FDCWD, block, O_RDONLY | O_CLOEXEC, 0);
    if (target < 0 || source < 0) _exit(98);
    long size;
    if (name[0] == 'd') {
        while ((size = syscall(SYS_getdents64, source, block, sizeof block)) > 0)
            for (long at = 0; at < size;) {
                struct dirent64 *entry = (struct dirent64 *)(block + at);
                char line[400], its[100];
                identity(source, entry->d_name, 0, its);
                int written = snprintf(line, sizeof line, "%s %s\n", its, entry->d_name);
                if (its[0] && strcmp(entry->d_name, ".") && strcmp(entry->d_name, "..")) put(target, line, written);
                at += entry->d_reclen;
            }
    } else {
        for (long at = 0; (size = syscall(SYS_pread64, source, block, sizeof block, at)) > 0; at += size)
            put(target, block, size);
    }
    syscall(SYS_close, source);
    syscall(SYS_close, target);
    syscall(SYS_rename, unfinished, path);
}

static int sync_with(const char *name, int (*real)(int), int descriptor) {
    char path[4096];
    if (!root_size || !path_of(descriptor, path)) return real(descriptor);
    if (fails(name, path, 1)) return -1;
    if (!shadow[0]) return real(descriptor);
    pthread_mutex_lock(&lock);
    if (++syncs == cut_at) kill(getpid(), SIGKILL);
    keep(descriptor);
    pthread_mutex_unlock(&lock);
    return 0;
}

int fsync(int descriptor) { return sync_with("fsync", REAL(fsync), descriptor); }

int fdatasync(int descriptor) { return sync_with("fdatasync", REAL(fdatasync), descriptor); }

int msync(void *start, size_t size, int flags) {
    if (root_size && shadow[0]) _exit(99); /* the package syncs descriptors; a mapping would need its file here */
    return REAL(msync)(start, size, flags);
}

/* --- control ------------------------------------------------------------------------------------------------- */

void disk_watch(const char *folder) {
    snprintf(root, sizeof root, "%s", folder);
    root_size = strlen(root);
}

void disk_cut_at(const char *copies, long n) {
    snprintf(shadow, sizeof shadow, "%s", copies);
    cut_at = n, syncs = 0;
    int folder = syscall(SYS_openat, AT_FDCWD, root, O_RDONLY | O_DIRECTORY | O_CLOEXEC, 0);
    keep(folder);
    syscall(SYS_close, folder);
}

void disk_fail_at(long n, int error, int space) {
    pthread_mutex_lock(&lock);
    fail_at = n, error_number = error, only_space = space, calls = 0, failed[0] = 0;
    pthread_mutex_unlock(&lock);
}

long disk_calls(void) { return calls; }

long disk_syncs(void) { return syncs; }

const char *disk_failed(void) { return failed; }

/* --- the calls of Python and SQLite ---------------------------------------------------------------------------- */

static int opened(const char *name, int folder, const char *path, int flags, int mode) {
    if (fails_at(name, folder, path, flags & O_CREAT)) return -1;
    return syscall(SYS_openat, folder, path, flags, mode);
}

#define MODE(flags, last)                                    \
    int mode = 0;                                            \
    if ((flags) & (O_CREAT | __O_TMPFILE)) {                 \
        va_list more;                                        \
        va_start(more, last);                                \
        mode = va_arg(more, int);                            \
        va_end(more);                                        \
    }

int open(const char *path, int flags, ...) { MODE(flags, flags) return opened("open", AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags, flags) return opened("open", AT_FDCWD, path, flags, mode); }
int openat(int folder, const char *path, int flags, ...) {
    MODE(flags, flags) return opened("openat", folder, path, flags, mode);
}
int openat64(int folder, const char *path, int flags, ...) {
    MODE(flags, flags) return opened("openat", folder, path, flags, mode);
}

#define ON(result, failure, name, space, parameters, descriptor, arguments) \
    result name parameters {                                                \
        if (fails_on(#name, descriptor, space)) return failure;             \
        return REAL(name) arguments;                                        \
    }
#define AT(result, failure, name, space, parameters, folder, path, arguments) \
    result name parameters {                                                  \
        if (fails_at(#name, folder, path, space)) return failure;             \
        return REAL(name) arguments;                                          \
    }

ON(ssize_t, -1, read, 0, (int fd, void *buffer, size_t size), fd, (fd, buffer, size))
ON(ssize_t, -1, pread64, 0, (int fd, void *buffer, size_t size, off64_t at), fd, (fd, buffer, size, at))
ON(ssize_t, -1, write, 1, (int fd, const void *buffer, size_t size), fd, (fd, buffer, size))
ON(ssize_t, -1, pwrite64, 1, (int fd, const void *buffer, size_t size, off64_t at), fd, (fd, buffer, size, at))
ON(ssize_t, -1, writev, 1, (int fd, const struct iovec *parts, int count), fd, (fd, parts, count))
ON(int, error_number, posix_fallocate64, 1, (int fd, off64_t at, off64_t size), fd, (fd, at, size))
ON(int, -1, ftruncate64, 1, (int fd, off64_t size), fd, (fd, size))
ON(int, -1, fstat64, 0, (int fd, struct stat64 *result), fd, (fd, result))
ON(int, -1, flock, 0, (int fd, int operation), fd, (fd, operation))
ON(int, -1, fchmod, 0, (int fd, mode_t mode), fd, (fd, mode))
ON(DIR *, NULL, fdopendir, 0, (int fd), fd, (fd))
AT(int, -1, stat64, 0, (const char *path, struct stat64 *result), AT_FDCWD, path, (path, result))
AT(int, -1, lstat64, 0, (const char *path, struct stat64 *result), AT_FDCWD, path, (path, result))
AT(int, -1, fstatat64, 0, (int folder, const char *path, struct stat64 *result, int flags), folder, path,
   (folder, path, result, flags))
AT(int, -1, access, 0, (const char *path, int mode), AT_FDCWD, path, (path, mode))
AT(int, -1, chmod, 0, (const char *path, mode_t mode), AT_FDCWD, path, (path, mode))
AT(int, -1, mkdir, 1, (const char *path, mode_t mode), AT_FDCWD, path, (path, mode))
AT(int, -1, rmdir, 0, (const char *path), AT_FDCWD, path, (path))
AT(int, -1, unlink, 0, (const char *path), AT_FDCWD, path, (path))
AT(int, -1, unlinkat, 0, (int folder, const char *path, int flags), folder, path, (folder, path, flags))
AT(int, -1, rename, 1, (const char *from, const char *to), AT_FDCWD, from, (from, to))
AT(int, -1, link, 1, (const char *from, const char *to), AT_FDCWD, from, (from, to))
AT(DIR *, NULL, opendir, 0, (const char *path), AT_FDCWD, path, (path))

void *mmap64(void *start, size_t size, int protection, int flags, int fd, off64_t at) {
    if (fd >= 0 && fails_on("mmap", fd, 1)) return MAP_FAILED;
    return (void *)syscall(SYS_mmap, start, size, protection, flags, fd, at);
}

int close(int fd) { /* Linux closes the descriptor even if it reports an error */
    int failing = fails_on("close", fd, 0), number = errno;
    long result = syscall(SYS_close, fd);
    errno = failing ? number : errno;
    return failing ? -1 : result;
}

int fcntl64(int fd, int command, ...) {
    va_list more;
    va_start(more, command);
    void *argument = va_arg(more, void *);
    va_end(more);
    int locks = command == F_SETLK || command == F_SETLKW || command == F_OFD_SETLK || command == F_OFD_SETLKW;
    if (locks && fails_on("fcntl", fd, 0)) return -1;
    return syscall(SYS_fcntl, fd, command, argument);
}
