/* Embree 3's kernels, which trace what they are told to on standard input.
 *
 *     gcc -O3 -o embree embree.c -lembree3 && ./embree FOLDER avx2|avx512 fast|robust
 *
 * Every line is one order and gets one line of numbers in answer:
 *
 *     build MESH                     seconds and bytes that the default build takes
 *     trace meet|block GROUP RAYS    seconds; GROUP is 1 or 64, the rays that one call gets
 *     tell FILE                      how many distances of the last rays went into a file
 *
 * A mesh is a file of nine little-endian f32 a triangle; rays have eight: start, direction, reach and
 * one that is not read. A distance is an f32: infinite for nothing, 0 for something in the way. One
 * thread; times include the copy of rays into Embree's own form. Groups are said to be coherent. */
#include <embree3/rtcore.h>
#include <math.h>
#include <pmmintrin.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define GROUP 64

static const char *folder;
static long long bytes;

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static bool on_memory(void *nothing, ssize_t more, bool post) {
    (void)nothing, (void)post;
    bytes += more;
    return true;
}

static FILE *open_file(const char *name, const char *mode) {
    char path[4096];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, mode);
    if (!file) {
        perror(path);
        exit(1);
    }
    return file;
}

static float *read_numbers(const char *name, size_t *count) {
    FILE *file = open_file(name, "rb");
    fseek(file, 0, SEEK_END);
    *count = ftell(file) / sizeof(float);
    rewind(file);
    /* Embree reads 16 bytes at the last corner too. */
    float *numbers = calloc(*count + 4, sizeof(float));
    if (fread(numbers, sizeof(float), *count, file) != *count) exit(1);
    fclose(file);
    return numbers;
}

/* Corners in one place are one, as in every mesh that Embree is given. */
static const float *all_corners;
static int by_place(const void *a, const void *b) {
    return memcmp(all_corners + 3 * *(const unsigned *)a, all_corners + 3 * *(const unsigned *)b, 12);
}

static RTCScene build(RTCDevice device, const char *name, int is_robust) {
    size_t count;
    float *corners = read_numbers(name, &count);
    count /= 3;
    unsigned *order = malloc(count * sizeof(unsigned)), *place = malloc(count * sizeof(unsigned));
    for (size_t k = 0; k < count; k++) order[k] = k;
    all_corners = corners;
    qsort(order, count, sizeof(unsigned), by_place);
    float *shared = calloc(3 * count + 4, sizeof(float));
    size_t used = 0;
    for (size_t k = 0; k < count; k++) {
        if (k == 0 || by_place(&order[k - 1], &order[k])) memcpy(shared + 3 * used++, corners + 3 * order[k], 12);
        place[order[k]] = used - 1;
    }
    bytes = 0;
    RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
    memcpy(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, used), shared, 12 * used);
    memcpy(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, count / 3), place, 4 * count);
    double start = seconds();
    rtcCommitGeometry(geometry);
    RTCScene scene = rtcNewScene(device);
    rtcSetSceneFlags(scene, is_robust ? RTC_SCENE_FLAG_ROBUST : RTC_SCENE_FLAG_NONE);
    rtcAttachGeometry(scene, geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(scene);
    printf("%.9g %lld\n", seconds() - start, bytes);
    free(order), free(place), free(shared), free(corners);
    return scene;
}

static void set(struct RTCRay *ray, const float *r) {
    *ray = (struct RTCRay){.org_x = r[0], .org_y = r[1], .org_z = r[2], .dir_x = r[3], .dir_y = r[4],
                           .dir_z = r[5], .tfar = r[6], .mask = ~0u};
}

static void trace(RTCScene scene, int is_block, size_t group, const float *rays, size_t count, float *distances) {
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    if (group > 1) context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
    struct RTCRayHit hits[GROUP];
    struct RTCRay blocked[GROUP];
    for (size_t k = 0; k < count; k += group) {
        size_t some = count - k < group ? count - k : group;
        if (is_block) {
            for (size_t i = 0; i < some; i++) set(&blocked[i], rays + 8 * (k + i));
            if (group == 1) rtcOccluded1(scene, &context, blocked);
            else rtcOccluded1M(scene, &context, blocked, some, sizeof *blocked);
            for (size_t i = 0; i < some; i++) distances[k + i] = blocked[i].tfar < 0 ? 0 : INFINITY;
        } else {
            for (size_t i = 0; i < some; i++) {
                set(&hits[i].ray, rays + 8 * (k + i));
                hits[i].hit.geomID = hits[i].hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
            }
            if (group == 1) rtcIntersect1(scene, &context, hits);
            else rtcIntersect1M(scene, &context, hits, some, sizeof *hits);
            for (size_t i = 0; i < some; i++)
                distances[k + i] = hits[i].hit.geomID == RTC_INVALID_GEOMETRY_ID ? INFINITY : hits[i].ray.tfar;
        }
    }
}

int main(int argc, char **argv) {
    if (argc != 4) {
        fprintf(stderr, "usage: embree FOLDER avx2|avx512 fast|robust\n");
        return 2;
    }
    folder = argv[1];
    _MM_SET_FLUSH_ZERO_MODE(_MM_FLUSH_ZERO_ON);
    _MM_SET_DENORMALS_ZERO_MODE(_MM_DENORMALS_ZERO_ON);
    char config[64], line[256], what[64], name[128], last[128] = "";
    snprintf(config, sizeof config, "threads=1,isa=%s", argv[2]);
    RTCDevice device = rtcNewDevice(config);
    rtcSetDeviceMemoryMonitorFunction(device, on_memory, NULL);
    RTCScene scene = NULL;
    float *rays = NULL, *distances = NULL;
    size_t count = 0, group;
    while (fgets(line, sizeof line, stdin)) {
        if (sscanf(line, "build %127s", name) == 1) {
            if (scene) rtcReleaseScene(scene);
            scene = build(device, name, !strcmp(argv[3], "robust"));
        } else if (scene && sscanf(line, "trace %63s %zu %127s", what, &group, name) == 3 && (group == 1 || group == GROUP)) {
            if (strcmp(name, last)) {
                free(rays), free(distances);
                rays = read_numbers(name, &count);
                count /= 8;
                distances = malloc(count * sizeof(float));
                strcpy(last, name);
            }
            double start = seconds();
            trace(scene, !strcmp(what, "block"), group, rays, count, distances);
            printf("%.9g\n", seconds() - start);
        } else if (sscanf(line, "tell %127s", name) == 1) {
            FILE *file = open_file(name, "wb");
            if (fwrite(distances, sizeof(float), count, file) != count || fclose(file)) return 1;
            printf("%zu\n", count);
        } else {
            fprintf(stderr, "embree: cannot do: %s", line);
            return 2;
        }
        fflush(stdout);
    }
    return 0;
}
