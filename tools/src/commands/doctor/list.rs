use crate::{session::Session, table::bytes};
use std::fmt::Write;
use zipsplat::{
    Result,
    gpu::{Limits, Matrices, MatrixShape, list_devices},
    ops::{Arithmetic, Precision},
};

pub fn devices(session: &mut Session<'_>) -> Result<()> {
    let devices = list_devices()?;
    let mut text = String::new();
    for device in &devices {
        let limits = &device.limits;
        let kind = match (limits.cpu, limits.discrete) {
            (true, _) => "CPU",
            (_, true) => "discrete GPU",
            _ => "integrated or virtual GPU",
        };
        let usable = match &device.unusable_reason[..] {
            [] => "usable".to_owned(),
            missing => format!("NOT usable: lacks {}", missing.join(", ")),
        };
        let [x, y, z] = limits.max_groups;
        let rows = [
            ("driver", limits.driver.clone()),
            ("Vulkan", limits.api.clone()),
            ("kind", kind.to_owned()),
            ("memory", bytes(limits.memory_bytes)),
            ("block", format!("{} in one allocation", bytes(limits.max_block_bytes))),
            ("binding", format!("{} seen by a kernel at once", bytes(limits.max_binding_bytes))),
            ("shared", bytes(limits.shared_bytes.into())),
            ("subgroup", format!("{} invocations", limits.subgroup_size)),
            ("16 bits", if limits.half_storage { "floats in buffers" } else { "none" }.to_owned()),
            ("matrices", matrices(limits)),
            ("int8", int8(limits).to_owned()),
            ("workgroups", format!("{x} x {y} x {z}")),
            (
                "timestamps",
                if limits.timestamp_bits > 0 { format!("{} ns", limits.timestamp_ns) } else { "none".into() },
            ),
        ];
        let _ = writeln!(text, "{}: {}, {usable}", device.index, limits.name);
        for (name, value) in rows {
            let _ = writeln!(text, "   {name:<11}{value}");
        }
    }
    session.report(&devices, text)
}

fn matrices(limits: &Limits) -> String {
    let sides = |shape: MatrixShape| format!("{} x {} x {}", shape.m, shape.n, shape.k);
    let Matrices { f16, bf16, i8, conversions, .. } = limits.matrices;
    let of_subgroups = [("f16", f16), ("bf16", bf16), ("i8", i8)]
        .into_iter()
        .filter_map(|(factor, shape)| Some(format!("{factor} {}", sides(shape?))));
    let all: Vec<_> = of_subgroups.chain(conversions.then(|| "conversions".into())).collect();
    if all.is_empty() { "none".into() } else { all.join(", ") }
}

fn int8(limits: &Limits) -> &'static str {
    match Arithmetic::of(Precision::Int8, limits) {
        Some(Arithmetic { quantized: Some(_), .. }) => "8-bit integers on matrix units",
        Some(_) if limits.dot_products_accelerated => "8-bit integers by dot products, which the device accelerates",
        Some(_) => "8-bit integers by dot products, which the device does not accelerate: less memory, not less time",
        None => "not on this device",
    }
}
