use super::failure::driver;
use crate::{Error, Result};
use ash::{ext, khr, vk};
use std::{
    ffi::{CStr, c_void},
    sync::Mutex,
};

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

pub(crate) struct Instance {
    pub raw: ash::Instance,
    pub debug: Option<ext::debug_utils::Instance>,
    messenger: vk::DebugUtilsMessengerEXT,
    pub messages: Box<Mutex<Vec<String>>>,
    layer_version: Option<u32>,
    pub(super) owned: bool,
    pub entry: ash::Entry,
}

impl Instance {
    pub fn new(validation: bool) -> Result<Self> {
        let entry = load()?;
        let messages = Box::new(Mutex::new(Vec::new()));
        let app = vk::ApplicationInfo::default().application_name(c"zipsplat").api_version(vk::API_VERSION_1_3);
        let layers = if validation { vec![VALIDATION_LAYER.as_ptr()] } else { Vec::new() };
        let layer_settings = validation && has_extension(&entry, Some(VALIDATION_LAYER), ext::layer_settings::NAME);
        let mut extensions = Vec::new();
        if validation {
            extensions.push(ext::debug_utils::NAME.as_ptr());
        }
        if layer_settings {
            extensions.push(ext::layer_settings::NAME.as_ptr());
        }
        // Loaders hide portability drivers such as MoltenVK by default.
        let portable = has_extension(&entry, None, khr::portability_enumeration::NAME);
        if portable {
            extensions.push(khr::portability_enumeration::NAME.as_ptr());
        }
        let on = vk::TRUE.to_ne_bytes();
        let settings = [c"validate_sync", c"syncval_shader_accesses_heuristic"].map(|name| {
            vk::LayerSettingEXT::default()
                .layer_name(VALIDATION_LAYER)
                .setting_name(name)
                .ty(vk::LayerSettingTypeEXT::BOOL32)
                .values(&on)
        });
        let mut settings = vk::LayerSettingsCreateInfoEXT::default().settings(&settings);
        let mut features = vk::ValidationFeaturesEXT::default()
            .enabled_validation_features(&[vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION]);
        let mut info = vk::InstanceCreateInfo::default()
            .application_info(&app)
            .enabled_layer_names(&layers)
            .enabled_extension_names(&extensions);
        if portable {
            info = info.flags(vk::InstanceCreateFlags::ENUMERATE_PORTABILITY_KHR);
        }
        if layer_settings {
            info = info.push_next(&mut settings);
        } else if validation {
            info = info.push_next(&mut features);
        }
        // SAFETY: every pointer in `info` outlives the call.
        let raw = unsafe { entry.create_instance(&info, None) }.map_err(|e| match e {
            vk::Result::ERROR_LAYER_NOT_PRESENT => {
                Error::NoDevice("validation was asked for, but the Khronos validation layer is not installed".into())
            }
            e => Error::NoDevice(format!("vkCreateInstance: {e}")),
        })?;
        let messenger = vk::DebugUtilsMessengerEXT::null();
        let mut instance = Self { debug: None, messenger, messages, layer_version: None, owned: true, raw, entry };
        if validation {
            instance.layer_version = Some(layer_version(&instance.entry));
            instance.listen()?;
        }
        Ok(instance)
    }

    pub fn adopt(get_instance_proc_addr: Option<unsafe extern "C" fn()>, instance: vk::Instance) -> Result<Self> {
        let entry = match get_instance_proc_addr {
            // SAFETY: the caller vouches that it is `vkGetInstanceProcAddr`, which has this type.
            Some(function) => unsafe {
                let get_instance_proc_addr =
                    std::mem::transmute::<unsafe extern "C" fn(), vk::PFN_vkGetInstanceProcAddr>(function);
                ash::Entry::from_static_fn(ash::StaticFn { get_instance_proc_addr })
            },
            None => load()?,
        };
        // SAFETY: the caller vouches for the instance.
        let raw = unsafe { ash::Instance::load(entry.static_fn(), instance) };
        let messenger = vk::DebugUtilsMessengerEXT::null();
        Ok(Self { debug: None, messenger, messages: Box::default(), layer_version: None, owned: false, raw, entry })
    }

    /// Older layers reject newer features.
    pub fn validates(&self, version: u32) -> bool {
        self.layer_version.is_none_or(|layer| layer >= version)
    }

    fn listen(&mut self) -> Result<()> {
        let debug = ext::debug_utils::Instance::new(&self.entry, &self.raw);
        let severe = vk::DebugUtilsMessageSeverityFlagsEXT::WARNING | vk::DebugUtilsMessageSeverityFlagsEXT::ERROR;
        let info = vk::DebugUtilsMessengerCreateInfoEXT::default()
            .message_severity(severe)
            .message_type(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION)
            .pfn_user_callback(Some(on_message))
            .user_data((&raw const *self.messages).cast_mut().cast());
        // SAFETY: the user data is boxed and dropped after the messenger.
        self.messenger = unsafe { debug.create_debug_utils_messenger(&info, None) }
            .map_err(|e| driver("vkCreateDebugUtilsMessengerEXT", e))?;
        self.debug = Some(debug);
        Ok(())
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        // SAFETY: children were destroyed before; the messenger belongs to this instance.
        unsafe {
            if let Some(debug) = &self.debug {
                debug.destroy_debug_utils_messenger(self.messenger, None);
            }
            if self.owned {
                self.raw.destroy_instance(None);
            }
        }
    }
}

fn load() -> Result<ash::Entry> {
    // SAFETY: the loader's initializers are safe to run.
    unsafe { ash::Entry::load() }
        .map_err(|e| Error::NoDevice(format!("no Vulkan loader ({e}): install libvulkan1 and a driver")))
}

fn layer_version(entry: &ash::Entry) -> u32 {
    // SAFETY: plain query.
    let layers = unsafe { entry.enumerate_instance_layer_properties() }.unwrap_or_default();
    let validation = layers.iter().find(|layer| layer.layer_name_as_c_str() == Ok(VALIDATION_LAYER));
    validation.map_or(0, |layer| layer.spec_version)
}

fn has_extension(entry: &ash::Entry, layer: Option<&CStr>, name: &CStr) -> bool {
    // SAFETY: plain query.
    let found = unsafe { entry.enumerate_instance_extension_properties(layer) };
    found.is_ok_and(|list| list.iter().any(|e| e.extension_name_as_c_str() == Ok(name)))
}

unsafe extern "system" fn on_message(
    _severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    _types: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes valid data; `user` is the boxed list of the calling instance.
    let (text, messages) = unsafe {
        let text = (*data).message_as_c_str().map(|t| t.to_string_lossy().into_owned()).unwrap_or_default();
        (text, &*user.cast::<Mutex<Vec<String>>>())
    };
    // Reports a setting that the layer enabled for GPU-assisted validation.
    if text.contains("Internal Warning") {
        return vk::FALSE;
    }
    log::error!("{text}");
    messages.lock().unwrap_or_else(|e| e.into_inner()).push(text);
    vk::FALSE
}
