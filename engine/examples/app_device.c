/* Draws into an app's own Vulkan image, ordered by the app's timeline semaphore. Pixels reach the
 * host only for the final check.
 *     cc app_device.c $(pkg-config --cflags --libs zipsplat vulkan) -lpthread -o app_device
 *     ./app_device
 * ZIPSPLAT_VALIDATION=1 enables the Khronos validation layer; its messages are failures. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <vulkan/vulkan.h>
#include <zipsplat.h>

enum { SIDE = 256, FRAMES = 3, BYTES = 4 * SIDE * SIDE };

static pthread_mutex_t queue_mutex = PTHREAD_MUTEX_INITIALIZER;
static int messages = 0;

static void fail(const char *what, const char *why) {
    fprintf(stderr, "%s: %s\n", what, why);
    exit(EXIT_FAILURE);
}

static void zs(zs_status status, const char *what) {
    if (status != ZS_OK) {
        fail(what, zs_last_error());
    }
}

static void vk(VkResult result, const char *what) {
    if (result < 0) {
        fail(what, "the driver refused");
    }
}

static void lock_queue(void *mutex) { pthread_mutex_lock(mutex); }
static void unlock_queue(void *mutex) { pthread_mutex_unlock(mutex); }

static VKAPI_ATTR VkBool32 VKAPI_CALL on_message(VkDebugUtilsMessageSeverityFlagBitsEXT severity,
                                                 VkDebugUtilsMessageTypeFlagsEXT type,
                                                 const VkDebugUtilsMessengerCallbackDataEXT *data, void *user_data) {
    (void)severity, (void)type, (void)user_data;
    fprintf(stderr, "%s\n", data->pMessage);
    messages++;
    return VK_FALSE;
}

static VkInstance create_instance(void) {
    const char *wanted = getenv("ZIPSPLAT_VALIDATION");
    const uint32_t validate = wanted != NULL && strcmp(wanted, "1") == 0;
    const char *layer = "VK_LAYER_KHRONOS_validation", *debug_utils = VK_EXT_DEBUG_UTILS_EXTENSION_NAME;
    const VkDebugUtilsMessengerCreateInfoEXT listen = {
        .sType = VK_STRUCTURE_TYPE_DEBUG_UTILS_MESSENGER_CREATE_INFO_EXT,
        .messageSeverity =
            VK_DEBUG_UTILS_MESSAGE_SEVERITY_WARNING_BIT_EXT | VK_DEBUG_UTILS_MESSAGE_SEVERITY_ERROR_BIT_EXT,
        .messageType = VK_DEBUG_UTILS_MESSAGE_TYPE_VALIDATION_BIT_EXT,
        .pfnUserCallback = on_message};
    const VkApplicationInfo app = {.sType = VK_STRUCTURE_TYPE_APPLICATION_INFO, .apiVersion = VK_API_VERSION_1_3};
    const VkInstanceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO,
                                       .pNext = validate ? &listen : NULL,
                                       .pApplicationInfo = &app,
                                       .enabledLayerCount = validate,
                                       .ppEnabledLayerNames = &layer,
                                       .enabledExtensionCount = validate,
                                       .ppEnabledExtensionNames = &debug_utils};
    VkInstance instance;
    vk(vkCreateInstance(&info, NULL, &instance), "vkCreateInstance");
    if (validate) {
        PFN_vkCreateDebugUtilsMessengerEXT create =
            (PFN_vkCreateDebugUtilsMessengerEXT)vkGetInstanceProcAddr(instance, "vkCreateDebugUtilsMessengerEXT");
        static VkDebugUtilsMessengerEXT messenger; /* ends with the process */
        vk(create(instance, &listen, NULL, &messenger), "vkCreateDebugUtilsMessengerEXT");
    }
    return instance;
}

static uint32_t compute_family(VkPhysicalDevice physical) {
    VkQueueFamilyProperties families[16];
    uint32_t count = 16;
    vkGetPhysicalDeviceQueueFamilyProperties(physical, &count, families);
    for (uint32_t i = 0; i < count; i++) {
        if (families[i].queueFlags & VK_QUEUE_COMPUTE_BIT) {
            return i;
        }
    }
    fail("device", "no queue can compute");
    return 0;
}

/* Enables required extensions and features. Drawing needs no optional ones. An app that
 * reconstructs enables those, too, and sets zs_vulkan_device.optional_features_enabled. */
static VkDevice create_device(VkPhysicalDevice physical, uint32_t family) {
    const zs_vulkan_requirement *required;
    size_t count;
    const char *extensions[8];
    uint32_t extension_count = 0;
    zs(zs_vulkan_requirements(&required, &count), "requirements");
    for (size_t i = 0; i < count; i++) {
        printf("%s %s %s\n", required[i].optional ? "may use" : "requires", required[i].name, required[i].structure);
        if (required[i].kind == ZS_REQUIRES_DEVICE_EXTENSION && !required[i].optional) {
            extensions[extension_count++] = required[i].name;
        }
    }
    VkPhysicalDeviceVulkan13Features v13 = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_3_FEATURES,
                                            .synchronization2 = VK_TRUE,
                                            .maintenance4 = VK_TRUE,
                                            .subgroupSizeControl = VK_TRUE,
                                            .computeFullSubgroups = VK_TRUE};
    VkPhysicalDeviceVulkan12Features v12 = {.sType = VK_STRUCTURE_TYPE_PHYSICAL_DEVICE_VULKAN_1_2_FEATURES,
                                            .pNext = &v13,
                                            .timelineSemaphore = VK_TRUE,
                                            .scalarBlockLayout = VK_TRUE};
    const float priority = 1;
    const VkDeviceQueueCreateInfo queue = {.sType = VK_STRUCTURE_TYPE_DEVICE_QUEUE_CREATE_INFO,
                                           .queueFamilyIndex = family,
                                           .queueCount = 1,
                                           .pQueuePriorities = &priority};
    const VkDeviceCreateInfo info = {.sType = VK_STRUCTURE_TYPE_DEVICE_CREATE_INFO,
                                     .pNext = &v12,
                                     .queueCreateInfoCount = 1,
                                     .pQueueCreateInfos = &queue,
                                     .enabledExtensionCount = extension_count,
                                     .ppEnabledExtensionNames = extensions};
    VkDevice device;
    vk(vkCreateDevice(physical, &info, NULL, &device), "vkCreateDevice");
    return device;
}

static VkDeviceMemory allocate(VkPhysicalDevice physical, VkDevice device, VkMemoryRequirements needs,
                               VkMemoryPropertyFlags wanted) {
    VkPhysicalDeviceMemoryProperties memory;
    vkGetPhysicalDeviceMemoryProperties(physical, &memory);
    for (uint32_t i = 0; i < memory.memoryTypeCount; i++) {
        if ((needs.memoryTypeBits >> i & 1) && (memory.memoryTypes[i].propertyFlags & wanted) == wanted) {
            const VkMemoryAllocateInfo info = {
                .sType = VK_STRUCTURE_TYPE_MEMORY_ALLOCATE_INFO, .allocationSize = needs.size, .memoryTypeIndex = i};
            VkDeviceMemory allocated;
            vk(vkAllocateMemory(device, &info, NULL, &allocated), "vkAllocateMemory");
            return allocated;
        }
    }
    fail("memory", "no such type");
    return VK_NULL_HANDLE;
}

/* The app's use of a picture: a copy to a host-visible buffer. */
static VkCommandBuffer record_copy(VkDevice device, VkCommandPool pool, VkImage image, VkBuffer buffer) {
    const VkCommandBufferAllocateInfo allocate_info = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_ALLOCATE_INFO,
                                                       .commandPool = pool,
                                                       .level = VK_COMMAND_BUFFER_LEVEL_PRIMARY,
                                                       .commandBufferCount = 1};
    VkCommandBuffer commands;
    vk(vkAllocateCommandBuffers(device, &allocate_info, &commands), "vkAllocateCommandBuffers");
    const VkCommandBufferBeginInfo begin = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_BEGIN_INFO};
    vk(vkBeginCommandBuffer(commands, &begin), "vkBeginCommandBuffer");
    const VkBufferImageCopy region = {.imageSubresource = {VK_IMAGE_ASPECT_COLOR_BIT, 0, 0, 1},
                                      .imageExtent = {SIDE, SIDE, 1}};
    vkCmdCopyImageToBuffer(commands, image, VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL, buffer, 1, &region);
    const VkMemoryBarrier2 to_host = {.sType = VK_STRUCTURE_TYPE_MEMORY_BARRIER_2,
                                      .srcStageMask = VK_PIPELINE_STAGE_2_COPY_BIT,
                                      .srcAccessMask = VK_ACCESS_2_TRANSFER_WRITE_BIT,
                                      .dstStageMask = VK_PIPELINE_STAGE_2_HOST_BIT,
                                      .dstAccessMask = VK_ACCESS_2_HOST_READ_BIT};
    const VkDependencyInfo dependency = {
        .sType = VK_STRUCTURE_TYPE_DEPENDENCY_INFO, .memoryBarrierCount = 1, .pMemoryBarriers = &to_host};
    vkCmdPipelineBarrier2(commands, &dependency);
    vk(vkEndCommandBuffer(commands), "vkEndCommandBuffer");
    return commands;
}

static void submit(VkQueue queue, VkCommandBuffer commands, VkSemaphore timeline, uint64_t wait, uint64_t signal) {
    const VkSemaphoreSubmitInfo waits = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_SUBMIT_INFO,
                                         .semaphore = timeline,
                                         .value = wait,
                                         .stageMask = VK_PIPELINE_STAGE_2_COPY_BIT};
    VkSemaphoreSubmitInfo signals = waits;
    signals.value = signal;
    const VkCommandBufferSubmitInfo buffers = {.sType = VK_STRUCTURE_TYPE_COMMAND_BUFFER_SUBMIT_INFO,
                                               .commandBuffer = commands};
    const VkSubmitInfo2 info = {.sType = VK_STRUCTURE_TYPE_SUBMIT_INFO_2,
                                .waitSemaphoreInfoCount = 1,
                                .pWaitSemaphoreInfos = &waits,
                                .commandBufferInfoCount = 1,
                                .pCommandBufferInfos = &buffers,
                                .signalSemaphoreInfoCount = 1,
                                .pSignalSemaphoreInfos = &signals};
    lock_queue(&queue_mutex);
    vk(vkQueueSubmit2(queue, 1, &info, VK_NULL_HANDLE), "vkQueueSubmit2");
    unlock_queue(&queue_mutex);
}

static void wait_for(VkDevice device, VkSemaphore timeline, uint64_t value) {
    const VkSemaphoreWaitInfo info = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_WAIT_INFO,
                                      .semaphoreCount = 1,
                                      .pSemaphores = &timeline,
                                      .pValues = &value};
    vk(vkWaitSemaphores(device, &info, UINT64_MAX), "vkWaitSemaphores");
}

/* Three Gaussians before the camera: red, green and blue. */
static zs_scene *make_scene(void) {
    const float means[] = {-0.5f, 0, 3, 0, 0, 4, 0.5f, 0.2f, 3}, scales[] = {0.3f, 0.1f, 0.2f, 0.5f, 0.5f, 0.5f, 0.1f, 0.4f, 0.1f};
    const float quats[] = {1, 0, 0, 0, 1, 0, 0, 0.5f, 1, 0.3f, 0, 0}, opacities[] = {0.9f, 0.7f, 0.8f};
    const float colors[] = {1.5f, -1, -1, -1, 1.5f, -1, -1, -1, 1.5f};
    const zs_gaussians arrays = {.struct_size = sizeof arrays, .count = 3, .means = means, .scales = scales,
                                 .quats = quats, .opacities = opacities, .sh_coeffs = colors};
    zs_scene *scene;
    zs(zs_scene_create(&arrays, &scene), "scene");
    return scene;
}

static zs_camera camera_of_frame(int frame) {
    zs_camera camera = {.struct_size = sizeof camera, .width = SIDE, .height = SIDE, .rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1}};
    camera.fx = camera.fy = SIDE, camera.cx = camera.cy = SIDE / 2.0, camera.translation[0] = 0.1 * frame;
    return camera;
}

int main(void) {
    const VkInstance instance = create_instance();
    uint32_t one = 1;
    VkPhysicalDevice physical;
    vk(vkEnumeratePhysicalDevices(instance, &one, &physical), "vkEnumeratePhysicalDevices");
    const uint32_t family = compute_family(physical);
    const VkDevice device = create_device(physical, family);
    VkQueue queue;
    vkGetDeviceQueue(device, family, 0, &queue);

    const VkImageCreateInfo image_info = {.sType = VK_STRUCTURE_TYPE_IMAGE_CREATE_INFO,
                                          .imageType = VK_IMAGE_TYPE_2D,
                                          .format = VK_FORMAT_R8G8B8A8_UNORM,
                                          .extent = {SIDE, SIDE, 1},
                                          .mipLevels = 1,
                                          .arrayLayers = 1,
                                          .samples = VK_SAMPLE_COUNT_1_BIT,
                                          .usage = VK_IMAGE_USAGE_TRANSFER_DST_BIT | VK_IMAGE_USAGE_TRANSFER_SRC_BIT};
    VkImage image;
    VkMemoryRequirements needs;
    vk(vkCreateImage(device, &image_info, NULL, &image), "vkCreateImage");
    vkGetImageMemoryRequirements(device, image, &needs);
    const VkDeviceMemory image_memory = allocate(physical, device, needs, VK_MEMORY_PROPERTY_DEVICE_LOCAL_BIT);
    vk(vkBindImageMemory(device, image, image_memory, 0), "vkBindImageMemory");

    const VkBufferCreateInfo buffer_info = {
        .sType = VK_STRUCTURE_TYPE_BUFFER_CREATE_INFO, .size = 2 * BYTES, .usage = VK_BUFFER_USAGE_TRANSFER_DST_BIT};
    VkBuffer buffer;
    void *mapped;
    vk(vkCreateBuffer(device, &buffer_info, NULL, &buffer), "vkCreateBuffer");
    vkGetBufferMemoryRequirements(device, buffer, &needs);
    const VkDeviceMemory buffer_memory =
        allocate(physical, device, needs, VK_MEMORY_PROPERTY_HOST_VISIBLE_BIT | VK_MEMORY_PROPERTY_HOST_COHERENT_BIT);
    vk(vkBindBufferMemory(device, buffer, buffer_memory, 0), "vkBindBufferMemory");
    vk(vkMapMemory(device, buffer_memory, 0, VK_WHOLE_SIZE, 0, &mapped), "vkMapMemory");

    const VkSemaphoreTypeCreateInfo timeline_info = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_TYPE_CREATE_INFO,
                                                     .semaphoreType = VK_SEMAPHORE_TYPE_TIMELINE};
    const VkSemaphoreCreateInfo semaphore_info = {.sType = VK_STRUCTURE_TYPE_SEMAPHORE_CREATE_INFO, .pNext = &timeline_info};
    VkSemaphore timeline;
    vk(vkCreateSemaphore(device, &semaphore_info, NULL, &timeline), "vkCreateSemaphore");
    const VkCommandPoolCreateInfo pool_info = {.sType = VK_STRUCTURE_TYPE_COMMAND_POOL_CREATE_INFO,
                                               .queueFamilyIndex = family};
    VkCommandPool pool;
    vk(vkCreateCommandPool(device, &pool_info, NULL, &pool), "vkCreateCommandPool");
    const VkCommandBuffer copy = record_copy(device, pool, image, buffer);

    zs_vulkan_device adopted = ZS_INIT(zs_vulkan_device);
    adopted.get_instance_proc_addr = (zs_vulkan_function)vkGetInstanceProcAddr;
    adopted.instance = instance, adopted.physical_device = physical, adopted.device = device;
    adopted.queue = queue, adopted.queue_family = family;
    adopted.lock_queue = lock_queue, adopted.unlock_queue = unlock_queue, adopted.user_data = &queue_mutex;
    zs_device *engine;
    zs_renderer *renderer;
    zs(zs_device_from_vulkan(&adopted, &engine), "adopt");
    zs_scene *scene = make_scene();
    zs(zs_renderer_create(engine, scene, &renderer), "renderer");

    /* Even values: the image is free. Odd values: the picture is ready. */
    unsigned char *expected = malloc(BYTES);
    zs_semaphore_point free_again = {(uint64_t)(uintptr_t)timeline, 0}, drawn = free_again;
    zs_vulkan_target target = ZS_INIT(zs_vulkan_target);
    target.image = (uint64_t)(uintptr_t)image;
    target.new_layout = VK_IMAGE_LAYOUT_TRANSFER_SRC_OPTIMAL;
    target.wait_count = target.signal_count = 1, target.waits = &free_again, target.signals = &drawn;
    for (int frame = 0; frame < FRAMES; frame++) {
        const zs_camera camera = camera_of_frame(frame);
        free_again.value = 2 * (uint64_t)frame, drawn.value = free_again.value + 1;
        zs(zs_render_to_vulkan(renderer, &camera, &target, NULL), "draw into an image");
        submit(queue, copy, timeline, drawn.value, drawn.value + 1);
    }

    /* The same picture into the second half of a buffer, and into host memory. */
    const zs_camera camera = camera_of_frame(FRAMES - 1);
    const zs_render_buffers picture = {.struct_size = sizeof picture, .pixels = expected};
    free_again.value = 2 * FRAMES, drawn.value = 2 * FRAMES + 1;
    target.image = 0, target.buffer = (uint64_t)(uintptr_t)buffer;
    target.buffer_offset = BYTES, target.buffer_size = BYTES;
    zs(zs_render_to_vulkan(renderer, &camera, &target, NULL), "draw into a buffer");
    zs(zs_render(renderer, &camera, &picture, 1, NULL), "draw into memory");
    wait_for(device, timeline, drawn.value);
    int sum = 0;
    for (int i = 0; i < BYTES; i++) {
        sum |= expected[i];
    }
    const int same = memcmp(mapped, expected, BYTES) == 0 && memcmp((char *)mapped + BYTES, expected, BYTES) == 0;
    printf("image, buffer and memory %s, %d messages\n", sum != 0 && same ? "agree" : "DIFFER", messages);

    free(expected);
    zs_renderer_destroy(renderer);
    zs_scene_destroy(scene);
    zs_device_destroy(engine);
    vkDestroyCommandPool(device, pool, NULL);
    vkDestroySemaphore(device, timeline, NULL);
    vkDestroyBuffer(device, buffer, NULL);
    vkFreeMemory(device, buffer_memory, NULL);
    vkDestroyImage(device, image, NULL);
    vkFreeMemory(device, image_memory, NULL);
    vkDestroyDevice(device, NULL);
    return sum != 0 && same && messages == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
