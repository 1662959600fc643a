use crate::{Element, Error, Result};

/// Device limits and features that plans depend on.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Limits {
    /// Device name.
    pub name: String,
    /// Driver name and version.
    pub driver: String,
    /// Vulkan version, `major.minor.patch`.
    pub api: String,
    /// Whether it is a CPU.
    pub cpu: bool,
    /// Whether it is a discrete GPU.
    pub discrete: bool,
    /// Whether it is an integrated GPU.
    pub integrated: bool,
    /// Invocations per subgroup.
    pub subgroup_size: u32,
    /// Maximum bytes per binding.
    pub max_binding_bytes: u64,
    /// Maximum bytes per allocation.
    pub max_block_bytes: u64,
    /// Maximum workgroups along x, y, z.
    pub max_groups: [u32; 3],
    /// Bytes of shared memory per workgroup.
    pub shared_bytes: u32,
    /// Bytes of device memory.
    pub memory_bytes: u64,
    /// Nanoseconds per timestamp tick.
    pub timestamp_ns: f64,
    /// Valid bits of a timestamp; 0 if unsupported.
    pub timestamp_bits: u32,
    /// Maximum invocations per workgroup.
    pub max_invocations: u32,
    /// 16-bit floats in buffers.
    pub half_storage: bool,
    /// Cooperative matrices (VK_KHR_cooperative_matrix).
    pub matrices: Matrices,
    /// Dot products of four signed 8-bit integers, together with 16-bit floats.
    pub dot_products: bool,
    /// Whether hardware accelerates these.
    pub dot_products_accelerated: bool,
    /// Whether kernels may read buffers by address, for drivers that vectorize uniform loads.
    pub addresses: bool,
    /// Cache key of measurements: device, driver and validation state.
    pub identity: String,
}

/// Shape of a matrix product: `[m, k]` times `[k, n]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct MatrixShape {
    /// Rows of the product.
    pub m: u32,
    /// Columns of the product.
    pub n: u32,
    /// Inner dimension.
    pub k: u32,
}

/// Cooperative matrix shapes by factor type.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Matrices {
    /// f16 factors, f32 sums.
    pub f16: Option<MatrixShape>,
    /// Whether that shape also has f16 sums.
    pub f16_sums: bool,
    /// bf16 factors, f32 sums (VK_KHR_shader_bfloat16).
    pub bf16: Option<MatrixShape>,
    /// Signed 8-bit factors, 32-bit sums.
    pub i8: Option<MatrixShape>,
    /// Whether sums convert to factors in registers (VK_NV_cooperative_matrix2).
    pub conversions: bool,
}

impl Matrices {
    /// Returns the shape for a factor type.
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
    /// Fails without timestamps.
    pub fn check_timestamps(&self) -> Result<()> {
        match self.timestamp_bits {
            0 => Err(Error::NoDevice(format!("{} has no timestamps, which measuring needs", self.name))),
            _ => Ok(()),
        }
    }

    /// Returns the UUID as 32 hexadecimal digits, or "none".
    pub fn uuid(&self) -> &str {
        self.identity.split('-').next().unwrap_or_default()
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            name: "none".into(),
            driver: String::new(),
            api: "1.3.0".into(),
            cpu: false,
            discrete: true,
            integrated: false,
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
                f16_sums: true,
                bf16: Some(MatrixShape { m: 16, n: 16, k: 16 }),
                i8: Some(MatrixShape { m: 16, n: 16, k: 32 }),
                conversions: true,
            },
            dot_products: true,
            dot_products_accelerated: true,
            addresses: false,
            identity: "none".into(),
        }
    }
}
