//! The limits and abilities of a device, as far as plans depend on them.

use super::element::Element;
use crate::{Error, Result};

/// The limits and abilities of a device, as far as plans depend on them.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Limits {
    /// The device's name.
    pub name: String,
    /// The driver's name and version.
    pub driver: String,
    /// Vulkan version, `major.minor.patch`.
    pub api: String,
    /// The device is a CPU.
    pub cpu: bool,
    /// The device is a discrete GPU.
    pub discrete: bool,
    /// Invocations in a subgroup.
    pub subgroup_size: u32,
    /// Bytes that one binding of a kernel may span.
    pub max_binding_bytes: u64,
    /// Bytes that one allocation may have.
    pub max_block_bytes: u64,
    /// Workgroups along x, y, z.
    pub max_groups: [u32; 3],
    /// Bytes of shared memory of a workgroup.
    pub shared_bytes: u32,
    /// Bytes of the memory that kernels work in.
    pub memory_bytes: u64,
    /// Nanoseconds of one timestamp tick.
    pub timestamp_ns: f64,
    /// Bits of a timestamp; 0 where there are no timestamps.
    pub timestamp_bits: u32,
    /// Invocations that a workgroup may have.
    pub max_invocations: u32,
    /// Kernels may read and write 16-bit floats.
    pub half_storage: bool,
    /// Matrices that a subgroup multiplies as one (VK_KHR_cooperative_matrix).
    pub matrices: Matrices,
    /// Lanes multiply four signed 8-bit integers by four and add up the products, where there are 16-bit floats, too.
    pub dot_products: bool,
    /// The device says that it has instructions for that.
    pub dot_products_accelerated: bool,
    /// Kernels may read buffers by their address, and the driver makes a vector's loads of loads that are the same for all lanes.
    pub addresses: bool,
    /// Device, driver and whether validation is on, exactly: what was measured on one is not true of another, and a message
    /// of the layer fails a kernel that computes rightly.
    pub identity: String,
}

/// Sides of the matrices that a subgroup multiplies: `[m, k]` times `[k, n]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct MatrixShape {
    /// Rows of the product.
    pub m: u32,
    /// Columns of the product.
    pub n: u32,
    /// Terms of a sum.
    pub k: u32,
}

/// The matrices that a subgroup multiplies as one, by the type of their factors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Matrices {
    /// f16 factors, f32 sums.
    pub f16: Option<MatrixShape>,
    /// bf16 factors, f32 sums (VK_KHR_shader_bfloat16).
    pub bf16: Option<MatrixShape>,
    /// Signed 8-bit factors, 32-bit sums.
    pub i8: Option<MatrixShape>,
}

impl Matrices {
    /// The shape of matrices with factors of this type.
    pub fn of(&self, factor: Element) -> Option<MatrixShape> {
        match factor {
            Element::F32 => None,
            Element::F16 => self.f16,
            Element::Bf16 => self.bf16,
            Element::I8 => self.i8,
        }
    }
}

impl Limits {
    /// Refuses to measure on a device without timestamps.
    ///
    /// # Errors
    /// [`Error::NoDevice`].
    pub fn check_timestamps(&self) -> Result<()> {
        match self.timestamp_bits {
            0 => Err(Error::NoDevice(format!("{} has no timestamps, which measuring needs", self.name))),
            _ => Ok(()),
        }
    }
}

impl Limits {
    /// The device's UUID as 32 hexadecimal digits, the same in CUDA; "none" where there is no device.
    pub fn uuid(&self) -> &str {
        self.identity.split('-').next().unwrap_or_default()
    }
}

impl Default for Limits {
    /// A plain desktop device, for plans made without one.
    fn default() -> Self {
        Self {
            name: "none".into(),
            driver: String::new(),
            api: "1.3.0".into(),
            cpu: false,
            discrete: true,
            subgroup_size: 32,
            max_binding_bytes: u32::MAX as u64,
            max_block_bytes: 4 << 30,
            max_groups: [65535; 3],
            shared_bytes: 32 << 10,
            memory_bytes: u64::MAX,
            timestamp_ns: 1.0,
            timestamp_bits: 64,
            max_invocations: 1024,
            half_storage: true,
            matrices: Matrices {
                f16: Some(MatrixShape { m: 16, n: 16, k: 16 }),
                bf16: Some(MatrixShape { m: 16, n: 16, k: 16 }),
                i8: Some(MatrixShape { m: 16, n: 16, k: 32 }),
            },
            dot_products: true,
            dot_products_accelerated: true,
            addresses: false,
            identity: "none".into(),
        }
    }
}
