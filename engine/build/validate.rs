//! SPIR-V validation for Vulkan 1.3 with scalar block layout, by shaderc's spirv-tools.

use std::{
    ffi::{CStr, c_char, c_int, c_void},
    ptr,
};

#[repr(C)]
struct Binary {
    code: *const u32,
    words: usize,
}

#[repr(C)]
struct Diagnostic {
    line: usize,
    column: usize,
    index: usize,
    error: *const c_char,
    is_text_source: bool,
}

unsafe extern "C" {
    fn spvParseTargetEnv(name: *const c_char, environment: *mut c_int) -> bool;
    fn spvContextCreate(environment: c_int) -> *mut c_void;
    fn spvContextDestroy(context: *mut c_void);
    fn spvValidatorOptionsCreate() -> *mut c_void;
    fn spvValidatorOptionsDestroy(options: *mut c_void);
    fn spvValidatorOptionsSetScalarBlockLayout(options: *mut c_void, on: bool);
    fn spvValidateWithOptions(
        context: *const c_void,
        options: *const c_void,
        binary: *const Binary,
        diagnostic: *mut *mut Diagnostic,
    ) -> c_int;
    fn spvDiagnosticDestroy(diagnostic: *mut Diagnostic);
}

pub fn validate(words: &[u32]) -> Result<(), String> {
    let binary = Binary { code: words.as_ptr(), words: words.len() };
    // SAFETY: declarations match the header; every object is created, used and destroyed here.
    unsafe {
        let mut environment = 0;
        assert!(spvParseTargetEnv(c"vulkan1.3".as_ptr(), &mut environment), "the validator knows Vulkan 1.3");
        let (context, options) = (spvContextCreate(environment), spvValidatorOptionsCreate());
        spvValidatorOptionsSetScalarBlockLayout(options, true);
        let mut diagnostic: *mut Diagnostic = ptr::null_mut();
        let result = spvValidateWithOptions(context, options, &binary, &mut diagnostic);
        let message = diagnostic.as_ref().map(|d| CStr::from_ptr(d.error).to_string_lossy().into_owned());
        spvDiagnosticDestroy(diagnostic);
        spvValidatorOptionsDestroy(options);
        spvContextDestroy(context);
        if result == 0 { Ok(()) } else { Err(message.unwrap_or_else(|| format!("error {result}"))) }
    }
}
