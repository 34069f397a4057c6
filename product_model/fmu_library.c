/* The library of a functional mock-up unit for Linux (x86-64): pythonfmu's own, with the location of its resources decoded.

   A tool gives that location as a URI, in which "größe" is "gr%C3%B6%C3%9Fe"; pythonfmu 0.7 decodes %20 alone and ends the
   process where it finds no file. This library decodes it and hands all calls on to pythonfmu's, which lies beside it.

   cc -Os -shared -fPIC -fno-stack-protector -fno-asynchronous-unwind-tables -fcf-protection=none -s \
      -Wl,-z,noseparate-code,--build-id=none,--hash-style=gnu,--no-as-needed -o fmu_library.so fmu_library.c -l:libdl.so.2 */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* as old as may be, so that the library loads wherever pythonfmu's does */
__asm__(".symver dladdr,dladdr@GLIBC_2.2.5");
__asm__(".symver dlerror,dlerror@GLIBC_2.2.5");
__asm__(".symver dlopen,dlopen@GLIBC_2.2.5");
__asm__(".symver dlsym,dlsym@GLIBC_2.2.5");

#define NAME "libpythonfmu-export.so"
#define FUNCTIONS(X) \
    X(GetTypesPlatform) X(GetVersion) X(SetDebugLogging) X(FreeInstance) X(SetupExperiment) X(EnterInitializationMode) \
    X(ExitInitializationMode) X(Terminate) X(Reset) X(GetReal) X(GetInteger) X(GetBoolean) X(GetString) X(SetReal) \
    X(SetInteger) X(SetBoolean) X(SetString) X(GetFMUstate) X(SetFMUstate) X(FreeFMUstate) X(SerializedFMUstateSize) \
    X(SerializeFMUstate) X(DeSerializeFMUstate) X(GetDirectionalDerivative) X(SetRealInputDerivatives) \
    X(GetRealOutputDerivatives) X(DoStep) X(CancelStep) X(GetStatus) X(GetRealStatus) X(GetIntegerStatus) \
    X(GetBooleanStatus) X(GetStringStatus)

/* Each function jumps to that of pythonfmu, whatever its arguments are. */
#define POINTER(name) __attribute__((visibility("hidden"))) void *to_##name;
#define JUMP(name) __asm__(".globl fmi2" #name "\n.type fmi2" #name ",@function\nfmi2" #name ": jmp *to_" #name "(%rip)\n");
FUNCTIONS(POINTER)
FUNCTIONS(JUMP)

typedef void *instantiate(const char *, int, const char *, const char *, const void *, int, int);
static instantiate *to_Instantiate;

__attribute__((constructor)) static void load(void)
{
    Dl_info self;
    char path[4096];
    if (!dladdr((void *)load, &self) || strlen(self.dli_fname) + sizeof NAME >= sizeof path) return;
    strcpy(path, self.dli_fname);
    char *slash = strrchr(path, '/');
    strcpy(slash ? slash + 1 : path, NAME);
    void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
    if (!library) {
        fprintf(stderr, "%s\n", dlerror());
        return;
    }
    to_Instantiate = (instantiate *)dlsym(library, "fmi2Instantiate");
#define RESOLVE(name) to_##name = dlsym(library, "fmi2" #name);
    FUNCTIONS(RESOLVE)
}

static int digit(char c)
{
    return c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

void *fmi2Instantiate(const char *name, int type, const char *guid, const char *uri, const void *functions, int visible, int logging)
{
    if (!to_Instantiate) return NULL;
    char *location = uri ? strdup(uri) : NULL, *to = location;
    for (const char *from = location; from && *from; to++) {
        int high = *from == '%' ? digit(from[1]) : -1, low = high >= 0 ? digit(from[2]) : -1;
        *to = low >= 0 ? 16 * high + low : *from;
        from += low >= 0 ? 3 : 1;
    }
    if (to) *to = 0;
    char open_folder[64];
    const char *given = location;
    if (location && strstr(location, "%20")) { /* which pythonfmu would take for a blank: a name without it */
        int folder = open(location + (strncmp(location, "file://", 7) ? 0 : 7), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
        snprintf(open_folder, sizeof open_folder, "file:///proc/self/fd/%d", folder);
        given = folder >= 0 ? open_folder : location;
    }
    void *made = to_Instantiate(name, type, guid, given, functions, visible, logging);
    free(location);
    return made;
}
