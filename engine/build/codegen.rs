//! The Rust side of the kernel table.

use crate::{
    reflect::{Interface, Scalar},
    sources::Source,
};
use std::{collections::BTreeMap, fmt::Write, path::Path};

/// Source text of `kernels.rs` for kernels, each with the name of its variant without effects: constants of limits.glsl, one struct a kernel, and the list of all modules.
pub fn table(root: &Path, kernels: &[(&Source, Interface, Option<&str>)], limits: &str) -> String {
    let mut areas = BTreeMap::<&str, String>::new();
    let mut all = String::new();
    for (source, interface, plain) in kernels {
        let (area, stem) = source.name.split_once('/').expect("kernels lie one folder deep");
        let kernel = camel_case(stem);
        writeln!(all, "    &<{area}::{kernel} as Kernel>::MODULE,").expect("string");
        *areas.entry(area).or_default() += &kernel_struct(root, source, &kernel, interface, *plain);
    }
    let mut text = String::from("use crate::gpu::{Binding, Kernel, LocalSize, Module, Tensor};\n\n");
    writeln!(text, "/// Constants that kernels and host share, from kernels/shared/limits.glsl.\npub mod limits {{")
        .expect("string");
    for line in limits.lines().filter_map(|l| l.strip_prefix("const ")) {
        let (declaration, comment) = line.split_once("//").unwrap_or((line, "Shared with the kernels."));
        let (left, value) = declaration.split_once('=').expect("const TYPE NAME = VALUE;");
        let (ty, name) = left.trim().split_once(' ').expect("const TYPE NAME");
        let value = value.trim().trim_end_matches(';').trim_end_matches('u');
        let ty = if ty == "uint" { "u32" } else { "f32" };
        writeln!(text, "    /// {}\n    pub const {name}: {ty} = {value};", comment.trim()).expect("string");
    }
    text += "}\n";
    for (area, body) in &areas {
        write!(text, "\n/// Kernels of kernels/{area}/.\npub mod {area} {{\n    use super::*;\n{body}}}\n")
            .expect("string");
    }
    write!(text, "\n/// Every kernel, by name.\npub static MODULES: &[&Module] = &[\n{all}];\n").expect("string");
    text
}

fn kernel_struct(root: &Path, source: &Source, kernel: &str, interface: &Interface, plain: Option<&str>) -> String {
    let name = &source.name;
    let mut fields = String::new();
    let mut bindings = String::new();
    let mut buffers = Vec::new();
    for b in &interface.buffers {
        writeln!(fields, "        pub {}: Tensor,", b.name).expect("string");
        let (reads, writes) = (b.reads, b.writes);
        write!(
            bindings,
            "Binding {{ name: {:?}, binding: {}, reads: {reads}, writes: {writes} }}, ",
            b.name, b.binding
        )
        .expect("string");
        buffers.push(format!("self.{}", b.name));
    }
    let mut push = String::new();
    let mut push_bytes = 0;
    for m in &interface.push {
        let ty = rust_type(m.scalar);
        let (ty, value) = match m.count {
            1 => (ty.to_owned(), format!("[self.{}]", m.name)),
            n => (format!("[{ty}; {n}]"), format!("self.{}", m.name)),
        };
        writeln!(fields, "        pub {}: {ty},", m.name).expect("string");
        let end = m.offset + 4 * m.count;
        let (a, b) = (m.offset / 4, end / 4);
        writeln!(
            push,
            "            for (word, v) in words[{a}..{b}].iter_mut().zip({value}) {{ *word = v{}; }}",
            to_bits(m.scalar)
        )
        .expect("string");
        push_bytes = push_bytes.max(end);
    }
    assert!(push_bytes <= 64, "kernels/{name}.comp: {push_bytes} bytes of push constants, at most 64 (16 words)");
    let mut constants = Vec::new();
    let mut ids = Vec::new();
    for (id, field, scalar) in &interface.constants {
        writeln!(fields, "        pub {field}: {},", rust_type(*scalar)).expect("string");
        constants.push(format!("self.{field}{}", to_bits(*scalar)));
        ids.push(id.to_string());
    }
    let local_size = match interface.local_size {
        Some(size) => format!("LocalSize::Fixed({size:?})"),
        None => "LocalSize::Subgroup".to_owned(),
    };
    let path = |name: &str| root.join(format!("spirv/{name}.spv")).display().to_string();
    let spirv = path(name);
    let plain = plain.map_or_else(String::new, |name| {
        let spirv = path(name);
        format!(
            "
        const PLAIN: Module = Module {{ name: {name:?}, spirv: include_bytes!({spirv:?}), ..Self::MODULE }};"
        )
    });
    let (summary, buffers, constants, ids) =
        (source.summary.replace('[', "\\["), buffers.join(", "), constants.join(", "), ids.join(", "));
    format!(
        "
    /// {summary}
    #[allow(missing_docs)]
    #[derive(Clone, Copy, Debug)]
    pub struct {kernel} {{
{fields}    }}

    impl Kernel for {kernel} {{
        const MODULE: Module = Module {{
            name: {name:?},
            spirv: include_bytes!({spirv:?}),
            bindings: &[{bindings}],
            push_bytes: {push_bytes},
            constant_ids: &[{ids}],
            local_size: {local_size},
        }};{plain}
        fn buffers(&self) -> Vec<Tensor> {{ vec![{buffers}] }}
        #[allow(unused_mut)]
        fn push(&self) -> [u32; 16] {{
            let mut words = [0; 16];
{push}            words
        }}
        fn constants(&self) -> Vec<u32> {{ vec![{constants}] }}
    }}
"
    )
}

fn rust_type(scalar: Scalar) -> &'static str {
    match scalar {
        Scalar::Bool => "bool",
        Scalar::U32 => "u32",
        Scalar::I32 => "i32",
        Scalar::F32 => "f32",
    }
}

fn to_bits(scalar: Scalar) -> &'static str {
    match scalar {
        Scalar::Bool | Scalar::I32 => " as u32",
        Scalar::U32 => "",
        Scalar::F32 => ".to_bits()",
    }
}

fn camel_case(snake: &str) -> String {
    snake.split('_').map(|w| w[..1].to_uppercase() + &w[1..]).collect()
}
