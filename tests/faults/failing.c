/* A Vulkan layer that simulates failures that no CPU driver has.
 *
 * ZIPSPLAT_FAULTS names a file with "FUNCTION FIRST RESULT". On devices created afterwards, the
 * function fails from call FIRST (counted from 1) on. Destroying a device replaces the file with
 * "FUNCTION CALLS". After VK_ERROR_DEVICE_LOST the device stays lost: every function that may
 * return it does, once earlier submissions have finished. */
#include "chain.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>

/* Name, whether it may return VK_ERROR_DEVICE_LOST, dispatchable object, parameters, arguments. */
#define FUNCTIONS(X)                                                                                                        \
  X(vkQueueSubmit2, 1, o, (VkQueue o, uint32_t n, const VkSubmitInfo2 *s, VkFence f), (o, n, s, f))                         \
  X(vkWaitSemaphores, 1, o, (VkDevice o, const VkSemaphoreWaitInfo *i, uint64_t t), (o, i, t))                              \
  X(vkGetSemaphoreCounterValue, 1, o, (VkDevice o, VkSemaphore s, uint64_t *v), (o, s, v))                                  \
  X(vkWaitForFences, 1, o, (VkDevice o, uint32_t n, const VkFence *f, VkBool32 a, uint64_t t), (o, n, f, a, t))             \
  X(vkGetQueryPoolResults, 1, o,                                                                                            \
    (VkDevice o, VkQueryPool p, uint32_t q, uint32_t n, size_t b, void *d, VkDeviceSize s, VkQueryResultFlags f),           \
    (o, p, q, n, b, d, s, f))                                                                                               \
  X(vkAllocateMemory, 0, o,                                                                                                 \
    (VkDevice o, const VkMemoryAllocateInfo *i, const VkAllocationCallbacks *a, VkDeviceMemory *m), (o, i, a, m))           \
  X(vkMapMemory, 0, o,                                                                                                      \
    (VkDevice o, VkDeviceMemory m, VkDeviceSize b, VkDeviceSize s, VkMemoryMapFlags f, void **d), (o, m, b, s, f, d))       \
  X(vkBindBufferMemory, 0, o, (VkDevice o, VkBuffer b, VkDeviceMemory m, VkDeviceSize s), (o, b, m, s))                     \
  X(vkAllocateCommandBuffers, 0, o, (VkDevice o, const VkCommandBufferAllocateInfo *i, VkCommandBuffer *b), (o, i, b))      \
  X(vkAllocateDescriptorSets, 0, o, (VkDevice o, const VkDescriptorSetAllocateInfo *i, VkDescriptorSet *s), (o, i, s))      \
  X(vkBeginCommandBuffer, 0, o, (VkCommandBuffer o, const VkCommandBufferBeginInfo *i), (o, i))                             \
  X(vkEndCommandBuffer, 0, o, (VkCommandBuffer o), (o))                                                                     \
  X(vkCreateComputePipelines, 0, o,                                                                                         \
    (VkDevice o, VkPipelineCache c, uint32_t n, const VkComputePipelineCreateInfo *i, const VkAllocationCallbacks *a,       \
     VkPipeline *p),                                                                                                        \
    (o, c, n, i, a, p))                                                                                                     \
  CREATE(X, Buffer, Buffer) CREATE(X, CommandPool, CommandPool) CREATE(X, Semaphore, Semaphore) CREATE(X, Fence, Fence)     \
  CREATE(X, QueryPool, QueryPool) CREATE(X, ShaderModule, ShaderModule) CREATE(X, PipelineLayout, PipelineLayout)           \
  CREATE(X, DescriptorSetLayout, DescriptorSetLayout) CREATE(X, DescriptorPool, DescriptorPool)
#define CREATE(X, KIND, HANDLE)                                                                                             \
  X(vkCreate##KIND, 0, o, (VkDevice o, const Vk##KIND##CreateInfo *i, const VkAllocationCallbacks *a, Vk##HANDLE *h),       \
    (o, i, a, h))

struct device {
  void *key; /* The loader's dispatch table, shared by a device, its queues and command buffers. */
  VkDevice handle;
  char function[64];
  unsigned first, calls;
  VkResult result;
  int lost;
  pthread_mutex_t mutex;
  PFN_vkGetDeviceProcAddr get;
  PFN_vkDestroyDevice destroy;
  PFN_vkDeviceWaitIdle wait;
#define POINTER(NAME, LOSES, O, PARAMETERS, ARGUMENTS) PFN_##NAME NAME;
  FUNCTIONS(POINTER)
};

static struct device devices[16];
static pthread_mutex_t table = PTHREAD_MUTEX_INITIALIZER;

static struct device *find(const void *object) {
  struct device *found = NULL;
  pthread_mutex_lock(&table);
  for (int i = 0; i < 16; i++)
    if (devices[i].key == (object ? *(void *const *)object : NULL)) found = found ? found : &devices[i];
  pthread_mutex_unlock(&table);
  if (!found) abort();
  return found;
}

static VkResult fails(struct device *device, const char *function, int loses) {
  VkResult result = VK_SUCCESS;
  if (!strcmp(function, device->function) && ++device->calls >= device->first && device->first) result = device->result;
  if (result == VK_ERROR_DEVICE_LOST) device->lost = 1;
  if (!device->lost || !loses) return result;
  device->wait(device->handle);
  return VK_ERROR_DEVICE_LOST;
}

/* A wait must not hold the lock: other threads submit its signal. */
#define WRAPPER(NAME, LOSES, O, PARAMETERS, ARGUMENTS)                                                                      \
  static VKAPI_ATTR VkResult VKAPI_CALL own_##NAME PARAMETERS {                                                         \
    struct device *device = find(O);                                                                                        \
    int submits = !strcmp(#NAME, "vkQueueSubmit2");                                                                         \
    pthread_mutex_lock(&device->mutex);                                                                                     \
    VkResult result = fails(device, #NAME, LOSES);                                                                          \
    if (!result && submits) result = device->NAME ARGUMENTS;                                                                \
    pthread_mutex_unlock(&device->mutex);                                                                                   \
    return result || submits ? result : device->NAME ARGUMENTS;                                                             \
  }
FUNCTIONS(WRAPPER)

static VKAPI_ATTR void VKAPI_CALL own_vkDestroyDevice(VkDevice handle, const VkAllocationCallbacks *allocator) {
  if (!handle) return;
  struct device *device = find(handle);
  const char *path = getenv("ZIPSPLAT_FAULTS");
  FILE *file = path ? fopen(path, "w") : NULL;
  if (file) {
    fprintf(file, "%s %u", device->function, device->calls);
    fclose(file);
  }
  device->key = NULL;
  device->destroy(handle, allocator);
}

static VKAPI_ATTR VkResult VKAPI_CALL own_vkCreateDevice(VkPhysicalDevice physical, const VkDeviceCreateInfo *info,
                                                             const VkAllocationCallbacks *allocator, VkDevice *handle) {
  VkLayerDeviceCreateInfo *link = next_link(info->pNext, VK_STRUCTURE_TYPE_LOADER_DEVICE_CREATE_INFO);
  PFN_vkGetInstanceProcAddr get_instance = link->u.pLayerInfo->pfnNextGetInstanceProcAddr;
  PFN_vkGetDeviceProcAddr get = link->u.pLayerInfo->pfnNextGetDeviceProcAddr;
  link->u.pLayerInfo = link->u.pLayerInfo->pNext;
  PFN_vkCreateDevice create = (PFN_vkCreateDevice)get_instance(newest_instance, "vkCreateDevice");
  VkResult result = create(physical, info, allocator, handle);
  if (result) return result;
  struct device *device = find(NULL);
  memset(device, 0, sizeof *device);
  pthread_mutex_init(&device->mutex, NULL);
  const char *path = getenv("ZIPSPLAT_FAULTS");
  FILE *file = path ? fopen(path, "r") : NULL;
  int code = 0;
  if (file && fscanf(file, "%63s %u %d", device->function, &device->first, &code) != 3) device->function[0] = 0;
  if (file) fclose(file);
  device->result = code;
  device->handle = *handle;
  device->get = get;
  device->destroy = (PFN_vkDestroyDevice)get(*handle, "vkDestroyDevice");
  device->wait = (PFN_vkDeviceWaitIdle)get(*handle, "vkDeviceWaitIdle");
#define LOAD(NAME, LOSES, O, PARAMETERS, ARGUMENTS) device->NAME = (PFN_##NAME)get(*handle, #NAME);
  FUNCTIONS(LOAD)
  device->key = *(void **)*handle;
  return VK_SUCCESS;
}

static PFN_vkVoidFunction own(const char *name) {
#define FIND(NAME, LOSES, O, PARAMETERS, ARGUMENTS)                                                                         \
  if (!strcmp(name, #NAME)) return (PFN_vkVoidFunction)own_##NAME;
  FUNCTIONS(FIND)
  if (!strcmp(name, "vkDestroyDevice")) return (PFN_vkVoidFunction)own_vkDestroyDevice;
  if (!strcmp(name, "vkCreateDevice")) return (PFN_vkVoidFunction)own_vkCreateDevice;
  if (!strcmp(name, "vkCreateInstance")) return (PFN_vkVoidFunction)own_vkCreateInstance;
  return NULL;
}

static VKAPI_ATTR PFN_vkVoidFunction VKAPI_CALL device_function(VkDevice device, const char *name) {
  if (!strcmp(name, "vkGetDeviceProcAddr")) return (PFN_vkVoidFunction)device_function;
  PFN_vkVoidFunction function = own(name);
  return function ? function : find(device)->get(device, name);
}
