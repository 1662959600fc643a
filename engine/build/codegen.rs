use crate::{
    elements::Element,
    reflect::{
        COOPERATIVE_MATRIX, COOPERATIVE_MATRIX_CONVERSIONS, DOT_PRODUCT_PACKED, Interface, Member,
        STORAGE_BUFFER_16_BIT, Scalar,
    },
    sources::Source,
};
use std::{collections::BTreeMap, fmt::Write, path::Path};

pub fn table(root: &Path, kernels: &[(&Source, Interface)], limits: &str) -> String {
    let mut areas = BTreeMap::<&str, String>::new();
    let mut all = String::new();
    for modules in kernels.chunk_by(|a, b| a.0.kernel == b.0.kernel) {
        let (area, stem) = modules[0].0.kernel.split_once('/').expect("kernels lie one folder deep");
        for index in 0..modules.len() {
            writeln!(all, "    &{area}::{}[{index}],", table_name(stem)).expect("string");
        }
        *areas.entry(area).or_default() += &kernel_struct(root, stem, modules);
    }
    let mut text = String::from("use crate::gpu::{Binding, Element, Kernel, LocalSize, Module, Needs, Tensor};\n\n");
    text += "pub mod limits {\n";
    for line in limits.lines().filter_map(|l| l.strip_prefix("const ")) {
        let (declaration, comment) = line.split_once("//").unwrap_or((line, ""));
        let (left, value) = declaration.split_once('=').expect("const TYPE NAME = VALUE;");
        let (ty, name) = left.trim().split_once(' ').expect("const TYPE NAME");
        let value = value.trim().trim_end_matches(';').trim_end_matches('u');
        let ty = if ty == "uint" { "u32" } else { "f32" };
        let comment = comment.trim();
        writeln!(text, "    /// {comment}\n    pub const {name}: {ty} = {value};").expect("string");
    }
    text += "}\n";
    for (area, body) in &areas {
        write!(text, "\npub mod {area} {{\n    use super::*;\n{body}}}\n").expect("string");
    }
    write!(text, "\npub static MODULES: &[&Module] = &[\n{all}];\n").expect("string");
    text
}

fn kernel_struct(root: &Path, stem: &str, modules: &[(&Source, Interface)]) -> String {
    let (source, interface) = &modules[0];
    let (name, kernel) = (&source.kernel, camel_case(stem));
    let fields = |i: &Interface| (fields(i), i.buffers.iter().map(|b| b.binding).collect::<Vec<_>>());
    assert!(
        modules.iter().all(|m| fields(&m.1) == fields(interface)),
        "kernels/{name}.comp: elements change its interface"
    );
    let mut members = fields(interface).0;
    for (element, _) in &source.elements {
        writeln!(members, "        pub {}: Element,", element.to_lowercase()).expect("string");
    }
    let index = module_index(modules);
    let mut push = String::new();
    for m in interface.push.iter().filter(|m| addressed(interface, m).is_none()) {
        let (a, b) = (m.offset / 4, m.offset / 4 + m.count);
        let value = if m.count == 1 { format!("[self.{}]", m.name) } else { format!("self.{}", m.name) };
        writeln!(
            push,
            "            for (word, v) in words[{a}..{b}].iter_mut().zip({value}) {{ *word = v{}; }}",
            to_bits(m.scalar)
        )
        .expect("string");
    }
    let list = |items: Vec<String>| items.join(", ");
    let buffers = list(interface.buffers.iter().map(|b| format!("self.{}", b.name)).collect());
    let constants = list(
        interface.constants.iter().map(|(_, field, scalar)| format!("self.{field}{}", to_bits(*scalar))).collect(),
    );
    let table: String = modules.iter().map(|(source, interface)| module(root, source, interface)).collect();
    let (summary, table_name, count) = (source.summary.replace('[', "\\["), table_name(stem), modules.len());
    format!(
        "
    /// {summary}
    #[allow(missing_docs)]
    #[derive(Clone, Copy, Debug)]
    pub struct {kernel} {{
{members}    }}

    pub(super) static {table_name}: [Module; {count}] = [{table}];

    impl Kernel for {kernel} {{
        fn module(&self) -> &'static Module {{ &{table_name}[{index}] }}
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

fn module_index(modules: &[(&Source, Interface)]) -> String {
    let elements = &modules[0].0.elements;
    if elements.is_empty() {
        return "0".into();
    }
    let tuple = |of: &dyn Fn(&(String, Element)) -> String, elements: &[(String, Element)]| {
        format!("({},)", elements.iter().map(of).collect::<Vec<_>>().join(", "))
    };
    let mut arms = String::new();
    for (index, (source, _)) in modules.iter().enumerate() {
        let choice = tuple(&|(_, element)| format!("Element::{element:?}"), &source.elements);
        write!(arms, "{choice} => {index}, ").expect("string");
    }
    let found = tuple(&|(name, _)| format!("self.{}", name.to_lowercase()), elements);
    format!("match {found} {{ {arms}types => panic!(\"no module for {{types:?}}\") }}")
}

fn fields(interface: &Interface) -> String {
    let mut fields = String::new();
    for b in &interface.buffers {
        writeln!(fields, "        pub {}: Tensor,", b.name).expect("string");
    }
    for m in interface.push.iter().filter(|m| addressed(interface, m).is_none()) {
        let ty = rust_type(m.scalar);
        let ty = if m.count == 1 { ty.to_owned() } else { format!("[{ty}; {}]", m.count) };
        writeln!(fields, "        pub {}: {ty},", m.name).expect("string");
    }
    for (_, field, scalar) in &interface.constants {
        writeln!(fields, "        pub {field}: {},", rust_type(*scalar)).expect("string");
    }
    fields
}

fn module(root: &Path, source: &Source, interface: &Interface) -> String {
    let (name, kernel) = (&source.name, &source.kernel);
    let push_bytes = interface.push.iter().map(|m| m.offset + 4 * m.count).max().unwrap_or(0);
    assert!(push_bytes <= 64, "kernels/{kernel}.comp: {push_bytes} bytes of push constants, at most 64 (16 words)");
    let mut bindings = String::new();
    for b in &interface.buffers {
        let (name, binding, reads, writes) = (&b.name, b.binding, b.reads, b.writes);
        write!(bindings, "Binding {{ name: {name:?}, binding: {binding}, reads: {reads}, writes: {writes} }}, ")
            .expect("string");
    }
    let addresses: Vec<_> =
        interface.push.iter().filter_map(|m| Some((addressed(interface, m)?, m.offset / 4))).collect();
    let ids: Vec<_> = interface.constants.iter().map(|c| c.0).collect();
    let subgroups = interface.constants.iter().position(|c| c.1 == "subgroups");
    let local_size = match (interface.local_size, subgroups) {
        (Some(size), _) => format!("LocalSize::Fixed({size:?})"),
        (None, Some(index)) => format!("LocalSize::Subgroups({index})"),
        (None, None) => "LocalSize::Subgroup".to_owned(),
    };
    let spirv = root.join(format!("spirv/{name}.spv"));
    let spirv = spirv.display();
    let (half, dots) = (interface.has(STORAGE_BUFFER_16_BIT), interface.has(DOT_PRODUCT_PACKED));
    let factor = source.factor().filter(|_| interface.has(COOPERATIVE_MATRIX));
    let conversions = interface.has(COOPERATIVE_MATRIX_CONVERSIONS);
    let matrices = factor.map_or("None".into(), |factor| format!("Some(Element::{factor:?})"));
    format!(
        "Module {{
            name: {name:?},
            spirv: include_bytes!(\"{spirv}\"),
            bindings: &[{bindings}],
            push_bytes: {push_bytes},
            addresses: &{addresses:?},
            constant_ids: &{ids:?},
            local_size: {local_size},
            needs: Needs {{ half_storage: {half}, matrices: {matrices}, conversions: {conversions}, dot_products: {dots} }},
        }}, "
    )
}

fn addressed(interface: &Interface, member: &Member) -> Option<usize> {
    let name = member.name.strip_suffix("_address")?;
    let buffer = interface.buffers.iter().position(|b| b.name == name);
    assert!(buffer.is_some() && member.count == 2, "{}: an address is a uvec2 named after a buffer", member.name);
    buffer
}

fn table_name(stem: &str) -> String {
    format!("{}_MODULES", stem.to_uppercase())
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
