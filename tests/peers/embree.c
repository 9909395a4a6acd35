/* What Embree 3 meets of the rays that `rtfarm-report --for-peers FOLDER` wrote.
 *
 *     gcc -O3 -o embree embree.c -lembree3 && ./embree FOLDER RUNS MOVED...
 *
 * Leaves the distances as `rtfarm-report --peers` reads them and prints a line of kernels.tsv each:
 * one thread, one ray a call, the fast and the robust mode by turns. The time includes the copy of
 * a ray into Embree's own form. */
#include <embree3/rtcore.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define MOST_RUNS 99

static double seconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static float *read_numbers(const char *folder, const char *name, size_t *count) {
    char path[4096];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "rb");
    if (!file) {
        perror(path);
        exit(1);
    }
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

static RTCScene make_scene(RTCDevice device, const float *corners, size_t count, int is_robust) {
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
    RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
    memcpy(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 12, used), shared, 12 * used);
    memcpy(rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 12, count / 3), place, 4 * count);
    rtcCommitGeometry(geometry);
    RTCScene scene = rtcNewScene(device);
    rtcSetSceneFlags(scene, is_robust ? RTC_SCENE_FLAG_ROBUST : RTC_SCENE_FLAG_NONE);
    rtcSetSceneBuildQuality(scene, RTC_BUILD_QUALITY_HIGH);
    rtcAttachGeometry(scene, geometry);
    rtcReleaseGeometry(geometry);
    rtcCommitScene(scene);
    free(order), free(place), free(shared);
    return scene;
}

static void meet(RTCScene scene, const float *rays, size_t count, float *distances) {
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
    for (size_t k = 0; k < count; k++) {
        const float *r = rays + 6 * k;
        struct RTCRayHit hit = {.ray = {.org_x = r[0], .org_y = r[1], .org_z = r[2],
                                        .dir_x = r[3], .dir_y = r[4], .dir_z = r[5],
                                        .tfar = INFINITY, .mask = ~0u},
                                .hit = {.geomID = RTC_INVALID_GEOMETRY_ID}};
        rtcIntersect1(scene, &context, &hit);
        distances[k] = hit.hit.geomID == RTC_INVALID_GEOMETRY_ID ? INFINITY : hit.ray.tfar;
    }
}

int main(int argc, char **argv) {
    if (argc < 4) {
        fprintf(stderr, "usage: embree FOLDER RUNS MOVED...\n");
        return 2;
    }
    const char *folder = argv[1], *aims[] = {"edges", "corners", "anywhere"}, *modes[] = {"fast", "robust"};
    int runs = atoi(argv[2]);
    if (runs < 1 || runs > MOST_RUNS) return 2;
    RTCDevice device = rtcNewDevice("threads=1");
    long version = rtcGetDeviceProperty(device, RTC_DEVICE_PROPERTY_VERSION);
    for (int m = 3; m < argc; m++) {
        char name[256];
        size_t count;
        snprintf(name, sizeof name, "mesh-%s", argv[m]);
        float *corners = read_numbers(folder, name, &count);
        RTCScene scenes[] = {make_scene(device, corners, count / 3, 0), make_scene(device, corners, count / 3, 1)};
        for (int a = 0; a < 3; a++) {
            snprintf(name, sizeof name, "rays-%s-%s", argv[m], aims[a]);
            float *rays = read_numbers(folder, name, &count);
            count /= 6;
            float *distances = malloc(count * sizeof(float));
            double speeds[2][MOST_RUNS];
            for (int run = 0; run < runs; run++)
                for (int mode = 0; mode < 2; mode++) {
                    double start = seconds();
                    meet(scenes[mode], rays, count, distances);
                    speeds[mode][run] = count / (seconds() - start) / 1e6;
                }
            for (int mode = 0; mode < 2; mode++) {
                char path[4096];
                meet(scenes[mode], rays, count, distances);
                snprintf(name, sizeof name, "embree-%s-%s-%s", modes[mode], argv[m], aims[a]);
                snprintf(path, sizeof path, "%s/%s", folder, name);
                FILE *file = fopen(path, "wb");
                if (!file || fwrite(distances, sizeof(float), count, file) != count || fclose(file)) {
                    perror(path);
                    return 1;
                }
                printf("Embree %ld.%ld.%ld %s\t%s\t%s\t", version / 10000, version / 100 % 100, version % 100,
                       modes[mode], argv[m], aims[a]);
                for (int run = 0; run < runs; run++) printf("%s%.4f", run ? "," : "", speeds[mode][run]);
                printf("\t%s\n", name);
            }
            free(distances), free(rays);
        }
        rtcReleaseScene(scenes[0]), rtcReleaseScene(scenes[1]);
        free(corners);
    }
    rtcReleaseDevice(device);
    return 0;
}
