/* A Vulkan layer that replaces the hardware of a driver without any (RADV with
 * RADV_FORCE_FAMILY). The driver compiles every pipeline, memory is the host's, and nothing
 * executes.
 *
 * ZIPSPLAT_SPIRV names the folder of compiled kernels. The layer prints "PIPELINE NAME" and the
 * values of the specialization constants, by number, to standard error before each compilation,
 * and "REFUSED NAME" after a failed one. */
#define _GNU_SOURCE
#include "chain.h"

#include <ftw.h>
#include <stdio.h>
#include <stdlib.h>

static VkDevice device;
static PFN_vkGetDeviceProcAddr next_device;
#define INSTANCE(NAME) ((PFN_##NAME)next_instance(newest_instance, #NAME))
#define DEVICE(NAME) ((PFN_##NAME)next_device(device, #NAME))

static VKAPI_ATTR void VKAPI_CALL own_vkGetPhysicalDeviceMemoryProperties(VkPhysicalDevice physical,
                                                                          VkPhysicalDeviceMemoryProperties *memory) {
  (void)physical;
  memset(memory, 0, sizeof *memory);
  memory->memoryTypeCount = memory->memoryHeapCount = 1;
  memory->memoryTypes[0].propertyFlags = VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT | VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT |
                                         VK_MEMORY_PROPERTY_HOST_COHERENT_BIT;
  memory->memoryHeaps[0] = (VkMemoryHeap){16ull << 30, VK_MEMORY_HEAP_DEVICE_LOCAL_BIT};
}

static VKAPI_ATTR void VKAPI_CALL own_vkGetPhysicalDeviceMemoryProperties2(VkPhysicalDevice physical,
                                                                           VkPhysicalDeviceMemoryProperties2 *memory) {
  own_vkGetPhysicalDeviceMemoryProperties(physical, &memory->memoryProperties);
}

static VKAPI_ATTR void VKAPI_CALL own_vkGetPhysicalDeviceProperties2(VkPhysicalDevice physical,
                                                                     VkPhysicalDeviceProperties2 *found) {
  INSTANCE(vkGetPhysicalDeviceProperties2)(physical, found);
  found->properties.limits.timestampPeriod = 1;
}

static VKAPI_ATTR void VKAPI_CALL own_vkGetBufferMemoryRequirements(VkDevice d, VkBuffer buffer, VkMemoryRequirements *needed) {
  DEVICE(vkGetBufferMemoryRequirements)(d, buffer, needed);
  needed->memoryTypeBits = 1;
}

static VKAPI_ATTR void VKAPI_CALL own_vkGetDeviceBufferMemoryRequirements(VkDevice d, const VkDeviceBufferMemoryRequirements *info,
                                                                          VkMemoryRequirements2 *needed) {
  DEVICE(vkGetDeviceBufferMemoryRequirements)(d, info, needed);
  needed->memoryRequirements.memoryTypeBits = 1;
}

static VKAPI_ATTR VkResult VKAPI_CALL own_vkAllocateMemory(VkDevice d, const VkMemoryAllocateInfo *info,
                                                           const VkAllocationCallbacks *a, VkDeviceMemory *memory) {
  (void)d, (void)a;
  *memory = (VkDeviceMemory)calloc(1, info->allocationSize);
  return *memory ? VK_SUCCESS : VK_ERROR_OUT_OF_DEVICE_MEMORY;
}

static VKAPI_ATTR void VKAPI_CALL own_vkFreeMemory(VkDevice d, VkDeviceMemory memory, const VkAllocationCallbacks *a) {
  (void)d, (void)a;
  free((void *)memory);
}

static VKAPI_ATTR VkResult VKAPI_CALL own_vkMapMemory(VkDevice d, VkDeviceMemory memory, VkDeviceSize offset, VkDeviceSize size,
                                                      VkMemoryMapFlags flags, void **data) {
  (void)d, (void)size, (void)flags;
  *data = (char *)memory + offset;
  return VK_SUCCESS;
}

static VKAPI_ATTR VkResult VKAPI_CALL own_vkGetSemaphoreCounterValue(VkDevice d, VkSemaphore semaphore, uint64_t *value) {
  (void)d, (void)semaphore;
  *value = 1ull << 62;
  return VK_SUCCESS;
}

static VKAPI_ATTR VkResult VKAPI_CALL own_vkGetQueryPoolResults(VkDevice d, VkQueryPool pool, uint32_t first, uint32_t count,
                                                                size_t bytes, void *data, VkDeviceSize stride,
                                                                VkQueryResultFlags flags) {
  (void)d, (void)pool, (void)first, (void)count, (void)stride, (void)flags;
  for (size_t i = 0; i < bytes / sizeof(uint64_t); i++) ((uint64_t *)data)[i] = 1000 * (i + 1);
  return VK_SUCCESS;
}

#define CREATE(KIND)                                                                            \
  static VKAPI_ATTR VkResult VKAPI_CALL own_vkCreate##KIND(                                     \
      VkDevice d, const Vk##KIND##CreateInfo *info, const VkAllocationCallbacks *a,             \
      Vk##KIND *made) {                                                                         \
    (void)d, (void)info, (void)a;                                                               \
    *made = (Vk##KIND)1;                                                                        \
    return VK_SUCCESS;                                                                          \
  }
CREATE(Semaphore) CREATE(Fence) CREATE(QueryPool)

static VKAPI_ATTR VkResult VKAPI_CALL nothing(void) { return VK_SUCCESS; }

/* Kernels are identified by their code. */
enum { KERNELS = 1024 };
static struct kernel {
  VkShaderModule module;
  char name[64];
} kernels[KERNELS];
static unsigned kernel_count;
static const VkShaderModuleCreateInfo *sought;
static char *found;

static int compare(const char *path, const struct stat *stat, int kind, struct FTW *place) {
  (void)place;
  if (kind != FTW_F || (size_t)stat->st_size != sought->codeSize) return 0;
  FILE *file = fopen(path, "rb");
  char *code = malloc(sought->codeSize);
  int same = file && code && fread(code, sought->codeSize, 1, file) == 1 && !memcmp(code, sought->pCode, sought->codeSize);
  if (same) snprintf(found, sizeof kernels->name, "%s", path + strlen(getenv("ZIPSPLAT_SPIRV")) + 1);
  if (file) fclose(file);
  free(code);
  return same;
}

static VKAPI_ATTR VkResult VKAPI_CALL own_vkCreateShaderModule(VkDevice d, const VkShaderModuleCreateInfo *info,
                                                               const VkAllocationCallbacks *a, VkShaderModule *module) {
  VkResult result = DEVICE(vkCreateShaderModule)(d, info, a, module);
  struct kernel *kernel = &kernels[kernel_count++ % KERNELS];
  *kernel = (struct kernel){*module, "unknown"};
  sought = info, found = kernel->name;
  nftw(getenv("ZIPSPLAT_SPIRV"), compare, 8, 0);
  return result;
}

static VKAPI_ATTR VkResult VKAPI_CALL own_vkCreateComputePipelines(VkDevice d, VkPipelineCache cache, uint32_t count,
                                                                   const VkComputePipelineCreateInfo *infos,
                                                                   const VkAllocationCallbacks *a, VkPipeline *pipelines) {
  const char *name = "unknown"; /* The newest module of this handle: handles are reused. */
  for (unsigned i = 0; i < KERNELS && i < kernel_count; i++) {
    const struct kernel *kernel = &kernels[(kernel_count - 1 - i) % KERNELS];
    if (kernel->module != infos->stage.module) continue;
    name = kernel->name;
    break;
  }
  fprintf(stderr, "\nPIPELINE %s", name);
  const VkSpecializationInfo *constants = infos->stage.pSpecializationInfo;
  for (uint32_t i = 0; constants && i < constants->mapEntryCount; i++) {
    uint32_t value;
    memcpy(&value, (const char *)constants->pData + constants->pMapEntries[i].offset, sizeof value);
    fprintf(stderr, " %u=%u", constants->pMapEntries[i].constantID, value);
  }
  fputc('\n', stderr);
  VkResult result = DEVICE(vkCreateComputePipelines)(d, cache, count, infos, a, pipelines);
  if (result) fprintf(stderr, "\nREFUSED %s\n", name);
  return result;
}

static VKAPI_ATTR VkResult VKAPI_CALL own_vkCreateDevice(VkPhysicalDevice physical, const VkDeviceCreateInfo *info,
                                                         const VkAllocationCallbacks *a, VkDevice *made) {
  VkLayerDeviceCreateInfo *link = next_link(info->pNext, VK_STRUCTURE_TYPE_LOADER_DEVICE_CREATE_INFO);
  next_device = link->u.pLayerInfo->pfnNextGetDeviceProcAddr;
  link->u.pLayerInfo = link->u.pLayerInfo->pNext;
  VkResult result = INSTANCE(vkCreateDevice)(physical, info, a, made);
  device = *made;
  return result;
}

static PFN_vkVoidFunction own(const char *name) {
#define OWN(NAME) \
  if (!strcmp(name, #NAME)) return (PFN_vkVoidFunction)own_##NAME;
  OWN(vkCreateInstance) OWN(vkCreateDevice) OWN(vkCreateShaderModule) OWN(vkCreateComputePipelines)
  OWN(vkGetPhysicalDeviceMemoryProperties) OWN(vkGetPhysicalDeviceMemoryProperties2) OWN(vkGetPhysicalDeviceProperties2)
  OWN(vkGetBufferMemoryRequirements) OWN(vkGetDeviceBufferMemoryRequirements)
  OWN(vkAllocateMemory) OWN(vkFreeMemory) OWN(vkMapMemory)
  OWN(vkCreateSemaphore) OWN(vkCreateFence) OWN(vkCreateQueryPool)
  OWN(vkGetSemaphoreCounterValue) OWN(vkGetQueryPoolResults)
  static const char *const nothings[] = {
      "vkBindBufferMemory",  "vkUnmapMemory",        "vkUpdateDescriptorSets", "vkBeginCommandBuffer", "vkEndCommandBuffer",
      "vkResetCommandBuffer", "vkFreeCommandBuffers", "vkDestroyCommandPool",   "vkQueueSubmit2",       "vkQueueWaitIdle",
      "vkDeviceWaitIdle",    "vkWaitSemaphores",     "vkWaitForFences",        "vkResetFences",        "vkDestroySemaphore",
      "vkDestroyFence",      "vkDestroyQueryPool",
  };
  for (size_t i = 0; i < sizeof nothings / sizeof *nothings; i++)
    if (!strcmp(name, nothings[i])) return (PFN_vkVoidFunction)nothing;
  return strncmp(name, "vkCmd", 5) ? NULL : (PFN_vkVoidFunction)nothing;
}

static VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL device_function(VkDevice d, const char *name) {
  if (!strcmp(name, "vkGetDeviceProcAddr")) return (PFN_vkVoidFunction)device_function;
  PFN_vkVoidFunction function = own(name);
  return function ? function : next_device(d, name);
}
