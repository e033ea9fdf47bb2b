/* Preloaded, it counts what a process gives to the OpenCL driver: kernels, and reads that wait. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stddef.h>

long kernels_launched, reads_waited;

static void *next(const char *name) {
    void *found = dlsym(RTLD_NEXT, name);
    return found ? found : dlsym(dlopen("libOpenCL.so.1", RTLD_LAZY), name);
}

int clEnqueueNDRangeKernel(void *queue, void *kernel, unsigned dimensions, const size_t *offset, const size_t *size,
                           const size_t *group, unsigned n, const void *events, void *event) {
    static int (*real)(void *, void *, unsigned, const size_t *, const size_t *, const size_t *, unsigned, const void *,
                       void *);
    if (!real) real = next("clEnqueueNDRangeKernel");
    kernels_launched++;
    return real(queue, kernel, dimensions, offset, size, group, n, events, event);
}

int clEnqueueReadBuffer(void *queue, void *buffer, unsigned waits, size_t offset, size_t size, void *to, unsigned n,
                        const void *events, void *event) {
    static int (*real)(void *, void *, unsigned, size_t, size_t, void *, unsigned, const void *, void *);
    if (!real) real = next("clEnqueueReadBuffer");
    reads_waited += waits != 0;
    return real(queue, buffer, waits, offset, size, to, n, events, event);
}
