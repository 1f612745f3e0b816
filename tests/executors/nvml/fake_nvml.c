/* Speaks NVML's C interface for two GPUs. What it answers is read from the file that FAKE_NVML names:
   a line "pid bytes" for each process that computes on the second GPU, and a line "busy percent". */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define SUCCESS 0
#define INVALID_ARGUMENT 2
#define NOT_FOUND 6
#define INSUFFICIENT_SIZE 7
#define NOT_AVAILABLE 0xffffffffffffffffULL

typedef int nvmlReturn_t;
typedef struct fake { unsigned int index; } *nvmlDevice_t;
typedef struct { unsigned long long total, free, used; } nvmlMemory_t;
typedef struct { unsigned int gpu, memory; } nvmlUtilization_t;
typedef struct {
  unsigned int pid;
  unsigned long long usedGpuMemory;
  unsigned int gpuInstanceId, computeInstanceId;
} nvmlProcessInfo_t;

static struct fake devices[2] = {{0}, {1}};
static const char *uuids[2] = {"GPU-00000000-aaaa-bbbb-cccc-000000000000", "GPU-11111111-aaaa-bbbb-cccc-111111111111"};

static nvmlReturn_t text(char *out, unsigned int size, const char *value) {
  if (strlen(value) >= size) return INSUFFICIENT_SIZE;
  strcpy(out, value);
  return SUCCESS;
}

nvmlReturn_t nvmlInitWithFlags(unsigned int flags) { return flags ? INVALID_ARGUMENT : SUCCESS; }
nvmlReturn_t nvmlInit_v2(void) { return SUCCESS; }
nvmlReturn_t nvmlShutdown(void) { return SUCCESS; }
const char *nvmlErrorString(nvmlReturn_t code) { return code == NOT_FOUND ? "Not Found" : "Error"; }
nvmlReturn_t nvmlSystemGetDriverVersion(char *out, unsigned int size) { return text(out, size, "570.86.10"); }
nvmlReturn_t nvmlDeviceGetCount_v2(unsigned int *count) { return *count = 2, SUCCESS; }

nvmlReturn_t nvmlDeviceGetHandleByIndex_v2(unsigned int index, nvmlDevice_t *device) {
  if (index > 1) return INVALID_ARGUMENT;
  return *device = &devices[index], SUCCESS;
}

nvmlReturn_t nvmlDeviceGetHandleByUUID(const char *uuid, nvmlDevice_t *device) {
  for (int k = 0; k < 2; k++)
    if (!strcmp(uuid, uuids[k])) return *device = &devices[k], SUCCESS;
  return NOT_FOUND;
}

nvmlReturn_t nvmlDeviceGetUUID(nvmlDevice_t device, char *out, unsigned int size) {
  return text(out, size, uuids[device->index]);
}

nvmlReturn_t nvmlDeviceGetName(nvmlDevice_t device, char *out, unsigned int size) {
  return text(out, size, device->index ? "NVIDIA RTX A6000" : "NVIDIA GeForce RTX 4090");
}

nvmlReturn_t nvmlDeviceGetMemoryInfo(nvmlDevice_t device, nvmlMemory_t *memory) {
  memory->total = device->index ? 51527024640ULL : 25757220864ULL;
  memory->used = memory->free = memory->total / 2;
  return SUCCESS;
}

nvmlReturn_t nvmlDeviceGetUtilizationRates(nvmlDevice_t device, nvmlUtilization_t *rates) {
  rates->gpu = rates->memory = 0;
  FILE *file = device->index ? fopen(getenv("FAKE_NVML"), "r") : NULL;
  char line[128];
  while (file && fgets(line, sizeof line, file)) sscanf(line, "busy %u", &rates->gpu);
  return file ? fclose(file), SUCCESS : SUCCESS;
}

nvmlReturn_t nvmlDeviceGetComputeRunningProcesses_v3(nvmlDevice_t device, unsigned int *count, nvmlProcessInfo_t *out) {
  unsigned int found = 0, room = *count, pid;
  unsigned long long bytes;
  char line[128];
  FILE *file = device->index ? fopen(getenv("FAKE_NVML"), "r") : NULL;
  while (file && fgets(line, sizeof line, file)) {
    int fields = sscanf(line, "%u %llu", &pid, &bytes);
    if (fields < 1) continue;
    if (found < room && out) out[found] = (nvmlProcessInfo_t){pid, fields == 2 ? bytes : NOT_AVAILABLE, -1, -1};
    found++;
  }
  if (file) fclose(file);
  *count = found;
  return found > room ? INSUFFICIENT_SIZE : SUCCESS;
}
