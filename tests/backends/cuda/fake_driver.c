/* Stands in for the NVIDIA driver: notes what it is asked, and runs a kernel that fills memory. */
#include <stdio.h>
#include <string.h>

typedef void *Pointer;

static char log_text[4096];
static int failing;

static void note(const char *text) {
    strncat(log_text, text, sizeof log_text - strlen(log_text) - 1);
    strncat(log_text, ";", sizeof log_text - strlen(log_text) - 1);
}

const char *take_log(void) {
    static char taken[sizeof log_text];
    strcpy(taken, log_text);
    log_text[0] = 0;
    return taken;
}

void fail_with(int status) { failing = status; }

int cuDeviceGet(int *device, int ordinal) {
    *device = 40 + ordinal;
    note("device");
    return 0;
}

int cuDevicePrimaryCtxRetain(Pointer *context, int device) {
    *context = (Pointer)(long)(1000000000000 + device);
    note(device == 41 ? "retain 41" : "retain");
    return 0;
}

int cuCtxSetCurrent(Pointer context) {
    note((long)context == 1000000000041 ? "enter" : "enter another");
    return 0;
}

int cuModuleLoadData(Pointer *module, const void *image) {
    *module = (Pointer)(long)2000000000000;
    note(memcmp(image, "\177ELF\0rest", 9) ? "load nonsense" : "load");
    return failing;
}

int cuModuleGetFunction(Pointer *function, Pointer module, const char *name) {
    *function = (Pointer)(long)3000000000000;
    note((long)module == 2000000000000 ? name : "of no module");
    return 0;
}

struct Three {
    float *out;
    int count;
    float value;
};

int cuLaunchKernel(
    Pointer function, unsigned x, unsigned y, unsigned z, unsigned bx, unsigned by, unsigned bz,
    unsigned shared, Pointer stream, void **given, void **extra
) {
    char text[200];
    struct Three *three = (struct Three *)given[0];
    float factor = *(float *)given[2];
    float *also = *(float **)given[1];
    snprintf(
        text, sizeof text, "launch %d %u %u %u %u %u %u %u %ld %d", (long)function == 3000000000000,
        x, y, z, bx, by, bz, shared, (long)stream, extra != 0
    );
    note(text);
    for (int i = 0; i < three->count; i++) three->out[i] = three->value * factor + also[i];
    return failing;
}

static Pointer last_node;

int cuStreamGetCaptureInfo_v2(
    Pointer stream, int *status, unsigned long long *identity, Pointer *graph,
    const Pointer **nodes, unsigned long *count
) {
    last_node = (Pointer)(long)5000000000000;
    *status = (long)stream == 4000000000000;
    *identity = 7, *graph = 0, *nodes = &last_node, *count = 1;
    note("ask");
    return 0;
}

int cuGraphInstantiateWithFlags(Pointer *made, Pointer graph, unsigned long long flags) {
    *made = (Pointer)(long)7000000000000;
    note((long)graph == 6000000000000 && flags == 0 ? "instantiate" : "instantiate nonsense");
    return failing;
}

struct Params {
    Pointer function;
    unsigned x, y, z, bx, by, bz, shared;
    void **given;
    void **extra;
    Pointer kernel, context;
};

int cuGraphExecKernelNodeSetParams_v2(Pointer made, Pointer node, const struct Params *params) {
    char text[200];
    struct Three *three = (struct Three *)params->given[0];
    snprintf(
        text, sizeof text, "give %d %d %d %u %u %u %u %u %u %u %g %g %d", (long)made == 7000000000000,
        (long)node == 5000000000000, (long)params->function == 3000000000000, params->x, params->y,
        params->z, params->bx, params->by, params->bz, params->shared, three->value,
        *(float *)params->given[2], params->extra || params->kernel || params->context
    );
    note(text);
    return failing;
}

int cuGraphLaunch(Pointer made, Pointer stream) {
    int right = (long)made == 7000000000000 && (long)stream == 4000000000000;
    note(right ? "execute" : "execute nonsense");
    return failing;
}

int cuGraphExecDestroy(Pointer made) {
    note((long)made == 7000000000000 ? "destroy" : "destroy nonsense");
    return 0;
}

int cuGetErrorString(int status, const char **text) {
    *text = "no image";
    return 0;
}
